"""Marker points in words: `29` is the centre of marker 29, `29/0` its corner 0, `f1:29/0` on board f1."""

import re
from dataclasses import dataclass

from ..factors.errors import RigError
from ..factors.rig import Rig

_PATTERN = re.compile(r"(?:(?P<board>[^:]+):)?(?P<marker>\d+)(?:/(?P<corner>[0-3]))?$")


@dataclass(frozen=True, slots=True)
class MarkerPoint:
    board: str
    marker: int
    corner: int | None
    """None: the centre."""


def parse_point(text: str, rig: Rig) -> MarkerPoint:
    """A marker point of the rig.

    Raises:
        RigError: no such form, no such marker, or more than one board with that marker.
    """
    match = _PATTERN.match(text.strip())
    if match is None:
        raise RigError(f"{text!r} is no marker point; write 29 (centre), 29/0 (corner 0 to 3) or f1:29/0")
    marker = int(match["marker"])
    boards = [b.id for b in rig.boards if any(m.id == marker for m in b.markers)]
    if match["board"] is not None:
        boards = [b for b in boards if b == match["board"]]
    if not boards:
        raise RigError(f"{text!r}: there is no such marker in the rig")
    if len(boards) > 1:
        raise RigError(f"{text!r}: marker {marker} stands on boards {', '.join(boards)}; write {boards[0]}:{text}")
    corner = match["corner"]
    return MarkerPoint(boards[0], marker, None if corner is None else int(corner))
