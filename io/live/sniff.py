"""The size of a compressed image from its first bytes, before anybody decompresses it."""

import struct

_PNG = b"\x89PNG\r\n\x1a\n"
_FRAMES = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}
"""JPEG markers that begin a frame; the three left out are tables."""


def image_size(data: bytes | memoryview) -> tuple[int, int] | None:
    """Width and height of a PNG or JPEG image; None for anything else."""
    head = bytes(data[:24])
    if len(head) == 24 and head.startswith(_PNG):
        width, height = struct.unpack(">II", head[16:24])
        return width, height
    return _jpeg(data) if head[:2] == b"\xff\xd8" else None


def _jpeg(data: bytes | memoryview) -> tuple[int, int] | None:
    """Walk from segment to segment up to the frame header."""
    position = 2
    while position + 9 <= len(data) and data[position] == 0xFF:
        kind = data[position + 1]
        if kind == 0xFF:  # padding
            position += 1
            continue
        (length,) = struct.unpack(">H", bytes(data[position + 2 : position + 4]))
        if kind in _FRAMES:
            height, width = struct.unpack(">HH", bytes(data[position + 5 : position + 9]))
            return width, height
        if length < 2:
            return None
        position += 2 + length
    return None
