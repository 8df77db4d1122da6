"""Known distances between marker points: each enters when both of its points are in the graph."""

from ..factors import keys
from ..factors.board import distance_factor
from ..factors.noise import sigmas
from ..factors.rig import Distance, Rig
from .boards import DISTANCES, Boards
from .graph import Record, State, Update
from .marker_points import MarkerPoint, parse_point


def distance_name(distance: Distance) -> str:
    """How the factor of a known distance is called in its record."""
    return f"distance {distance.point_a} to {distance.point_b}"


class KnownDistances:
    """The distances of the rig file, and which of them have not entered so far."""

    def __init__(self, rig: Rig, state: State, boards: Boards) -> None:
        self._rig = rig
        self._state = state
        self._boards = boards
        self.open: list[Distance] = list(rig.distances)
        """Those of which a point has not been seen."""

    def close(self, stamp_ns: int) -> Update:
        """Factors of those whose points have both been seen by now."""
        still, update = [], Update()
        for distance in self.open:
            a, b = (self.point_keys(parse_point(text, self._rig)) for text in (distance.point_a, distance.point_b))
            if a is None or b is None:
                still.append(distance)
                continue
            what = distance_name(distance)
            record = Record(DISTANCES, what, stamp_ns, what, rejectable=False)
            update.add(distance_factor(a, b, distance.distance_m, sigmas([distance.sigma_m])), record)
        self.open = still
        return update

    def point_keys(self, point: MarkerPoint) -> list[int] | None:
        """Keys of the corners whose mean a marker point is, None while it has not been seen."""
        slot = self._boards.slot_of(point.board, point.marker)
        if slot is None or not self._state.has(keys.corner(slot, 0)):
            return None
        corners = range(4) if point.corner is None else [point.corner]
        return [keys.corner(slot, i) for i in corners]
