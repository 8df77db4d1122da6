"""How a reference patch is stretched and turned in the present images, from the motion."""

import numpy as np

from ...factors.camera import CameraModel
from ..undistort import distortion_jacobian
from .geometry import Float, StereoGeometry, project


def transform_each(a_T_b: Float, b_p: Float) -> Float:
    """Points (n, 3), each with a pose (n, 4, 4) of its own."""
    return (a_T_b[:, :3, :3] @ b_p[:, :, None])[:, :, 0] + a_T_b[:, :3, 3]


def inverse_each(poses: Float) -> Float:
    """Inverses of poses (n, 4, 4)."""
    out = np.zeros_like(poses)
    rotation = poses[:, :3, :3].transpose(0, 2, 1)
    out[:, :3, :3] = rotation
    out[:, :3, 3] = -(rotation @ poses[:, :3, 3, None])[:, :, 0]
    out[:, 3, 3] = 1.0
    return out


def linear_warps(patch_points: Float, this_T_patch: Float, rig: StereoGeometry) -> tuple[Float, Float]:
    """Derivatives (n, 2, 2) of the left and the right raw pixels by the reference patch's raw pixels.

    The surface is taken to face the camera that saw the patch. Identity where the point has no depth.

    Args:
        patch_points: (n, 3), in the left camera that saw the patch; NaN without depth.
        this_T_patch: (n, 4, 4), pose of that camera in this left camera.
        rig: nominal geometry.
    """
    known = np.asarray(np.isfinite(patch_points).all(axis=1))
    points = np.where(known[:, None], patch_points, [0.0, 0.0, 1.0])
    moved = np.zeros((3, len(points), 3))
    moved[:] = points
    moved[1, :, 0] += points[:, 2] / rig.left.fx
    moved[2, :, 1] += points[:, 2] / rig.left.fy
    here = np.stack([transform_each(this_T_patch, corner) for corner in moved])
    warps = []
    for camera, seen in ((rig.left, here), (rig.right, here @ rig.right_T_left[:3, :3].T + rig.right_T_left[:3, 3])):
        px = np.stack([project(corner, camera) for corner in seen])
        warp = np.stack((px[1] - px[0], px[2] - px[0]), axis=2)
        warp = _with_lens(warp, px[0], project(points, rig.left), camera, rig.left)
        determinant = np.linalg.det(np.nan_to_num(warp))
        usable = known & np.isfinite(warp).all(axis=(1, 2)) & (determinant > 0.1) & (determinant < 10.0)
        warps.append(np.where(usable[:, None, None], warp, np.eye(2)))
    return warps[0], warps[1]


def _with_lens(warp: Float, px: Float, patch_px: Float, camera: CameraModel, patch_camera: CameraModel) -> Float:
    """The warp between raw pixels from the one between ideal pixels."""
    if not np.any(camera.D) and not np.any(patch_camera.D):
        return warp
    here = distortion_jacobian(camera, np.nan_to_num(px))
    there = distortion_jacobian(patch_camera, patch_px)
    return here @ warp @ np.linalg.inv(there)
