"""The records of an MCAP file or stream, in file order, past whatever damage there is.

mcap's own stream reader ends at the first flaw; here a chunk that is corrupt is skipped, and after a broken record
length the next chunk is searched for. What is lost is told in a `DamageReport`.
"""

import re
import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from io import BytesIO
from typing import BinaryIO

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Header, Metadata, Schema

from ..factors.errors import LogError
from .bytestream import ByteStream, EndOfStream
from .chunks import CHUNK_OPCODE, ChunkError, ChunkHeader, chunk_header, inner_records, uncompressed
from .damage import Damage, DamageReport

MAGIC = b"\x89MCAP0\r\n"
_LIMITS = {Opcode.MESSAGE: 1 << 30, Opcode.ATTACHMENT: 1 << 32, CHUNK_OPCODE: 1 << 32}
_OTHER_LIMIT = 1 << 28
_CHUNK_START = re.compile(rb"\x06.{5}\x00{3}", re.DOTALL)
PARSE_ERRORS = (McapError, struct.error, UnicodeDecodeError, MemoryError, OverflowError)
_HEADER = 9
_DATA_KINDS = {Opcode.HEADER, Opcode.SCHEMA, Opcode.CHANNEL, Opcode.ATTACHMENT, Opcode.METADATA}


@dataclass(frozen=True, slots=True)
class RawMessage:
    """A message as its channel's encoding has it; `data` may be a view of the chunk."""

    channel_id: int
    log_time_ns: int
    data: bytes | memoryview


TOO_LONG = "longer than the limit"
NO_END = "no end mark"


@dataclass(frozen=True, slots=True)
class Untrusted:
    """How to read a stream that a stranger sends and that may never end."""

    maximum_bytes: int
    """Longer records, and chunks that hold more, are passed over without being kept."""
    on_damage: Callable[[Damage], None]
    """Is told of every flaw; the report keeps none."""
    resynchronise: bool = True
    """False: a corrupt length ends the stream, for there is a better cure than to search for the next chunk."""


Record = Header | Schema | Channel | RawMessage | Attachment | Metadata


