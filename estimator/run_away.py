"""Landmarks that have run away: wrong matches drove them to where the two images of a pair no longer differ.

Nothing holds them there, and nothing brings them back. The farther they get the less is known of them, until numbers
no longer hold it beside what is known of the rest; the elimination then fails, at whatever variable comes next.
"""

from collections.abc import Collection

import gtsam
import numpy as np
from numpy.typing import NDArray

from ..factors import keys
from .graph import State

Float = NDArray[np.float64]

DISPARITY_PX = 0.25
"""What can be told from none in a pair of images, at best. Landmarks begin with four times as much."""
NOWHERE_M = 1e5
"""From the origin: there is no landmark there, whatever the cameras."""


def run_away(state: State) -> set[int]:
    """Landmarks farther from every keyframe than a pair of images can tell; none without a pair."""
    right, left = keys.extrinsics("m_right"), keys.intrinsics("m_left")
    marks, points = _of_kind(state.values, "l")
    _, places = _of_kind(state.values, "x")
    if not marks or not len(places) or not (state.has(right) and state.has(left)):
        return set()
    reach_m = state.intrinsics(left).fx() * float(np.linalg.norm(state.pose(right).translation())) / DISPARITY_PX
    nearest = np.full(len(points), np.inf)
    for place in places:
        nearest = np.minimum(nearest, np.linalg.norm(points - place, axis=1))
    return {key for key, near in zip(marks, ~(nearest <= reach_m), strict=True) if near}


def blamed(key: int, values: gtsam.Values, passed_over: Collection[int] = ()) -> int:
    """The variable to give up where an elimination has failed at `key`: the landmark that is nowhere, if there is one.

    Args:
        passed_over: landmarks that were not in the system.
    """
    marks, points = _of_kind(values, "l")
    distance = np.nan_to_num(np.linalg.norm(points, axis=1), nan=np.inf)
    far = [(d, mark) for d, mark in zip(distance, marks, strict=True) if d > NOWHERE_M and mark not in passed_over]
    return max(far)[1] if far else key


def _of_kind(values: gtsam.Values, kind: str) -> tuple[list[int], Float]:
    """Keys of landmarks or keyframes, and where they are, shape (n, 3)."""
    found = [key for key in values.keys() if keys.kind(key) == kind]
    where = [values.atPoint3(key) if kind == "l" else values.atPose3(key).translation() for key in found]
    return found, np.reshape(np.asarray(where, np.float64), (-1, 3))
