"""Dense stereo depth in a region of one keyframe, for the pipe and for clouds.

Semi-global matching (Hirschmueller 2008, OpenCV's SGBM) on images rectified with the calibration at hand. The
disparity's standard deviation comes from the left-right disagreement of the region itself, not from a table.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ...factors.camera import CameraModel
from ..undistort import distort, undistort
from .detection import detect
from .flow import checked_flow
from .geometry import Float, StereoGeometry, rays
from .images import Image, to_grey

Bool = NDArray[np.bool_]

_BLOCK = 5
_NEAREST_BASELINES = 2.5
_SUBPIXEL = 1.0 / 16.0
"""SGBM's disparities come in sixteenths of a pixel."""
_USUAL_EXCESS = 2.5
"""What rendered scenes show where a region has too few corners to measure it."""


@dataclass(frozen=True, slots=True)
class _Rectified:
    """A rectified view of the region: both images and how to get back."""

    left: Image
    right: Image
    left_R_rectified: Float
    focal_px: float
    centre_px: Float
    """Shape (2,), where the rectified frame's axis meets the rectified region."""


def dense_points(
    left: NDArray[np.generic],
    right: NDArray[np.generic],
    left_model: CameraModel,
    right_model: CameraModel,
    m_left_T_m_right: Float,
    roi: tuple[int, int, int, int],
) -> tuple[Float, Float, Float]:
    """Points of a region of the left image.

    Args:
        left: image (h, w) or (h, w, 3).
        right: the same size.
        left_model: intrinsics and distortion.
        right_model: the same of the right camera.
        m_left_T_m_right: (4, 4), the calibration to use; the best there is, for a wrong one bends the depth.
        roi: (u0, v0, width, height) in the left image as recorded; clipped to it.

    Returns:
        points (n, 3) in the left camera in m, their ideal left pixels (n, 2), and their standard deviations (n,)
        along the ray in m. Empty where nothing matches.
    """
    rig = StereoGeometry(left_model, right_model, m_left_T_m_right)
    corners = _region_rays(roi, left_model)
    nothing = np.zeros((0, 3)), np.zeros((0, 2)), np.zeros(0)
    if len(corners) == 0:
        return nothing
    view = _rectify(to_grey(left), to_grey(right), rig, corners)
    if view is None:
        return nothing
    disparity, sigma_px = _disparity(view, int(np.ceil(view.focal_px / _NEAREST_BASELINES)))
    v, u = np.nonzero(np.isfinite(disparity))
    depth = view.focal_px * rig.baseline_m / disparity[v, u]
    plane = np.stack((u - view.centre_px[0], v - view.centre_px[1], np.full(len(u), view.focal_px)), axis=1)
    points = (plane / view.focal_px * depth[:, None]) @ view.left_R_rectified.T
    points, px, kept = _in_region(points, roi, left_model)
    length = np.linalg.norm(points, axis=1)
    sigma_m = length * (sigma_px / disparity)[v, u][kept]
    return points, px, sigma_m


def _region_rays(roi: tuple[int, int, int, int], camera: CameraModel) -> Float:
    """Rays (n, 3) through a grid of the region."""
    u0, v0 = max(roi[0], 0), max(roi[1], 0)
    u1, v1 = min(roi[0] + roi[2], camera.width) - 1, min(roi[1] + roi[3], camera.height) - 1
    if u1 - u0 < _BLOCK or v1 - v0 < _BLOCK:
        return np.zeros((0, 3))
    u, v = np.meshgrid(np.linspace(u0, u1, 9), np.linspace(v0, v1, 9))
    px = undistort(camera, np.stack((u.ravel(), v.ravel()), axis=1))[0]
    return rays(px[np.isfinite(px).all(axis=1)], camera)


def _rectify(left: Image, right: Image, rig: StereoGeometry, corners: Float) -> _Rectified | None:
    """Both images seen by two parallel cameras with the baseline as their x axis, cut to the region."""
    x = rig.left_T_right[:3, 3] / rig.baseline_m
    forward = rig.left_T_right[:3, 2] + np.array([0.0, 0.0, 1.0])
    y = np.cross(forward, x)
    y /= np.linalg.norm(y)
    left_R_rectified = np.stack((x, y, np.cross(x, y)), axis=1)
    turned = corners @ left_R_rectified
    if (turned[:, 2] < 0.1).any():
        return None
    focal = rig.left.fx
    plane = focal * turned[:, :2] / turned[:, 2:]
    low = np.floor(plane.min(axis=0)) - _BLOCK
    size = np.ceil(plane.max(axis=0) - low).astype(int) + _BLOCK
    # The matcher leaves a strip of its search range empty on the left, and its mirrored twin on the right.
    strip = _search_range(int(np.ceil(focal / _NEAREST_BASELINES)))
    low[0] -= strip
    size[0] += 2 * strip
    u, v = np.meshgrid(np.arange(size[0], dtype=np.float64), np.arange(size[1], dtype=np.float64))
    rectified = np.stack(((u + low[0]) / focal, (v + low[1]) / focal, np.ones_like(u)), axis=2).reshape(-1, 3)
    directions = rectified @ left_R_rectified.T
    images = []
    for image, camera, turn in (
        (left, rig.left, np.eye(3)),
        (right, rig.right, rig.left_T_right[:3, :3].T),
    ):
        images.append(_resample(image, camera, directions @ turn.T, (int(size[1]), int(size[0]))))
    return _Rectified(images[0], images[1], left_R_rectified, focal, -low)


