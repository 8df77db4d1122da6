"""How the mobile camera moved from second to second, with covariances from the joint of both keyframes."""

from collections.abc import Mapping, Sequence

import gtsam
import numpy as np
from numpy.typing import NDArray

from ..factors import keys
from ..factors.geometry import ros_covariance
from .linear import LinearSystem
from .result import MotionEstimate

Float = NDArray[np.float64]

WINDOW_NS = 1_000_000_000
MOST = 60
"""Windows of one result, evenly spread: a sample tells as much about the covariances as all of an hour's."""


def motions(values: gtsam.Values, system: LinearSystem, keyframes: Mapping[int, int]) -> tuple[MotionEstimate, ...]:
    """Motions between keyframes that are a second apart or a little more, one after the other.

    Their covariances are from the joint of both poses: errors that they share cancel in the motion between them.

    Args:
        values: the estimate.
        system: its linear system.
        keyframes: index and stamp, ns, of those in the estimate.
    """
    index, stamps_ns = [*keyframes], [*keyframes.values()]
    pairs = windows(stamps_ns)
    if len(pairs) > MOST:
        pairs = [pairs[i] for i in np.linspace(0, len(pairs) - 1, MOST).round().astype(int)]
    ends = [(keys.keyframe(index[first]), keys.keyframe(index[last])) for first, last in pairs]
    covariances = system.covariances([motion_blocks(values, before, after) for before, after in ends])
    found = []
    for (first, last), (before, after), covariance in zip(pairs, ends, covariances, strict=True):
        motion = values.atPose3(before).between(values.atPose3(after))
        covariance = ros_covariance(motion, covariance)
        found.append(MotionEstimate(stamps_ns[first], stamps_ns[last], motion.matrix(), covariance))
    return tuple(found)


def windows(stamps_ns: Sequence[int]) -> list[tuple[int, int]]:
    """Indices of keyframes at the ends of windows that follow each other."""
    order = sorted(range(len(stamps_ns)), key=lambda index: stamps_ns[index])
    found, first = [], 0
    for last in range(1, len(order)):
        if stamps_ns[order[last]] - stamps_ns[order[first]] >= WINDOW_NS:
            found.append((order[first], order[last]))
            first = last
    return found


def motion_blocks(values: gtsam.Values, before: int, after: int) -> list[tuple[int, Float]]:
    """Jacobian of the pose of one keyframe in another: in the body frames xi = xi_after - Ad(motion^-1) xi_before."""
    motion = values.atPose3(before).between(values.atPose3(after))
    return [(before, -motion.inverse().AdjointMap()), (after, np.eye(6))]
