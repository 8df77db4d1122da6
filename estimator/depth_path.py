"""A recording's depth images alone: the path of the depth camera, without boards, picks or a mobile camera."""

from collections.abc import Iterator
from pathlib import Path

from scipy.spatial.transform import Rotation

from ..factors.rig import Rig
from ..frontends.cloud.depth_odometry import DepthOdometry, DepthPose
from .depth_clouds import depth_clouds


def depth_path(log: Path, rig: Rig) -> Iterator[DepthPose]:
    """Poses of the depth camera in the frame of its first image, one per image or cloud.

    Raises:
        LogError: no depth image and no cloud, or an image before its calibration.
    """
    odometry = DepthOdometry()
    for cloud in depth_clouds(log, rig):
        yield odometry.add(cloud)


def tum_line(pose: DepthPose) -> str:
    """One line of a TUM trajectory: seconds, translation, quaternion x y z w."""
    seconds, rest = divmod(pose.stamp_ns, 1_000_000_000)
    x, y, z = pose.first_T_this[:3, 3]
    q = Rotation.from_matrix(pose.first_T_this[:3, :3]).as_quat()
    return f"{seconds}.{rest:09d} {x:.9f} {y:.9f} {z:.9f} " + " ".join(f"{v:.9f}" for v in q)
