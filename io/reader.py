"""Read a log or a stream: one iterator of `Message`s for a file, a split recording and a pipe."""

import hashlib
from collections.abc import Collection, Generator, Iterator
from pathlib import Path
from types import TracebackType
from typing import BinaryIO, Self

from mcap.records import Attachment, Channel, Header, Metadata, Schema

from ..factors.errors import LogError
from .decode import ChannelInfo, DecodeError, Decoder, decoder_for
from .messages import Message, OtherBody
from .records import RawMessage, Record
from .sources import Part, parts_of
from .summary import EMPTY, Summary


class LogReader:
    """The messages of a recording in the order of the recording.

    Memory stays flat: one chunk at a time. Damage is skipped; `warnings` says in one line per file what is lost.
    A path is read anew by each iteration, a stream once.

    Args:
        source: an MCAP file, a rosbag2 folder (split recordings are joined), a URL (with fsspec), or a binary stream.
        topics: those to decode; None for all. A topic that is asked for and cannot be decoded is an error.

    Raises:
        LogError: the source cannot be opened.
    """

    def __init__(self, source: Path | str | BinaryIO, topics: Collection[str] | None = None) -> None:
        self.parts = parts_of(source)
        self.name = str(source) if isinstance(source, Path | str) else self.parts[0].label
        self.warnings: list[str] = []
        self.attachments: dict[str, bytes] = {}
        """Those that passed so far; `attachment` looks ahead."""
        self.metadata: dict[str, dict[str, str]] = {}
        self.channels: dict[str, ChannelInfo] = {}
        """By topic, those that passed so far."""
        self.profile = ""
        self._topics = None if topics is None else frozenset(topics)
        self._ahead: list[tuple[Part, Record]] = []
        self._rest: Generator[tuple[Part, Record]] | None = None

    def __iter__(self) -> Iterator[Message]:
        """
        Raises (while iterating):
            LogError: not an MCAP, or a wanted topic that cannot be decoded, or a calibration that cannot be used.
        """
        decoders: dict[ChannelInfo, Decoder | None] = {}
        undecodable: dict[str, tuple[int, str]] = {}
        for channel, log_time_ns, data in self.raw():
            if self._topics is not None and channel.topic not in self._topics:
                continue
            if channel not in decoders:
                decoders[channel] = self._decoder(channel)
            decoder = decoders[channel]
            if decoder is None:
                yield Message(channel.topic, log_time_ns, log_time_ns, "", OtherBody(channel.schema_name, None))
                continue
            try:
                yield decoder(data, log_time_ns)
            except LogError as error:
                # one bad message may stand among good ones; a bad calibration is bad in all of them
                if self._topics is not None and not isinstance(error, DecodeError):
                    raise LogError(f"{self.name}: {error}") from error
                count, first = undecodable.get(channel.topic, (0, str(error)))
                undecodable[channel.topic] = count + 1, first
        self._tell_undecodable(undecodable)

    def raw(self) -> Iterator[tuple[ChannelInfo, int, bytes | memoryview]]:
        """Channel, log time (ns) and undecoded data of every message, of all topics."""
        part: Part | None = None
        describe = _Descriptions(EMPTY)
        for at, record in self._records():
            if at is not part:  # numbers of channels and schemas are those of one file
                part, describe = at, _Descriptions(at.summary())
            if isinstance(record, RawMessage):
                channel = describe.channel(record.channel_id)
                if channel is None:
                    self._warn(
                        f"{at.label}: messages on channel {record.channel_id}, which nothing describes, are lost"
                    )
                    continue
                self.channels[channel.topic] = channel
                yield channel, record.log_time_ns, record.data
            elif isinstance(record, Schema | Channel):
                describe.add(record)
            else:
                self._keep(record)

    def attachment(self, name: str) -> bytes | None:
        """An attached file, such as `rig.yaml`.

        A file is searched as a whole; of a stream only what comes before its first message is looked at.

        Raises:
            LogError: not an MCAP.
        """
        for part in self.parts:
            found = part.attachment(name)
            if found is not None:
                return found.data
        if not self.parts[0].seekable and not self._ahead:
            self._look_ahead()
        return self.attachments.get(name)

    def sha256(self) -> str:
        """Hash of the source, in hexadecimal: of all its bytes, or of its parts' hashes.

        What is left of a stream is read for it.
        """
        hashes = [part.sha256() for part in self.parts]
        return hashes[0] if len(hashes) == 1 else hashlib.sha256("".join(hashes).encode()).hexdigest()

    def close(self) -> None:
        """Close the file in the middle of which an iteration was left. A stream stays open."""
        if self._rest is not None:
            self._rest.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        self.close()

    def _records(self) -> Iterator[tuple[Part, Record]]:
        """Records of all parts; of a stream that was looked into, from its start all the same."""
        ahead, self._ahead = self._ahead, []
        repeatable = self.parts[0].path is not None and not ahead
        if self._rest is None or repeatable:
            self.close()
            self._rest = self._all_records()
        yield from ahead
        yield from self._rest

    def _all_records(self) -> Generator[tuple[Part, Record]]:
        for part in self.parts:
            for record in part.records():
                yield part, record
            warning = part.warning()
            if warning is not None:
                self._warn(warning)

    def _look_ahead(self) -> None:
        """Read a stream up to its first message, and keep what was read for the iteration."""
        self._rest = self._rest or self._all_records()
        for part, record in self._rest:
            self._ahead.append((part, record))
            if isinstance(record, RawMessage):
                return
            if isinstance(record, Attachment):
                self._keep(record)

    def _keep(self, record: Attachment | Metadata | Header) -> None:
        if isinstance(record, Attachment):
            self.attachments[record.name] = record.data
        elif isinstance(record, Metadata):
            self.metadata[record.name] = dict(record.metadata)
        else:
            self.profile = record.profile

    def _decoder(self, channel: ChannelInfo) -> Decoder | None:
        try:
            return decoder_for(channel)
        except LogError as error:
            if self._topics is not None:
                raise LogError(f"{self.name}: {error}") from error
            self._warn(f"{self.name}: {error}")
            return None

    def _tell_undecodable(self, undecodable: dict[str, tuple[int, str]]) -> None:
        for count, first in undecodable.values():
            self._warn(f"{self.name}: {count} messages could not be decoded and are left out; the first: {first}")

    def _warn(self, text: str) -> None:
        if text not in self.warnings:
            self.warnings.append(text)


class _Descriptions:
    """Channels by number: those that came before a message, else those of the file's summary."""

    def __init__(self, summary: Summary) -> None:
        self._summary = summary
        self._schemas: dict[int, Schema] = {}
        self._records: dict[int, Channel] = {}
        self._channels: dict[int, ChannelInfo] = {}

    def add(self, record: Schema | Channel) -> None:
        known: dict[int, Schema] | dict[int, Channel] = self._schemas if isinstance(record, Schema) else self._records
        if known.get(record.id) != record:
            known[record.id] = record  # pyright: ignore[reportArgumentType]
            self._channels.clear()

    def channel(self, number: int) -> ChannelInfo | None:
        known = self._channels.get(number)
        if known is not None:
            return known
        channel = self._records.get(number) or self._summary.channels.get(number)
        if channel is None:
            return None
        schema = self._schemas.get(channel.schema_id) or self._summary.schemas.get(channel.schema_id)
        if schema is None and channel.schema_id != 0:  # 0: a channel that needs none
            return None
        name, encoding, data = (schema.name, schema.encoding, schema.data) if schema else ("", "", b"")
        self._channels[number] = ChannelInfo(channel.topic, channel.message_encoding, name, encoding, bytes(data))
        return self._channels[number]
