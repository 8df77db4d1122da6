"""How a reference patch is stretched and turned in the present images, from the motion."""

import numpy as np

from ...factors.camera import CameraModel
from ..undistort import distortion_jacobian
from .geometry import Float, StereoGeometry, project

_NEAREST = 0.2
"""A patch that is nearer than that share of its first distance is taken as not bent: its view is another one."""
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


def linear_warps(patch_points: Float, slopes: Float, this_T_patch: Float, rig: StereoGeometry) -> tuple[Float, Float]:
    """Derivatives (n, 2, 2) of the left and the right raw pixels by the reference patch's raw pixels.

    Identity where the point has no depth.

    Args:
        patch_points: (n, 3), in the left camera that saw the patch; NaN without depth.
        slopes: (n, 2), relative change of the inverse depth per pixel; zero for a surface that faces the camera.
        this_T_patch: (n, 4, 4), pose of that camera in this left camera.
        rig: nominal geometry.
    """
    known = np.asarray(np.isfinite(patch_points).all(axis=1))
    points = np.where(known[:, None], patch_points, [0.0, 0.0, 1.0])
    moved = np.zeros((3, len(points), 3))
    moved[:] = points
    moved[1, :, 0] += points[:, 2] / rig.left.fx
    moved[2, :, 1] += points[:, 2] / rig.left.fy
    moved[1] /= 1.0 + slopes[:, :1]
    moved[2] /= 1.0 + slopes[:, 1:]
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


def curvatures(patch_points: Float, slopes: Float, this_T_patch: Float, rig: StereoGeometry) -> tuple[Float, Float]:
    """How much the views of patches are bent beyond their linear warps: c (n, 2) in left and right image, 1/px.

    A patch that is turned away is not only stretched but bent: what lies at d in the reference lies at
    `W (d + (c . d) d)` now. The best linear fit is off in the middle then, by `W bend c` (`Patches.bend`: that depends
    on where the patch has its edges). A hundredth of a pixel, but to the same side all over that side of the image: it
    would look like another focal length or centre. (The lens's own bend is left out: it is smaller.)

    Args:
        patch_points, slopes, this_T_patch, rig: as for `linear_warps`.
    """
    known = np.asarray(np.isfinite(patch_points).all(axis=1))
    points = np.where(known[:, None], patch_points, [0.0, 0.0, 1.0])
    found = []
    for turn, shift in (
        (this_T_patch[:, 2, :3], this_T_patch[:, 2, 3]),
        (rig.right_T_left[2, :3] @ this_T_patch[:, :3, :3], this_T_patch[:, :3, 3] @ rig.right_T_left[2, :3]),
    ):
        step = shift + (rig.right_T_left[2, 3] if found else 0.0)
        # Depth here over depth there, and its derivative by the pixels there.
        ratio = ((turn * points).sum(axis=1) + step) / points[:, 2]
        ahead = known & (ratio > _NEAREST)
        slope = turn[:, :2] / (rig.left.fx, rig.left.fy) + slopes * (step / points[:, 2])[:, None]
        found.append(np.where(ahead[:, None], -slope / np.where(ahead, ratio, 1.0)[:, None], 0.0))
    return found[0], found[1]


def bend_offsets(warp: Float, bend: Float, curvature: Float) -> Float:
    """How far (n, 2) the best fits of patches lie from their centres' own places.

    Args:
        warp: (n, 2, 2), linear warps.
        bend: (n, 2, 2), of the patches.
        curvature: (n, 2).
    """
    offset = (warp @ (bend @ curvature[:, :, None]))[:, :, 0]
    usable = np.abs(offset).max(axis=1, initial=0.0) < _LARGEST_OFFSET_PX
    return np.where(usable[:, None], offset, 0.0)


def _with_lens(warp: Float, px: Float, patch_px: Float, camera: CameraModel, patch_camera: CameraModel) -> Float:
    """The warp between raw pixels from the one between ideal pixels."""
    if not np.any(camera.D) and not np.any(patch_camera.D):
        return warp
    here = distortion_jacobian(camera, np.nan_to_num(px))
    there = distortion_jacobian(patch_camera, patch_px)
    return here @ warp @ np.linalg.inv(there)
