"""A pipe or socket to read from that can be told to stop while it waits."""

import contextlib
import io
import os
import select
import socket
import sys
import threading
from collections.abc import Iterator
from typing import BinaryIO, cast

_LOOK_S = 0.2


class Descriptor(io.RawIOBase):
    """Reads a file descriptor; at its end, after an error, and when `stopping` is set there is nothing more to read."""

    def __init__(self, number: int, stopping: threading.Event) -> None:
        super().__init__()
        self._number = number
        self._stopping = stopping

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: object) -> int:
        view = memoryview(buffer)  # pyright: ignore[reportArgumentType]  # whatever io hands over
        while not self._stopping.is_set():
            ready, _, _ = select.select([self._number], [], [], _LOOK_S)
            if ready:
                try:
                    return os.readv(self._number, [view])
                except OSError:
                    return 0
        return 0


@contextlib.contextmanager
def opened(target: tuple[str, int] | None, stopping: threading.Event, timeout_s: float) -> Iterator[BinaryIO]:
    """Standard input for None, else a connection to (host, port).

    Raises:
        OSError: nobody listens there.
    """
    if target is None:
        yield cast(BinaryIO, io.BufferedReader(Descriptor(sys.stdin.fileno(), stopping), 1 << 18))
        return
    with socket.create_connection(target, timeout_s) as connection:
        connection.settimeout(None)
        keep_alive(connection)
        yield cast(BinaryIO, io.BufferedReader(Descriptor(connection.fileno(), stopping), 1 << 18))


def keep_alive(connection: socket.socket) -> None:
    """Find out within about ten seconds that the other side has gone without a word."""
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for name, value in (("TCP_KEEPIDLE", 4), ("TCP_KEEPINTVL", 2), ("TCP_KEEPCNT", 3), ("TCP_USER_TIMEOUT", 10_000)):
        option = getattr(socket, name, None)
        if option is not None:
            connection.setsockopt(socket.IPPROTO_TCP, option, value)
