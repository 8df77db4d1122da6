"""What goes from one process to the next: small things through a queue, pictures through memory that both see.

A queue copies what it carries half a dozen times, a pipe's 64 kB at a time: with a quarter of a gigabyte of pictures in
half a minute, that takes as long as looking for markers in them. Here a picture is copied once in and once out.
"""

import mmap
import pickle
from multiprocessing.context import BaseContext
from typing import Any

ROOM_BYTES = 1 << 26
"""Of the shared memory: what is ahead of the next process, for most cameras. What is never used of it costs nothing."""
_LARGE_BYTES = 1 << 14
"""Smaller arrays stay in the queue."""
_Place = tuple[int, int, bool]
"""Offset and length in the shared memory, and whether the array is read-only."""


class Passage:
    """A bounded queue from one process to one other. To be made before either starts.

    Args:
        context: how processes are started.
        ahead: items that may wait.
        room_bytes: of shared memory; 0 where processes are no copies (forks) of this one. What finds no room goes
            through the queue as a whole.
    """

    def __init__(self, context: BaseContext, ahead: int, room_bytes: int = ROOM_BYTES) -> None:
        self._queue: Any = context.Queue(ahead)
        self._room = mmap.mmap(-1, room_bytes) if room_bytes else None
        self._size = room_bytes
        self._written = 0
        """Bytes of the memory that have been used so far, its end passed over counted in; known to the sender."""
        self._free: Any = context.Value("Q", 0)
        """So many of these are free again."""

    def put(self, item: object) -> None:
        """Waits while the queue is full."""
        places: list[_Place] = []
        content = pickle.dumps(item, 5, buffer_callback=lambda buffer: not self._stored(buffer, places))
        self._queue.put((content, places, self._written))

    def get(self, timeout: float | None = None) -> Any:
        """The next item.

        Raises:
            queue.Empty: none has come in time, s.
        """
        content, places, written = self._queue.get(timeout=timeout)
        item = pickle.loads(content, buffers=[self._taken(*place) for place in places])
        if places:
            with self._free.get_lock():  # also keeps the processor from freeing it before it has been copied
                self._free.value = written
        return item

    def empty(self) -> bool:
        """Does nothing wait?"""
        return self._queue.empty()

    def close(self) -> None:
        """No more items from this process."""
        self._queue.close()

    def _stored(self, buffer: pickle.PickleBuffer, places: list[_Place]) -> bool:
        """Puts an array into the shared memory, if it is large and there is room."""
        content = buffer.raw()
        size = content.nbytes
        if self._room is None or not _LARGE_BYTES <= size <= self._size:
            return False
        with self._free.get_lock():
            if self._free.value == self._written:  # all is free: the same memory again, which the caches know
                self._free.value = self._written = 0
            free = self._size - (self._written - self._free.value)
        start = self._written % self._size
        passed_over = self._size - start if start + size > self._size else 0
        if passed_over + size > free:
            return False
        start = 0 if passed_over else start
        self._room[start : start + size] = content
        self._written += passed_over + size
        places.append((start, size, content.readonly))
        return True

    def _taken(self, start: int, size: int, readonly: bool) -> bytes | bytearray:
        assert self._room is not None
        if readonly:
            return self._room[start : start + size]
        with memoryview(self._room) as room:
            return bytearray(room[start : start + size])
