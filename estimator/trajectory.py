"""The mobile camera's path: keyframes as the graph has them, and the frames in between."""

import gtsam
import numpy as np
from numpy.typing import NDArray

from ..factors import keys
from ..factors.geometry import pose3, ros_covariance
from .odometry import FramePose, Odometry
from .resection import Map, resected
from .result import PoseEstimate

Float = NDArray[np.float64]


def trajectory(odometry: Odometry, values: gtsam.Values, covariances: list[Float]) -> tuple[PoseEstimate, ...]:
    """Every frame's `o_T_m` in the order of time; keyframes have a covariance.

    The front end's own motion since the last keyframe rests on nominal calibration and on points that one pair has
    measured; the map that the graph has made of many is several times better. Frames that have seen nothing lie between
    those that have.

    Args:
        covariances: of all keyframes, (6, 6) each, rotation first, body frame.
    """
    seen = [f.tracks.ids for f in odometry.frames if f.tracks is not None]
    known = Map.of(values, np.concatenate(seen) if seen else np.zeros(0, np.int64))
    frames = sorted(odometry.frames, key=lambda f: f.stamp_ns)
    placed = _bridged([f.stamp_ns for f in frames], [_placed(f, odometry, values, known) for f in frames])
    poses = []
    for frame, pose in zip(frames, placed, strict=True):
        own = odometry.keyframe_stamps[frame.keyframe] == frame.stamp_ns
        covariance = ros_covariance(pose, covariances[frame.keyframe]) if own else None
        poses.append(PoseEstimate("m", "o", frame.stamp_ns, pose.matrix(), covariance))
    return tuple(poses)


def _placed(frame: FramePose, odometry: Odometry, values: gtsam.Values, known: Map) -> gtsam.Pose3 | None:
    """A keyframe by the graph, any other by its tracks in the map; None where it has seen nothing."""
    o_T_k = values.atPose3(keys.keyframe(frame.keyframe))
    if odometry.keyframe_stamps[frame.keyframe] == frame.stamp_ns:
        return o_T_k
    if frame.tracks is None:
        return None
    guess = o_T_k.compose(pose3(frame.keyframe_T_this))
    found = resected(guess, frame.tracks, known)
    return guess if found is None else found


def _bridged(stamps_ns: list[int], poses: list[gtsam.Pose3 | None]) -> list[gtsam.Pose3]:
    """Straight on from the last frame that has seen something to the next one; after the last one it stands still."""
    seen = [i for i, pose in enumerate(poses) if pose is not None]
    found = []
    for i, (stamp_ns, pose) in enumerate(zip(stamps_ns, poses, strict=True)):
        if pose is None:
            after = min(int(np.searchsorted(seen, i)), len(seen) - 1)
            a, b = seen[max(after - 1, 0)], seen[after]
            share = np.clip((stamp_ns - stamps_ns[a]) / max(stamps_ns[b] - stamps_ns[a], 1), 0.0, 1.0)
            start, end = poses[a], poses[b]
            assert start is not None
            assert end is not None
            pose = start.compose(gtsam.Pose3.Expmap(share * gtsam.Pose3.Logmap(start.between(end))))
        found.append(pose)
    return found
