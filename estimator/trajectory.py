"""The mobile camera's path: keyframes as the graph has them, and the frames in between."""

import gtsam
import numpy as np
from numpy.typing import NDArray

from ..factors import keys
from ..factors.geometry import pose3, ros_covariance
from .odometry import FramePose, Odometry
from .result import PoseEstimate

Float = NDArray[np.float64]


def trajectory(odometry: Odometry, values: gtsam.Values, covariances: list[Float]) -> tuple[PoseEstimate, ...]:
    """Every frame's `o_T_m` in the order of time; keyframes have a covariance.

    The front end has followed the frames from one keyframe to the next. By how much it came out elsewhere than the
    graph, it drifted on the way: each frame in between takes its share of that by its time.

    Args:
        covariances: of all keyframes, (6, 6) each, rotation first, body frame.
    """
    drifts = _drifts(odometry, values)
    poses = []
    for frame in sorted(odometry.frames, key=lambda f: f.stamp_ns):
        o_T_k = values.atPose3(keys.keyframe(frame.keyframe))
        own = odometry.keyframe_stamps[frame.keyframe] == frame.stamp_ns
        covariance = ros_covariance(o_T_k, covariances[frame.keyframe]) if own else None
        placed = o_T_k if own else o_T_k.compose(_corrected(frame, odometry, drifts))
        poses.append(PoseEstimate("m", "o", frame.stamp_ns, placed.matrix(), covariance))
    return tuple(poses)


def _drifts(odometry: Odometry, values: gtsam.Values) -> dict[int, tuple[int, Float]]:
    """By the keyframe that was left: stamp of the one that was come to, and the drift on the way, shape (6,)."""
    found = {}
    for index, arrival in odometry.arrivals.items():
        before_T_this = values.atPose3(keys.keyframe(arrival.before)).between(values.atPose3(keys.keyframe(index)))
        drift = gtsam.Pose3.Logmap(pose3(arrival.before_T_this).between(before_T_this))
        found[arrival.before] = odometry.keyframe_stamps[index], drift
    return found


def _corrected(frame: FramePose, odometry: Odometry, drifts: dict[int, tuple[int, Float]]) -> gtsam.Pose3:
    """`keyframe_T_frame` with the frame's share of the drift."""
    keyframe_T_this = pose3(frame.keyframe_T_this)
    if frame.keyframe not in drifts:
        return keyframe_T_this
    until_ns, drift = drifts[frame.keyframe]
    since_ns = odometry.keyframe_stamps[frame.keyframe]
    share = np.clip((frame.stamp_ns - since_ns) / max(until_ns - since_ns, 1), 0.0, 1.0)
    return keyframe_T_this.compose(gtsam.Pose3.Expmap(share * drift))
