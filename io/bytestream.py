"""Bytes from a file or a pipe, counted and hashed as they pass, with a way to put some back."""

import hashlib
import zlib
from typing import BinaryIO

_PIECE = 1 << 24


class EndOfStream(Exception):
    """The stream ended inside of what was asked for. `missing` bytes were not there."""

    def __init__(self, missing: int) -> None:
        super().__init__(missing)
        self.missing = missing


class ByteStream:
    """Forward reading only, so that a file and a pipe are the same.

    Args:
        with_crc: keep `crc` up to date.
    """

    def __init__(self, stream: BinaryIO, with_crc: bool = False) -> None:
        self._stream = stream
        self._back = b""
        self._hash = hashlib.sha256()
        self._read = 0
        self._with_crc = with_crc
        self._crc = 0

    @property
    def crc(self) -> int | None:
        """CRC-32 of everything before `position`; None where it is not kept or bytes were put back."""
        return self._crc if self._with_crc and not self._back else None

    @property
    def position(self) -> int:
        """Offset of the next byte."""
        return self._read - len(self._back)

    def read(self, length: int) -> bytes:
        """Exactly `length` bytes. What is there when the stream ends early is lost.

        Raises:
            EndOfStream: fewer bytes are left.
        """
        data = self.read_up_to(length)
        if len(data) < length:
            raise EndOfStream(length - len(data))
        return data

    def read_up_to(self, length: int) -> bytes:
        """`length` bytes, fewer only at the end of the stream."""
        if not self._back and length <= _PIECE:
            data = self._next(length)
            if len(data) == length:
                return data
            pieces = [data]
        else:
            pieces = [self._back[:length]]
            self._back = self._back[length:]
        missing = length - len(pieces[0])
        while missing > 0 and (data := self._next(min(missing, _PIECE))):
            pieces.append(data)
            missing -= len(data)
        return pieces[0] if len(pieces) == 1 else b"".join(pieces)

    def put_back(self, data: bytes) -> None:
        """The next read begins with `data`."""
        self._back = data + self._back

    def drain(self) -> int:
        """Read to the end, for the hash; the number of bytes."""
        start = self.position
        self._back = b""
        while self._next(_PIECE):
            pass
        return self._read - start

    def sha256(self) -> str:
        """Hash, in hexadecimal, of everything that was read so far."""
        return self._hash.hexdigest()

    def _next(self, length: int) -> bytes:
        data = self._stream.read(length) or b""
        self._hash.update(data)
        if self._with_crc:
            self._crc = zlib.crc32(data, self._crc)
        self._read += len(data)
        return data
