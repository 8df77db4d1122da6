"""MCAP chunks: the header that precedes the data, decompression with checks, the records inside."""

import struct
import zlib
from dataclasses import dataclass

import lz4.frame
import zstandard

CHUNK_OPCODE = 0x06
MAXIMUM_CHUNK = 1 << 31
_FIXED = struct.Struct("<QQQII")
_COMPRESSIONS = (b"", b"zstd", b"lz4")


class ChunkError(Exception):
    """A chunk's data is not what its header says."""


@dataclass(frozen=True, slots=True)
class ChunkHeader:
    """The fields before a chunk's data."""

    start_ns: int
    end_ns: int
    size: int
    """Bytes of the data after decompression."""
    crc: int
    """Of the data after decompression; 0: unknown."""
    compression: str
    data_length: int
    length: int
    """Bytes of this header."""


def chunk_header(record: bytes, record_length: int) -> ChunkHeader | None:
    """The header at the start of a chunk record, None when these bytes cannot be one.

    Args:
        record: at least the record's first 44 bytes, without opcode and length.
        record_length: of the whole record.
    """
    if len(record) < 44 or record_length < 40:
        return None
    start_ns, end_ns, size, crc, name_length = _FIXED.unpack_from(record)
    name = record[32 : 32 + name_length]
    if name_length > 4 or name not in _COMPRESSIONS or start_ns > end_ns or size > MAXIMUM_CHUNK:
        return None
    position = 32 + name_length
    if len(record) < position + 8:
        return None
    (data_length,) = struct.unpack_from("<Q", record, position)
    # writers may append fields: the data must fit, it need not fill the record
    if position + 8 + data_length > record_length or (not name and data_length != size):
        return None
    return ChunkHeader(start_ns, end_ns, size, crc, name.decode(), data_length, position + 8)


def uncompressed(header: ChunkHeader, data: memoryview) -> memoryview:
    """A chunk's records.

    Raises:
        ChunkError: the data cannot be decompressed, or size or checksum differ.
    """
    try:
        if header.compression == "zstd":
            content = _zstd(header, data)
        elif header.compression == "lz4":
            content = lz4.frame.decompress(data)
        else:
            content = data
    except (zstandard.ZstdError, RuntimeError, MemoryError, EOFError) as error:
        raise ChunkError(f"{header.compression} data is corrupt") from error
    if len(content) != header.size:
        raise ChunkError(f"{len(content)} bytes instead of {header.size}")
    if header.crc and zlib.crc32(content) != header.crc:
        raise ChunkError("checksum differs")
    return memoryview(content)


def _zstd(header: ChunkHeader, data: memoryview) -> bytes:
    declared = zstandard.frame_content_size(data)
    if declared not in (-1, header.size):  # before memory is set aside for it
        raise ChunkError(f"{declared} bytes instead of {header.size}")
    return zstandard.ZstdDecompressor().decompress(data, max_output_size=header.size)


def inner_records(content: memoryview) -> list[tuple[int, memoryview]]:
    """Opcode and body of each record of an uncompressed chunk.

    Raises:
        ChunkError: the records do not fill the chunk. `args[1]` holds the records before the flaw.
    """
    records: list[tuple[int, memoryview]] = []
    position, end = 0, len(content)
    while position < end:
        if position + 9 > end:
            raise ChunkError("a record is cut", records)
        opcode, length = struct.unpack_from("<BQ", content, position)
        position += 9
        if position + length > end:
            raise ChunkError("a record is longer than its chunk", records)
        records.append((opcode, content[position : position + length]))
        position += length
    return records
