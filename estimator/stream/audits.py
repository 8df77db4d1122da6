"""When the model is tested against its own data, and what that says until the next time."""

from dataclasses import replace

from ...factors.errors import SurecutError
from ..aside import Aside
from ..engine import Engine
from ..result import Consistency
from .audit import Audit, audit
from .settings import S

SOONER = 4
"""The first one comes so many times sooner than a period, and the next after as long again."""
TO_FAIL = 3
"""Periods in which every audit failed after which the model counts as not consistent: nobody knows."""


class Audits:
    """One after the other.

    Args:
        engine: whose model it is.
        period_ns: of stamps, between two.
        apart: made by a copy of the process, while the engine goes on.
    """

    def __init__(self, engine: Engine, period_ns: int, apart: bool) -> None:
        self._engine = engine
        self._period_ns = period_ns
        self._aside: Aside[Audit] = Aside(apart)
        self._next_ns = 0
        self._next_revisit_ns = 0
        """Boards that were seen before they had a place are looked at again, which changes the estimate: rarely."""
        self._first_ns: int | None = None
        self._last = Audit()
        self._failing: tuple[int, str] | None = None
        """Since when, and why."""
        self.failed = 0

    def begin_when_due(self, stamp_ns: int) -> None:
        """Starts one, when it is time and there is something to test."""
        if stamp_ns < self._next_ns and self._next_ns - stamp_ns <= self._period_ns:
            return
        engine = self._engine
        if engine.odometry.last_keyframe < 0 or engine.graph.unsolved or self._aside.busy():
            return
        self._next_ns = stamp_ns + self._pause_ns(stamp_ns)
        if stamp_ns >= self._next_revisit_ns or self._next_revisit_ns - stamp_ns > self._period_ns:
            self._next_revisit_ns = stamp_ns + self._period_ns
            if engine.boards.any_known():
                engine.revisit()
        self._aside.begin(lambda: audit(engine))

    def _pause_ns(self, stamp_ns: int) -> int:
        """Until the next one: what is learnt at the beginning changes the verdict most."""
        if self._first_ns is None:
            self._first_ns = stamp_ns
        age_ns = abs(stamp_ns - self._first_ns)
        return min(max(age_ns, self._period_ns // SOONER), self._period_ns)

    def take(self) -> bool:
        """Whether an outcome has come in."""
        try:
            found = self._aside.taken()
        except SurecutError as error:
            self.failed += 1
            since = self._engine.end_ns if self._failing is None else self._failing[0]
            self._failing = since, str(error)
            return True
        if found is not None:
            self._last, self._failing = found, None
        return found is not None

    def consistency(self) -> Consistency:
        """What the last audit said; not passed where audits have failed for so long that it says nothing of today."""
        last = self._last.consistency
        if self._failing is None:
            return last
        since, why = self._failing
        waited_ns = self._engine.end_ns - since
        if waited_ns < TO_FAIL * self._period_ns:
            return last
        told = f"the model could not be tested against its own data for {waited_ns / S:.0f} s: {why}"
        return replace(last, passed=False, reasons=(*last.reasons, told))

    def widening(self, name: str) -> float:
        """Factor on the covariance of a point or pose."""
        return self._last.widening.get(name, 1.0)

    def stop(self) -> None:
        """Ends what is under way."""
        self._aside.stop()
