"""From a channel's description to a function that decodes its messages: one decoder per pair of encodings."""

from collections.abc import Callable
from dataclasses import dataclass

from ..factors.errors import LogError
from .messages import Message

Bytes = bytes | memoryview


class DecodeError(LogError):
    """One message is no message of its type; the next one may be."""


@dataclass(frozen=True, slots=True)
class ChannelInfo:
    """What a log says about a topic."""

    topic: str
    message_encoding: str
    schema_name: str
    schema_encoding: str
    schema_data: bytes


Decoder = Callable[[Bytes, int], Message]
"""Message data and log time (ns) to a message; raises DecodeError for bad data, LogError for a bad calibration."""


def decoder_for(channel: ChannelInfo) -> Decoder:
    """How to decode a channel.

    Raises:
        LogError: there is no decoder for the encoding, or the schema cannot be understood; names the topic.
    """
    # imported here: protobuf takes a while to load, and most logs hold one encoding
    if channel.message_encoding == "cdr" and channel.schema_encoding in ("ros2msg", ""):
        from .decode_ros import ros_decoder

        return ros_decoder(channel)
    if channel.message_encoding == "protobuf" and channel.schema_encoding == "protobuf":
        from .decode_foxglove import protobuf_decoder

        return protobuf_decoder(channel)
    if channel.message_encoding == "json":
        from .decode_foxglove import json_decoder

        return json_decoder(channel)
    pair = f"{channel.message_encoding or 'none'}/{channel.schema_encoding or 'none'}"
    raise LogError(
        f"{channel.topic}: encoding {pair} is unknown; record it as ROS 2 CDR (cdr/ros2msg) or Foxglove protobuf"
    )


def label(topic: str, log_time_ns: int) -> str:
    """Topic and time, for errors."""
    return f"{topic} at {log_time_ns / 1e9:.3f} s"


def in_one_line(error: BaseException) -> str:
    """Kind and message of an error that a parser raised."""
    return f"{type(error).__name__}: {' '.join(str(error).split())[:200]}"