def _resample(image: Image, camera: CameraModel, directions: Float, shape: tuple[int, int]) -> Image:
    z = np.where(directions[:, 2] > 0.05, directions[:, 2], np.nan)
    ideal = directions[:, :2] / z[:, None] * (camera.fx, camera.fy) + (camera.cx, camera.cy)
    raw = np.where(np.isfinite(ideal), distort(camera, ideal), -1e4).astype(np.float32)
    raw = np.nan_to_num(raw, nan=-1e4)
    u, v = np.ascontiguousarray(raw[:, 0]).reshape(shape), np.ascontiguousarray(raw[:, 1]).reshape(shape)
    return np.asarray(cv2.remap(image, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), dtype=np.uint8)


def _search_range(largest_px: int) -> int:
    return 16 * int(np.ceil((largest_px + 1) / 16))


def _disparity(view: _Rectified, largest_px: int) -> tuple[Float, Float]:
    """Disparities (h, w), NaN where left and right disagree, and their standard deviations (h, w)."""
    count = _search_range(largest_px)
    matcher = cv2.StereoSGBM.create(
        minDisparity=0,
        numDisparities=count,
        blockSize=_BLOCK,
        P1=8 * _BLOCK**2,
        P2=32 * _BLOCK**2,
        uniquenessRatio=8,
        speckleWindowSize=60,
        speckleRange=2,
        mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )
    forth = np.asarray(matcher.compute(view.left, view.right), dtype=np.float64) * _SUBPIXEL
    # Mirrored, the right image takes the left one's part.
    back = np.asarray(matcher.compute(view.right[:, ::-1].copy(), view.left[:, ::-1].copy()), dtype=np.float64)
    back = back[:, ::-1] * _SUBPIXEL
    u = np.arange(forth.shape[1])[None, :] - np.rint(forth).astype(int)
    usable = (forth > 0.5) & (u >= 0)
    returned = np.take_along_axis(back, np.clip(u, 0, forth.shape[1] - 1), axis=1)
    difference = forth - returned
    good = usable & (returned > 0) & (np.abs(difference) < 1.0)
    disparity = np.where(good, forth, np.nan)
    spread = _spread(difference, good)
    return disparity, spread * _excess(view, disparity, spread)


def _spread(difference: Float, good: Bool) -> Float:
    """Standard deviation of the disparity (h, w) from the neighbourhood's left-right differences.

    Both matches share the smoothness that bends them, so this shows where the depth is worse, not how bad it is.
    """
    window = (2 * _BLOCK + 1, 2 * _BLOCK + 1)
    square = cv2.boxFilter(np.where(good, np.minimum(difference**2, 1.0), 0.0), -1, window)
    share = cv2.boxFilter(good.astype(np.float64), -1, window)
    return np.sqrt(square / np.maximum(share, 1e-3) + _SUBPIXEL**2)


def _excess(view: _Rectified, disparity: Float, spread: Float) -> float:
    """Factor on the spread that optical flow at corners, an independent and finer match, calls for."""
    px = detect(view.left, np.zeros((0, 2)), 150, 7.0, 10, 1.0)
    u, v = px.astype(int).T
    known = np.isfinite(disparity[v, u])
    px, here, sigma = px[known], disparity[v, u][known], spread[v, u][known]
    if len(px) < 20:
        return _USUAL_EXCESS
    start = px - np.stack((here, np.zeros(len(px))), axis=1)
    found, good = checked_flow(view.left, view.right, px, start, 11, 1, 0.3)
    good &= np.abs(found - start).max(axis=1) < 1.5
    if good.sum() < 20:
        return _USUAL_EXCESS
    ratio = (px[:, 0] - found[:, 0] - here)[good] / sigma[good]
    return max(1.4826 * float(np.median(np.abs(ratio))), 1.0)


def _in_region(points: Float, roi: tuple[int, int, int, int], camera: CameraModel) -> tuple[Float, Float, Bool]:
    ideal = points[:, :2] / points[:, 2:] * (camera.fx, camera.fy) + (camera.cx, camera.cy)
    raw = distort(camera, ideal)
    low, high = np.array(roi[:2]), np.array(roi[:2]) + roi[2:]
    with np.errstate(invalid="ignore"):
        kept = np.asarray(((raw >= low) & (raw < high)).all(axis=1))
    return points[kept], ideal[kept], kept
