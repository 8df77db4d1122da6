"""MCAP as a stream, from standard input or a TCP server: needs nothing installed on the sender's side."""

import time
from collections.abc import Mapping
from typing import BinaryIO
from urllib.parse import urlsplit

from mcap.records import Channel, Schema

from ...factors.errors import LogError
from ..damage import Damage
from ..decode import ChannelInfo
from ..records import NO_END, TOO_LONG, RawMessage, RecordStream, Untrusted
from .admission import Expected, Limits
from .backoff import Backoff
from .descriptors import opened
from .intake import Intake
from .interfaces import Clock
from .threaded_source import CONNECT_S, ThreadedSource

_MAXIMUM_SCHEMA = 1 << 20


class McapStream(ThreadedSource):
    """A source that reads one MCAP stream from its beginning; a lost connection is opened again.

    Senders should write without chunks, or flush after each message: a message arrives when its chunk is complete.

    Args:
        address: `-` for standard input, or `tcp://HOST:PORT`.
        patient: for standard input that is a file: wait instead of dropping.
    """

    def __init__(
        self,
        address: str,
        expected: Expected | None = None,
        *,
        limits: Limits | None = None,
        clock: Clock = time.time_ns,
        patient: bool = False,
    ) -> None:
        self._address = address
        self._target = tcp_target(address)
        intake = Intake(clock, expected, limits)
        super().__init__("surecut-mcap", intake, reopens=self._target is not None, patient=patient)

    @property
    def name(self) -> str:
        return "MCAP from standard input" if self._target is None else f"MCAP from {self._address}"

    def _visit(self, backoff: Backoff) -> str:
        try:
            with opened(self._target, self._stopping, CONNECT_S) as stream:
                self._opened()
                if self._read(stream):
                    backoff.succeeded()
            return "the stream ended"
        except (OSError, LogError) as error:
            return str(error)

    def _read(self, stream: BinaryIO) -> bool:
        """Read to the end; whether there was any record.

        Raises:
            LogError: the stream is empty, or no MCAP.
        """
        rules = Untrusted(self._intake.limits.message_bytes, self._damaged, resynchronise=self._target is None)
        channels = _Channels(self._intake.limits.channels)
        self._intake.forget_senders()
        any_record = False
        for record in RecordStream(stream, self.name, with_crc=False, untrusted=rules):
            any_record = True
            if self._stopping.is_set():
                break
            if isinstance(record, Schema | Channel):
                channels.add(record)
            elif isinstance(record, RawMessage):
                self._message(channels, record)
        return any_record

    def _message(self, channels: "_Channels", record: RawMessage) -> None:
        channel = channels.get(record.channel_id)
        if channel is None:
            self._intake.refuse("malformed", None, f"a message on channel {record.channel_id}, which nothing describes")
            return
        # a copy: a view would keep the whole chunk
        self._intake.take(channel, bytes(record.data), str(record.channel_id), record.log_time_ns)

    def _damaged(self, damage: Damage) -> None:
        if damage.reason == NO_END:
            return  # how a live stream ends
        self._intake.refuse(
            "oversized" if damage.reason == TOO_LONG else "malformed", None, f"{damage.kind}: {damage.reason}"
        )


class _Channels:
    """Channels by number, as many as are allowed."""

    def __init__(self, maximum: int) -> None:
        self._maximum = maximum
        self._schemas: dict[int, Schema] = {}
        self._records: dict[int, Channel] = {}
        self._known: dict[int, ChannelInfo] = {}

    def add(self, record: Schema | Channel) -> None:
        self._known.clear()
        if isinstance(record, Schema):
            if len(record.data) <= _MAXIMUM_SCHEMA and (record.id in self._schemas or self._room(self._schemas)):
                self._schemas[record.id] = record
        elif record.id in self._records or self._room(self._records):
            self._records[record.id] = record

    def get(self, number: int) -> ChannelInfo | None:
        known = self._known.get(number)
        if known is not None:
            return known
        channel = self._records.get(number)
        if channel is None:
            return None
        schema = self._schemas.get(channel.schema_id)
        if schema is None and channel.schema_id != 0:
            return None
        name, encoding, data = (schema.name, schema.encoding, bytes(schema.data)) if schema else ("", "", b"")
        info = ChannelInfo(channel.topic, channel.message_encoding, name, encoding, data)
        self._known[number] = info
        return info

    def _room(self, table: Mapping[int, object]) -> bool:
        return len(table) < self._maximum


def tcp_target(address: str) -> tuple[str, int] | None:
    """Host and port of `tcp://HOST:PORT`; None for `-`.

    Raises:
        LogError: it is neither.
    """
    if address == "-":
        return None
    try:
        parts = urlsplit(address)
        host, port = parts.hostname, parts.port
    except ValueError:
        host = port = None
        parts = urlsplit("")
    if parts.scheme != "tcp" or host is None or port is None:
        raise LogError(f"{address}: is no address of an MCAP stream; give - or tcp://HOST:PORT")
    return host, port
