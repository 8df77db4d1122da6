"""The machine may be moved: one `o_T_b` per station, and the boards on the machine go with it."""

import gtsam
import numpy as np

from ..factors import keys
from ..factors.geometry import pose3
from ..factors.links import base_motion_factor, carried_factor
from ..factors.measurements import BaseMove, Event
from .boards import Boards
from .graph import Record, State, Update

FAMILY = "base motion"


class Stations:
    """Where the machine stood, and when."""

    def __init__(self, state: State) -> None:
        self._state = state
        self.moves: list[BaseMove] = []

    @property
    def base(self) -> int:
        """Key of `o_T_b` of the present station."""
        return keys.base(len(self.moves))

    @property
    def frame(self) -> str:
        """Name of the present {b}."""
        return f"b{len(self.moves)}" if self.moves else "b"

    def at(self, stamp_ns: int) -> int | None:
        """Key of `o_T_b` at a moment, None while the machine was moving."""
        passed = 0
        for move in self.moves:
            if move.start_ns <= stamp_ns < move.stamp_ns:
                return None
            passed += stamp_ns >= move.stamp_ns
        return keys.base(passed)

    def move(self, move: BaseMove, boards: Boards) -> Update:
        """A new station: its pose by the motion that the depth camera saw; the machine has carried its boards."""
        before, update = self.base, Update()
        self.moves.append(move)
        if not self._state.has(before):
            return update
        after = self.base
        o_T_before = self._state.pose(before)
        o_T_after = o_T_before.compose(pose3(move.before_T_after))
        update.guess(after, o_T_after)
        record = Record(FAMILY, FAMILY, move.stamp_ns, f"{keys.words(before)} to {keys.words(after)}")
        update.add(base_motion_factor(before, after, move.before_T_after, move.covariance), record)
        for old, new in boards.carried():
            update.guess(new, o_T_after.compose(o_T_before.between(self._state.pose(old))))
            what = f"{keys.words(old)} is fixed to the machine"
            factor = carried_factor(before, old, after, new)
            update.add(factor, Record("gauge", "carried boards", move.stamp_ns, what, rejectable=False))
        return update


def move_event(move: BaseMove) -> Event:
    """What a user has to know."""
    shift = float(np.linalg.norm(move.before_T_after[:3, 3]))
    turn = float(np.linalg.norm(gtsam.Rot3.Logmap(gtsam.Rot3(move.before_T_after[:3, :3]))))
    seconds = 1e-9 * (move.stamp_ns - move.start_ns)
    text = (
        f"the machine was moved within {seconds:.1f} s, by {1e3 * shift:.0f} mm and {np.degrees(turn):.1f} degrees; "
        "points are given in {b} as it stood at the end"
    )
    return Event(move.stamp_ns, "base_moved", text, "info", {"shift_m": shift, "turn_rad": turn})
