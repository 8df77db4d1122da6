"""How long things take: the last few thousand, and the worst ever."""

from collections import deque

import numpy as np


class Latencies:
    """Durations, bounded in memory."""

    def __init__(self, kept: int = 4000) -> None:
        self._last: deque[int] = deque(maxlen=kept)
        self.worst_ns = 0
        self.number = 0

    def add(self, nanoseconds: int) -> None:
        self._last.append(nanoseconds)
        self.worst_ns = max(self.worst_ns, nanoseconds)
        self.number += 1

    def percentile_ms(self, percent: float) -> float:
        """Of the last ones; 0 where there are none."""
        return float(np.percentile(np.array(self._last), percent)) * 1e-6 if self._last else 0.0

    def counters(self, name: str) -> dict[str, int]:
        """As whole microseconds."""
        found = {f"{name}_p{p}_us": round(1e3 * self.percentile_ms(p)) for p in (50, 99)}
        return {**found, f"{name}_worst_us": self.worst_ns // 1000}
