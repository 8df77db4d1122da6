"""Boards that seem to stand elsewhere: a suspicion, told at once; the graph decides when keyframes agree."""

import gtsam

from ...factors import keys
from ...factors.measurements import Event
from ..bundle import Bundle
from ..engine import Engine
from .glances import Glance

ENOUGH = 2
"""Glances in a row that see a board off its place."""
PROMOTED = 3
"""Glances after that whose frames become keyframes, so that the graph can decide while the camera stands still."""


class Knocks:
    """Compares glances with the estimate of one engine."""

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        self._off: dict[str, int] = {}
        """Glances in a row that saw a board off its place."""
        self.suspects: tuple[Event, ...] = ()

    def see(self, glance: Glance) -> bool:
        """A glance; True when the suspicion has changed."""
        engine, stamp_ns = self._engine, glance.frame.stamp_ns
        before = {event.values["board"] for event in self.suspects}
        where = self._where(stamp_ns)
        if where is None:
            return False
        key, o_T_m = where
        found = engine.boards.seen_off(key, {"m_left": o_T_m}, glance.sightings, engine.solver.joint_covariance)
        seen = {sighting.board for sighting in glance.sightings}
        for board in seen:
            self._off[board] = self._off.get(board, 0) + 1 if board in found else 0
        kept = [event for event in self.suspects if self._name(event) not in seen]
        kept += [
            _suspicion(engine, board, moved_m, stamp_ns)
            for board, moved_m in found.items()
            if self._off[board] >= ENOUGH
        ]
        self.suspects = tuple(kept)
        if any(ENOUGH <= self._off[board] < ENOUGH + PROMOTED for board in found):
            engine.promote(Bundle(stamp_ns, glance.frame, glance.sightings))
        return {event.values["board"] for event in self.suspects} != before

    def _where(self, stamp_ns: int) -> tuple[int, gtsam.Pose3] | None:
        """The newest keyframe's key, and where the camera was at a frame after it."""
        engine = self._engine
        if engine.astray or engine.adrift or not engine.odometry.frames or engine.graph.unsolved:
            return None
        last = engine.odometry.frames[-1]
        key = keys.keyframe(last.keyframe)
        if last.stamp_ns != stamp_ns or not engine.state.has(key):
            return None
        return key, engine.state.pose(key).compose(gtsam.Pose3(last.keyframe_T_this))

    def _name(self, event: Event) -> str:
        return self._engine.rig.boards[int(event.values["board"])].id


def _suspicion(engine: Engine, board: str, moved_m: float, stamp_ns: int) -> Event:
    index = [b.id for b in engine.rig.boards].index(board)
    text = (
        f"board {board} is seen {1e3 * moved_m:.0f} mm from its place; look at it from several places, and do not cut "
        "before this is settled"
    )
    return Event(stamp_ns, "board_knocked", text, "error", {"board": float(index), "moved_m": moved_m})
