"""What is said about the boards: events that contradict the rig, and sightings that did not enter."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..factors.measurements import Event, MarkerSighting, Rejection
from ..factors.rig import Rig
from .board_inspection import FAMILY
from .sheet import Knock, Sheet

Float = NDArray[np.float64]

GEOMETRY = "board geometry"
SIDE_GATE_SIGMA = 5.0


class BoardNews:
    """Events by kind and board, and refusals."""

    def __init__(self, rig: Rig) -> None:
        self._rig = rig
        self._told: dict[tuple[str, str], Event] = {}
        self.refused: list[Rejection] = []

    @property
    def events(self) -> list[Event]:
        return list(self._told.values())

    def refuse(self, sheet: Sheet, seen: Sequence[MarkerSighting], reason: str, value: float, limit: float) -> None:
        """Sightings that do not enter."""
        self.refused += [rejection(sheet, s, reason, value, limit) for s in seen]

    def say(self, stamp_ns: int, kind: str, board: str, text: str, severity: str, **values: float) -> None:
        """Tells something about a board; a later word on the same replaces it."""
        self._told[kind, board] = Event(stamp_ns, kind, text, severity, values)  # type: ignore[arg-type]

    def told(self, kind: str, board: str) -> Event | None:
        """What was said about a board."""
        return self._told.get((kind, board))

    def unsay(self, kind: str, board: str) -> None:
        """Takes back what did not hold."""
        self._told.pop((kind, board), None)

    def say_side(self, sheet: Sheet, stamp_ns: int, side_m: float, sigma_m: float) -> None:
        board = sheet.board
        text = (
            f"board {board.id}: the rig says side {1e3 * board.side_m:.1f} mm, the log says {1e3 * side_m:.1f} +/- "
            f"{1e3 * sigma_m:.1f} mm; used the log's"
        )
        values = {"given_m": board.side_m, "seen_m": side_m, "sigma_m": sigma_m}
        self.say(stamp_ns, "side_length_wrong", board.id, text, "warning", **values)

    def reject_side(self, sheet: Sheet, stamp_ns: int, off: float) -> None:
        what = side_words(sheet.board.id)
        self.refused.append(Rejection(stamp_ns, GEOMETRY, what, "off by sigmas", off, SIDE_GATE_SIGMA))

    def say_knock(self, sheet: Sheet, knock: Knock, delta: Float, covariance: Float | None) -> None:
        """`delta`: tangent of old_T_new, rotation first; `covariance` (6, 6) where it is known already."""
        angle, length = float(np.linalg.norm(delta[:3])), float(np.linalg.norm(delta[3:]))
        sigmas = (0.0, 0.0)
        moved, turned = f"{1e3 * length:.1f} mm", f"{np.degrees(angle):.2f} deg"
        if covariance is not None:
            u, v = delta[:3] / max(angle, 1e-9), delta[3:] / max(length, 1e-9)
            sigmas = float(np.sqrt(u @ covariance[:3, :3] @ u)), float(np.sqrt(v @ covariance[3:, 3:] @ v))
            moved = f"{1e3 * length:.1f} +/- {1e3 * sigmas[1]:.1f} mm"
            turned = f"{np.degrees(angle):.2f} +/- {np.degrees(sigmas[0]):.2f} deg"
        mount = self._rig.mount
        tied = mount is not None and mount.board == sheet.board.id
        void = "; the mount (f_T_b) holds for the time before only" if tied else ""
        text = (
            f"board {sheet.board.id} was knocked between {1e-9 * knock.before_ns:.2f} s and "
            f"{1e-9 * knock.after_ns:.2f} s: moved by {moved}, turned by {turned}; it has a new pose from then on{void}"
        )
        values = {
            "before_ns": float(knock.before_ns),
            "moved_m": length,
            "moved_sigma_m": sigmas[1],
            "turned_rad": angle,
            "turned_sigma_rad": sigmas[0],
        }
        name = f"{sheet.board.id} {knock.epoch}"
        self.say(knock.after_ns, "board_knocked", name, text, "warning", **values)


def side_words(board: str) -> str:
    """The side prior's name in the records."""
    return f"side of board {board}"


def scale_words(board: str) -> str:
    """The print scale prior's name in the records."""
    return f"print scale of board {board}"


def rejection(sheet: Sheet, s: MarkerSighting, reason: str, value: float, limit: float) -> Rejection:
    """A sighting that does not enter, with the number that decided."""
    what = f"marker {s.marker} of board {sheet.board.id} in {s.camera}"
    return Rejection(s.stamp_ns, FAMILY, what, reason, float(value), float(limit))
