"""What of a result does not ask how the errors of tracks are correlated: worked out while that is found out."""

from dataclasses import dataclass

import gtsam

from ..factors import keys
from .aside import Aside
from .batch import BatchSolution
from .consistency import PriorTest, family_tests, prior_tests
from .engine import Engine
from .leave_out import without_families
from .points_in_base import point_blocks
from .result import FamilyConsistency, PoseEstimate
from .trajectory import trajectory

TESTED = ("mount", "known distances", "board geometry", "calibration priors")
"""Families of which every measurement is tested alone."""
LEFT_OUT = ("marker corners", "known distances", "depth cloud", "pipe cylinder", "pipe outline", "pipe width", "picks")
"""Families without each of which there may still be an estimate to compare with."""


@dataclass(frozen=True, slots=True)
class Plain:
    """Of one solution."""

    families: tuple[FamilyConsistency, ...]
    priors: list[PriorTest]
    without: dict[tuple[str, str], float]
    """How far each point moves without one family of measurements, in sigmas."""
    trajectory: tuple[PoseEstimate, ...]
    """Every frame, without covariances."""


class PlainTests:
    """Begins as soon as a solution is there.

    Args:
        apart: in a copy of the process, where a second core is free; else when it is asked for.
    """

    def __init__(self, engine: Engine, apart: bool) -> None:
        self._engine = engine
        self._apart = apart
        self._running: Aside[Plain] = Aside(apart, niceness=0)
        self._of: gtsam.Values | None = None

    def begin(self, solution: BatchSolution) -> None:
        """Of the newest solution; what has begun before is given up."""
        self._running.stop()
        self._of = solution.values
        if self._apart:
            self._running.begin(lambda: plain(self._engine, solution))

    def awaited(self, solution: BatchSolution) -> Plain:
        """Of a solution, whether it has begun or not."""
        if not self._running.busy() or self._of is not solution.values:
            self._running.stop()
            return plain(self._engine, solution)
        return self._running.awaited()

    def stop(self) -> None:
        self._running.stop()


def plain(engine: Engine, solution: BatchSolution) -> Plain:
    """Nothing of it uses `LinearSystem.root`."""
    at = solution.at
    return Plain(
        family_tests(at),
        prior_tests(at.active, at.system, TESTED),
        _left_out(engine, solution),
        trajectory(engine.odometry, solution.values),
    )


def _left_out(engine: Engine, solution: BatchSolution) -> dict[tuple[str, str], float]:
    known = [p for p in engine.pipes.points.values() if p.known]
    if not known or not solution.values.exists(engine.base):
        return {}
    blocks = {p.id: point_blocks(solution.values, engine.base, keys.point(p.index))[1] for p in known}
    return without_families(solution.at.active, solution.at.system, blocks, LEFT_OUT)
