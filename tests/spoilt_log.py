"""Recordings with a fault from a moment on, and parts of recordings, made message by message."""

import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np
from mcap.reader import make_reader
from mcap.writer import Writer

S = 1_000_000_000
Change = Callable[[int, str, bytes], bytes]
"""Takes time of recording, topic and CDR message; gives the message to record instead."""


def rewritten(log: Path, out: Path, change: Change, begin_ns: int = 0, end_ns: int = 1 << 62) -> None:
    """The part of a recording between two times, changed, with its attachments."""
    with log.open("rb") as source, out.open("wb") as target:
        reader, writer = make_reader(source), Writer(target)
        writer.start("ros2")
        for a in reader.iter_attachments():
            writer.add_attachment(a.create_time, a.log_time, a.name, a.media_type, a.data)
        schemas, channels = {}, {}
        for schema, channel, message in reader.iter_messages(starting_at=begin_ns, ending_before=end_ns):
            assert schema is not None
            if schema.id not in schemas:
                schemas[schema.id] = writer.register_schema(schema.name, schema.encoding, schema.data)
            if channel.id not in channels:
                encoding = channel.message_encoding
                channels[channel.id] = writer.register_channel(channel.topic, encoding, schemas[schema.id])
            data = change(message.log_time, channel.topic, message.data)
            writer.add_message(channels[channel.id], message.log_time, data, message.publish_time)
        writer.finish()


def unchanged(time_ns: int, topic: str, data: bytes) -> bytes:
    return data


def frozen(topic: str, from_ns: int) -> Change:
    """A camera that sends its last picture again and again, under new stamps."""
    last = b""

    def change(time_ns: int, name: str, data: bytes) -> bytes:
        nonlocal last
        if name != topic:
            return data
        last = data if time_ns < from_ns else last
        return last[:4] + data[4:12] + last[12:]  # the header's stamp follows the encapsulation

    return change


def clock_set(prefix: str, from_ns: int, by_ns: int) -> Change:
    """Stamps of some topics jump."""

    def change(time_ns: int, name: str, data: bytes) -> bytes:
        if time_ns < from_ns or not name.startswith(prefix):
            return data
        seconds, rest = struct.unpack_from("<iI", data, 4)
        stamp = seconds * S + rest + by_ns
        return data[:4] + struct.pack("<iI", stamp // S, stamp % S) + data[12:]

    return change


def turned(topic: str, from_ns: int, by_px: int, size: tuple[int, int]) -> Change:
    """A camera of a pair that is knocked: its pictures (height, width) move to the side."""

    def change(time_ns: int, name: str, data: bytes) -> bytes:
        if time_ns < from_ns or name != topic:
            return data
        pixels = np.frombuffer(data, np.uint8)[-size[0] * size[1] :].reshape(size)  # the last field of the message
        return data[: -pixels.size] + np.roll(pixels, by_px, axis=1).tobytes()

    return change
