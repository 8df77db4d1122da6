"""How a reference patch is stretched and turned in the present images, from the motion."""

import numpy as np

from ...factors.camera import CameraModel
from ..undistort import distortion_jacobian
from .geometry import Float, StereoGeometry, project

_BEND_STEP_PX = 3.0
_LARGEST_OFFSET_PX = 0.3
"""Beyond it the view differs so much that a bent patch is no description."""


def transform_each(a_T_b: Float, b_p: Float) -> Float:
    """Points (..., n, 3), each with a pose (n, 4, 4) of its own."""
    return (a_T_b[:, :3, :3] @ b_p[..., None])[..., 0] + a_T_b[:, :3, 3]


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
    here = transform_each(this_T_patch, moved)
    warps = []
    for camera, seen in ((rig.left, here), (rig.right, here @ rig.right_T_left[:3, :3].T + rig.right_T_left[:3, 3])):
        px = project(seen, camera)
        warp = np.stack((px[1] - px[0], px[2] - px[0]), axis=2)
        warp = _with_lens(warp, px[0], project(points, rig.left), camera, rig.left)
        determinant = warp[:, 0, 0] * warp[:, 1, 1] - warp[:, 0, 1] * warp[:, 1, 0]
        usable = known & np.isfinite(warp).all(axis=(1, 2)) & (determinant > 0.1) & (determinant < 10.0)
        warps.append(np.where(usable[:, None, None], warp, np.eye(2)))
    return warps[0], warps[1]


def warp_offsets(
    patch_points: Float, this_T_patch: Float, rig: StereoGeometry, moment_px2: float
) -> tuple[Float, Float]:
    """How far (n, 2) a patch's best fit lies from its centre's own place, in left and right pixels.

    A patch that is turned away is not only stretched but bent: the best linear warp is off in the middle by half the
    curvature times the second moment of the patch's weights. A hundredth of a pixel, but to the same side all over
    that side of the image: it would look like another focal length. (The lens's own bend is left out: it is smaller.)

    Args:
        patch_points, this_T_patch, rig: as for `linear_warps`.
        moment_px2: of the weights along either axis.
    """
    known = np.asarray(np.isfinite(patch_points).all(axis=1))
    points = np.where(known[:, None], patch_points, [0.0, 0.0, 1.0])
    step = _BEND_STEP_PX * points[:, 2, None] * np.array([1.0 / rig.left.fx, 1.0 / rig.left.fy])
    moved = np.broadcast_to(points, (5, len(points), 3)).copy()
    moved[1, :, 0] += step[:, 0]
    moved[2, :, 0] -= step[:, 0]
    moved[3, :, 1] += step[:, 1]
    moved[4, :, 1] -= step[:, 1]
    here = transform_each(this_T_patch, moved)
    offsets = []
    for camera, seen in ((rig.left, here), (rig.right, here @ rig.right_T_left[:3, :3].T + rig.right_T_left[:3, 3])):
        px = project(seen, camera)
        offset = 0.5 * moment_px2 / _BEND_STEP_PX**2 * (px[1:].sum(axis=0) - 4.0 * px[0])
        usable = known & np.isfinite(offset).all(axis=1) & (np.abs(offset) < _LARGEST_OFFSET_PX).all(axis=1)
        offsets.append(np.where(usable[:, None], offset, 0.0))
    return offsets[0], offsets[1]


def _with_lens(warp: Float, px: Float, patch_px: Float, camera: CameraModel, patch_camera: CameraModel) -> Float:
    """The warp between raw pixels from the one between ideal pixels."""
    if not np.any(camera.D) and not np.any(patch_camera.D):
        return warp
    here = distortion_jacobian(camera, np.nan_to_num(px))
    there = distortion_jacobian(patch_camera, patch_px)
    return here @ warp @ np.linalg.inv(there)
