"""A queue between threads that never grows beyond its bounds and never makes its producer wait."""

import threading
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import count
from typing import Generic, TypeVar

from ..messages import CameraInfoBody, CloudBody, DepthBody, ImageBody, Message, PickBody
from .tally import Tally

Item = TypeVar("Item")


@dataclass(frozen=True, slots=True)
class _Entry(Generic[Item]):
    number: int
    item: Item
    topic: str
    size: int


class BoundedQueue(Generic[Item]):
    """First in, first out; when a bound is reached the oldest entries are dropped and counted by topic.

    Urgent entries (picks, calibrations) are counted against `maximum_urgent` alone, so that a flood of images never
    drops one. They keep their place in the order.

    Args:
        maximum_count: ordinary entries.
        maximum_bytes: of the ordinary entries together; an entry that is larger by itself is dropped.
        maximum_urgent: urgent entries.
    """

    def __init__(self, maximum_count: int, maximum_bytes: int, maximum_urgent: int = 1024) -> None:
        self._maximum_count = maximum_count
        self._maximum_bytes = maximum_bytes
        self._maximum_urgent = maximum_urgent
        self._ordinary: deque[_Entry[Item]] = deque()
        self._urgent: deque[_Entry[Item]] = deque()
        self._bytes = 0
        self._numbers = count()
        self._changed = threading.Condition()
        self._closed = False
        self._dropped = Tally()

    def put(self, item: Item, topic: str, size: int, urgent: bool = False) -> bool:
        """Append, dropping what is oldest where there is no room. False: this entry itself was not taken."""
        with self._changed:
            if self._closed or (size > self._maximum_bytes and not urgent):
                self._dropped.add("dropped", topic)
                return False
            self._append(_Entry(next(self._numbers), item, topic, size), urgent)
            self._make_room()
            self._changed.notify_all()
            return True

    def put_waiting(self, item: Item, topic: str, size: int, urgent: bool = False) -> bool:
        """Append, waiting for room: for patient sources. False: the queue was closed, or the entry can never fit."""
        with self._changed:
            if size > self._maximum_bytes and not urgent:
                self._dropped.add("dropped", topic)
                return False
            self._changed.wait_for(lambda: self._closed or self._has_room(size, urgent))
            if self._closed:
                return False
            self._append(_Entry(next(self._numbers), item, topic, size), urgent)
            self._changed.notify_all()
            return True

    def get(self, timeout_s: float | None = None) -> Item | None:
        """The oldest entry; None after `timeout_s`, or when the queue is closed and empty."""
        with self._changed:
            self._changed.wait_for(lambda: self._closed or self._ordinary or self._urgent, timeout_s)
            entry = self._next()
            if entry is None:
                return None
            self._changed.notify_all()
            return entry.item

    def close(self) -> None:
        """Take nothing more; what is queued can still be taken out."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    @property
    def closed(self) -> bool:
        return self._closed

    def __len__(self) -> int:
        with self._changed:
            return len(self._ordinary) + len(self._urgent)

    @property
    def size_bytes(self) -> int:
        """Of the ordinary entries."""
        with self._changed:
            return self._bytes

    def dropped(self) -> int:
        """Entries that were lost, in all."""
        return self._dropped.totals().get("dropped", 0)

    def dropped_by_topic(self) -> Mapping[str, int]:
        """Entries that were lost."""
        return self._dropped.by_topic().get("dropped", {})

    def _append(self, entry: _Entry[Item], urgent: bool) -> None:
        (self._urgent if urgent else self._ordinary).append(entry)
        self._bytes += 0 if urgent else entry.size

    def _has_room(self, size: int, urgent: bool) -> bool:
        if urgent:
            return len(self._urgent) < self._maximum_urgent
        return len(self._ordinary) < self._maximum_count and self._bytes + size <= self._maximum_bytes

    def _make_room(self) -> None:
        while len(self._ordinary) > self._maximum_count or self._bytes > self._maximum_bytes:
            oldest = self._ordinary.popleft()
            self._bytes -= oldest.size
            self._dropped.add("dropped", oldest.topic)
        while len(self._urgent) > self._maximum_urgent:
            self._dropped.add("dropped", self._urgent.popleft().topic)

    def _next(self) -> _Entry[Item] | None:
        if self._urgent and (not self._ordinary or self._urgent[0].number < self._ordinary[0].number):
            return self._urgent.popleft()
        if not self._ordinary:
            return None
        entry = self._ordinary.popleft()
        self._bytes -= entry.size
        return entry


def message_size(message: Message) -> int:
    """Bytes that a message keeps in memory, near enough to bound a queue."""
    body = message.body
    if isinstance(body, ImageBody | DepthBody | CloudBody):
        return int(body.source.data.nbytes) + 512
    return 2048


def is_urgent(message: Message) -> bool:
    """Whether a message is small, rare, and dear: a pick or a calibration."""
    return isinstance(message.body, PickBody | CameraInfoBody)
