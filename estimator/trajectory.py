"""The mobile camera's path: keyframes as the graph has them, and the frames in between."""

from collections.abc import Collection, Iterable, Mapping
from dataclasses import replace

import gtsam
import numpy as np
from numpy.typing import NDArray

from ..factors import keys
from ..factors.geometry import pose3, ros_covariance
from .odometry import FramePose, Odometry, SeenTracks
from .resection import Map, resected
from .result import PoseEstimate

Float = NDArray[np.float64]


def trajectory(
    odometry: Odometry, values: gtsam.Values, only: Collection[int] | None = None
) -> tuple[PoseEstimate, ...]:
    """Every frame's `o_T_m` in the order of time.

    The front end's own motion since the last keyframe rests on nominal calibration and on points that one pair has
    measured; the map that the graph has made of many is several times better. Frames that have seen nothing lie between
    those that have.

    Args:
        only: keyframes, by index, whose frames are meant; None: all.
    """
    meant = [f for f in odometry.frames if only is None or f.keyframe in only]
    seen = [f.tracks.ids for f in meant if f.tracks is not None]
    known = Map.of(values, np.concatenate(seen) if seen else np.zeros(0, np.int64))
    frames = sorted(meant, key=lambda f: f.stamp_ns)
    placed = _bridged([f.stamp_ns for f in frames], _placed(frames, odometry, values, known))
    return tuple(
        PoseEstimate("m", "o", frame.stamp_ns, pose.matrix(), None) for frame, pose in zip(frames, placed, strict=True)
    )


def with_covariances(path: Iterable[PoseEstimate], covariances: Mapping[int, Float]) -> tuple[PoseEstimate, ...]:
    """Keyframes have one.

    Args:
        covariances: of keyframes, (6, 6) each, rotation first, body frame, by stamp, ns.
    """
    found = []
    for pose in path:
        covariance = covariances.get(pose.stamp_ns)
        found.append(
            pose if covariance is None else replace(pose, covariance=ros_covariance(pose3(pose.matrix), covariance))
        )
    return tuple(found)


def _placed(frames: list[FramePose], odometry: Odometry, values: gtsam.Values, known: Map) -> list[gtsam.Pose3 | None]:
    """Keyframes by the graph, any other frame by its tracks in the map; None where it has seen nothing."""
    poses: list[gtsam.Pose3 | None] = []
    between: dict[int, SeenTracks] = {}
    for i, frame in enumerate(frames):
        pose = values.atPose3(keys.keyframe(frame.keyframe))
        if odometry.keyframe_stamps[frame.keyframe] == frame.stamp_ns:
            poses.append(pose)
        elif frame.tracks is None:
            poses.append(None)
        else:
            poses.append(pose.compose(pose3(frame.keyframe_T_this)))
            between[i] = frame.tracks
    guesses = [pose.matrix() for i in between if (pose := poses[i]) is not None]
    found, held = resected(np.array(guesses).reshape(-1, 4, 4), list(between.values()), known)
    for i, pose, sure in zip(between, found, held, strict=True):
        if sure:
            poses[i] = gtsam.Pose3(gtsam.Rot3(pose[:3, :3]), pose[:3, 3])
    return poses


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