class RecordStream:
    """Iterate once over the records of one file or stream.

    Args:
        size: bytes of the whole file, where known: a record that is longer than what is left is found at once.
        with_crc: check the checksum over all records, where the writer gave one.
        untrusted: bounds, where the stream comes from a network.

    Raises (while iterating):
        LogError: empty, or not an MCAP.
    """

    def __init__(
        self,
        stream: BinaryIO,
        label: str,
        size: int | None = None,
        with_crc: bool = True,
        untrusted: Untrusted | None = None,
    ) -> None:
        self.report = DamageReport(label)
        self._bytes = ByteStream(stream, with_crc)
        self._crc: int | None = None
        self._label = label
        self._size = size
        self._untrusted = untrusted

    def __iter__(self) -> Iterator[Record]:
        self._magic()
        while (head := self._head()) is not None:
            opcode, length, offset = head
            if opcode == Opcode.DATA_END:
                self._data_end(length)
                return
            if not self._plausible(opcode, length):
                if not self._resynchronise(offset, head_bytes(opcode, length), "the record's length is corrupt"):
                    return
            elif self._is_too_long(length):
                self._pass_over(offset, length)
            elif opcode == CHUNK_OPCODE:
                yield from self._chunk(offset, length)
            else:
                try:
                    body = self._bytes.read(length)
                except EndOfStream as end:
                    self._add(Damage("cut", offset, _HEADER + length - end.missing, "the record is cut"))
                    return
                yield from self._record(opcode, memoryview(body), offset)

    def sha256(self) -> str:
        """Hash of the whole file or stream; reads what is left of it."""
        self._bytes.drain()
        return self._bytes.sha256()

    def _magic(self) -> None:
        start = self._bytes.read_up_to(len(MAGIC))
        if not start:
            raise LogError(f"{self._label}: is empty; record it again")
        if start != MAGIC:
            if MAGIC.startswith(start):
                raise LogError(f"{self._label}: is cut off after {len(start)} bytes, nothing can be read")
            raise LogError(f"{self._label}: is not an MCAP file (it starts with {start!r}); give a recorded .mcap log")

    def _head(self) -> tuple[int, int, int] | None:
        """Opcode, length and offset of the next record; None at the end of the stream."""
        offset = self._bytes.position
        self._crc = self._bytes.crc
        data = self._bytes.read_up_to(_HEADER)
        if len(data) < _HEADER:
            if not self.report.ends_cut:
                self._add(Damage("cut", offset, len(data), NO_END))
            return None
        opcode, length = struct.unpack("<BQ", data)
        return opcode, length, offset

    def _data_end(self, length: int) -> None:
        body = self._bytes.read_up_to(min(length, 4))
        expected = int.from_bytes(body, "little") if len(body) == 4 else 0
        if expected and self._crc is not None and self._crc != expected and not self.report.places:
            self.report.notes.append("the checksum over all records differs, so some message is wrong")

    def _plausible(self, opcode: int, length: int) -> bool:
        if opcode == 0 or length > _LIMITS.get(opcode, _OTHER_LIMIT):
            return False
        # A chunk's header tells a wrong length from a cut. Another record that is longer than the file is cut, unless
        # a chunk follows somewhere, which `_resynchronise` finds out.
        return opcode == CHUNK_OPCODE or self._size is None or self._bytes.position + length <= self._size

    def _chunk(self, offset: int, length: int) -> Iterator[Record]:
        start = self._bytes.read_up_to(min(44, length))
        header = chunk_header(start, length)
        if header is None:
            if len(start) < min(44, length):
                self._add(Damage("cut", offset, _HEADER + len(start), "the chunk is cut"))
            else:
                self._resynchronise(offset, head_bytes(CHUNK_OPCODE, length) + start, "a chunk's header is corrupt")
            return
        self._bytes.put_back(start)
        if self._is_too_long(header.size):
            self._pass_over(offset, length)
            return
        try:
            body = self._bytes.read(length)
        except EndOfStream as end:
            size = _HEADER + length - end.missing
            self._add(Damage("cut", offset, size, "the chunk is cut", header.start_ns, header.end_ns))
            return
        data = memoryview(body)[header.length : header.length + header.data_length]
        try:
            records = inner_records(uncompressed(header, data))
        except ChunkError as error:
            self._corrupt_chunk(offset, length, header, str(error.args[0]))
            records = error.args[1] if len(error.args) > 1 else []
        for opcode, content in records:
            yield from self._record(opcode, content, offset)

    def _corrupt_chunk(self, offset: int, length: int, header: ChunkHeader, reason: str) -> None:
        self._add(Damage("corrupt", offset, _HEADER + length, reason, header.start_ns, header.end_ns))

    def _record(self, opcode: int, body: memoryview, offset: int) -> Iterator[Record]:
        if opcode == Opcode.MESSAGE:
            if len(body) < 22:
                self._add(Damage("corrupt", offset, len(body), "a message is too short"))
                return
            channel_id, _, log_time_ns, _ = struct.unpack_from("<HIQQ", body)
            self.report.messages += 1
            self.report.last_time_ns = max(log_time_ns, self.report.last_time_ns or 0)
            yield RawMessage(channel_id, log_time_ns, body[22:])
            return
        if not _belongs(opcode, body):
            self._add(Damage("corrupt", offset, len(body), f"a record of kind {opcode:#x} has no place here"))
            return
        try:
            record = _parse(opcode, body)
        except PARSE_ERRORS as error:
            self._add(Damage("corrupt", offset, len(body), f"a record is corrupt ({type(error).__name__})"))
            return
        if isinstance(record, Attachment) and not attachment_is_sound(body, record):
            self._add(Damage("corrupt", offset, len(body), f"the checksum of attachment {record.name!r} differs"))
        elif record is not None:
            yield record

    def _is_too_long(self, length: int) -> bool:
        return self._untrusted is not None and length > self._untrusted.maximum_bytes

    def _pass_over(self, offset: int, length: int) -> None:
        """Read a record's body without keeping it."""
        left = length
        while left > 0 and (data := self._bytes.read_up_to(min(left, 1 << 20))):
            left -= len(data)
        self._add(Damage("corrupt", offset, _HEADER + length - left, TOO_LONG))

    def _resynchronise(self, offset: int, seen: bytes, reason: str) -> bool:
        """Search for the next chunk after `offset`, from where `seen` was read; False: there is none."""
        if self._untrusted is not None and not self._untrusted.resynchronise:
            self._add(Damage("cut", offset, len(seen), reason))
            return False
        self._bytes.put_back(seen[1:])
        window = b""
        while True:
            more = self._bytes.read_up_to(1 << 20)
            window += more
            base = self._bytes.position - len(window)
            for match in _CHUNK_START.finditer(window):
                (length,) = struct.unpack_from("<Q", window, match.start() + 1)
                record = window[match.end() : match.end() + 44]
                if len(record) == 44 and self._is_chunk(record, length, base + match.end()):
                    self._bytes.put_back(window[match.start() :])
                    self._add(Damage("lost", offset, base + match.start() - offset, reason))
                    return True
            if not more:
                self._add(Damage("cut", offset, self._bytes.position - offset, reason))
                return False
            window = window[-(_HEADER + 44) :]

    def _is_chunk(self, record: bytes, length: int, position: int) -> bool:
        fits = self._size is None or position + length <= self._size
        return fits and chunk_header(record, length) is not None

    def _add(self, damage: Damage) -> None:
        if self._untrusted is not None:
            self._untrusted.on_damage(damage)
        else:
            self.report.places.append(damage)


def head_bytes(opcode: int, length: int) -> bytes:
    """The nine bytes before a record."""
    return struct.pack("<BQ", opcode, length)


def _belongs(opcode: int, body: memoryview) -> bool:
    """Whether a record may stand before the end of the data: one whose kind was damaged mostly may not."""
    if opcode == Opcode.MESSAGE_INDEX:
        return len(body) >= 6 and len(body) >= 6 + struct.unpack_from("<I", body, 2)[0]
    return opcode in _DATA_KINDS or opcode >= 0x80  # those belong to applications


def _parse(opcode: int, body: memoryview) -> Record | None:
    kinds = {
        Opcode.HEADER: Header,
        Opcode.SCHEMA: Schema,
        Opcode.CHANNEL: Channel,
        Opcode.ATTACHMENT: Attachment,
        Opcode.METADATA: Metadata,
    }
    kind = kinds.get(Opcode(opcode)) if opcode in Opcode._value2member_map_ else None
    return None if kind is None else kind.read(ReadDataStream(BytesIO(body)))


def attachment_is_sound(body: memoryview, record: Attachment) -> bool:
    end = 8 + 8 + 4 + len(record.name.encode()) + 4 + len(record.media_type.encode()) + 8 + len(record.data)
    if end + 4 > len(body):
        return False
    (crc,) = struct.unpack_from("<I", body, end)
    return crc == 0 or zlib.crc32(body[:end]) == crc
