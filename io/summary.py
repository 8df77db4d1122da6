"""What the end of a whole MCAP file says about it, and its attachments, without reading its messages."""

import struct
from dataclasses import dataclass, replace
from io import SEEK_END, BytesIO
from typing import BinaryIO

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Schema, Statistics

from .records import MAGIC, PARSE_ERRORS, attachment_is_sound

_FOOTER = 9 + 20 + len(MAGIC)
_DATA_END = 9 + 4
_MAXIMUM_SUMMARY = 1 << 28


@dataclass(frozen=True, slots=True)
class Summary:
    """The records that a writer repeats at the end."""

    schemas: dict[int, Schema]
    channels: dict[int, Channel]
    counts: dict[int, int]
    """Messages by channel."""
    statistics: Statistics | None
    has_data_crc: bool = True
    """Whether the writer gave a checksum over all records; True where that is not known."""


EMPTY = Summary({}, {}, {}, None)


def read_summary(file: BinaryIO) -> Summary:
    """The summary; empty where the file is cut or has none."""
    summary = EMPTY
    size = file.seek(0, SEEK_END)
    if size < _FOOTER:
        return summary
    file.seek(size - _FOOTER)
    footer = file.read(_FOOTER)
    opcode, length, start = struct.unpack_from("<BQQ", footer)
    end = size - _FOOTER
    start = start or end  # 0: no summary
    if opcode != Opcode.FOOTER or length != 20 or not _DATA_END <= start <= end or end - start > _MAXIMUM_SUMMARY:
        return summary
    file.seek(start - _DATA_END)
    data_end = file.read(_DATA_END)
    has_crc = data_end[0] != Opcode.DATA_END or data_end[-4:] != bytes(4)
    try:
        return replace(_parsed(file.read(end - start)), has_data_crc=has_crc)
    except PARSE_ERRORS:
        return summary


def _parsed(data: bytes) -> Summary:
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    statistics: Statistics | None = None
    position = 0
    while position + 9 <= len(data):
        opcode, length = struct.unpack_from("<BQ", data, position)
        body = ReadDataStream(BytesIO(data[position + 9 : position + 9 + length]))
        if opcode == Opcode.SCHEMA:
            schema = Schema.read(body)
            schemas[schema.id] = schema
        elif opcode == Opcode.CHANNEL:
            channel = Channel.read(body)
            channels[channel.id] = channel
        elif opcode == Opcode.STATISTICS:
            statistics = Statistics.read(body)
        position += 9 + length
    return Summary(schemas, channels, dict(statistics.channel_message_counts) if statistics else {}, statistics)


def find_attachment(file: BinaryIO, name: str) -> Attachment | None:
    """The first sound attachment of that name; other records are jumped over."""
    statistics = read_summary(file).statistics
    if statistics is not None and statistics.attachment_count == 0:
        return None
    size = file.seek(0, SEEK_END)
    position = len(MAGIC)
    while position + 9 <= size:
        file.seek(position)
        opcode, length = struct.unpack("<BQ", file.read(9))
        position += 9 + length
        if opcode in (0, Opcode.DATA_END) or position > size:
            return None
        if opcode == Opcode.ATTACHMENT:
            body = file.read(length)
            try:
                record = Attachment.read(ReadDataStream(BytesIO(body)))
            except PARSE_ERRORS:
                continue
            if record.name == name and attachment_is_sound(memoryview(body), record):
                return record
    return None
