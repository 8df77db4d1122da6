"""However long a recording is, the graph holds so many keyframes and no more; those that left are a path."""

from collections.abc import Collection

from .bounded import Bounded
from .engine import Engine
from .limits import Limits
from .result import PoseEstimate
from .trajectory import trajectory

LIMITS = Limits(keyframes=120, step=40, map_landmarks=120, told=100_000, frames=1_000_000)
"""Half a minute makes 30 to 65 keyframes. Refusals and frames of a whole day are kept."""


class LongRecording:
    """Keeps the engine of one recording within limits, and the path of the keyframes that have left it."""

    def __init__(self, engine: Engine, limits: Limits = LIMITS) -> None:
        self._engine = engine
        self._bounded = Bounded(engine, limits, self._leave)
        self.past: list[PoseEstimate] = []
        """Every frame's `o_T_m` as it was estimated when its keyframe left; its covariance is not known any more."""

    def tidy(self) -> None:
        """After each stamp."""
        if self._engine.odometry.observations:  # markers alone make small graphs
            self._bounded.tidy()

    def _leave(self, keyframes: Collection[int]) -> None:
        self.past += trajectory(self._engine.odometry, self._engine.state.values, keyframes)
