"""Counters that several threads add to."""

import threading
from collections.abc import Mapping

MAXIMUM_TOPICS = 256
OTHER = "other"


class Tally:
    """Counts by name and topic. Names are the program's; topics may be anyone's, so that their number is bounded."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._totals: dict[str, int] = {}
        self._topics: dict[str, dict[str, int]] = {}

    def add(self, name: str, topic: str | None = None, number: int = 1) -> None:
        """One more of `name`, on `topic` where it belongs to one."""
        with self._lock:
            self._totals[name] = self._totals.get(name, 0) + number
            if topic is None:
                return
            known = self._topics.setdefault(name, {})
            key = topic if topic in known or len(known) < MAXIMUM_TOPICS else OTHER
            known[key] = known.get(key, 0) + number

    def totals(self) -> Mapping[str, int]:
        """By name."""
        with self._lock:
            return dict(self._totals)

    def by_topic(self) -> Mapping[str, Mapping[str, int]]:
        """By name and topic."""
        with self._lock:
            return {name: dict(topics) for name, topics in self._topics.items()}
