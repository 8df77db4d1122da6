"""A part of the map of which only the shape is known: what was seen between two losses of sight."""

from dataclasses import dataclass

import gtsam

from ..factors import keys

POSES = "xfb"
POINTS = "lqpuv"


@dataclass(slots=True)
class Strand:
    """Keyframes, and all that hangs on them, behind a motion prior."""

    own: set[int]
    """Its variables."""
    first: int
    """Key of its first keyframe."""
    last: int
    """Key of its newest one."""
    lost_ns: int
    """When sight was lost before it."""
    last_ns: int
    """Its newest keyframe."""

    def moved(self, values: gtsam.Values, correction: gtsam.Pose3) -> gtsam.Values:
        """All values, with those of the strand moved in {o}."""
        result = gtsam.Values(values)
        for key in self.own:
            kind = keys.kind(key)
            if not values.exists(key):
                continue  # it has left the graph
            if kind in POSES:
                result.update(key, correction.compose(values.atPose3(key)))
            elif kind in POINTS:
                result.update(key, correction.transformFrom(values.atPoint3(key)))
        return result

    def join(self, older: "Strand") -> None:
        """The other one turns out to hang together with this one."""
        self.own |= older.own
        if older.lost_ns < self.lost_ns:
            self.lost_ns, self.first = older.lost_ns, older.first
        if older.last_ns > self.last_ns:
            self.last_ns, self.last = older.last_ns, older.last
