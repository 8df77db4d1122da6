"""Right match of new features: correlation along the nominal epipolar line, with room for a rig that is off."""

import cv2
import numpy as np
from numpy.typing import NDArray

from ..undistort import distort
from .geometry import Float, StereoGeometry, project, rays

Image = NDArray[np.uint8]
Bool = NDArray[np.bool_]

_RIVAL = 0.04
"""A second peak within this correlation of the best makes a match ambiguous (repeating bricks)."""


def search_right(
    left: Image,
    right: Image,
    left_raw_px: Float,
    left_px: Float,
    rig: StereoGeometry,
    nearest_m: float,
    gate_px: float,
    radius_px: int,
    min_correlation: float,
) -> Float:
    """Whole-pixel right positions (n, 2) of left features, NaN where there is none or where two places fit alike.

    Args:
        left: grey left image.
        right: grey right image.
        left_raw_px: (n, 2), features in the left image.
        left_px: (n, 2), the same as ideal pixels.
        rig: nominal geometry.
        nearest_m: depth of the near end of the search.
        gate_px: half height of the searched strip about the epipolar line, and reach beyond infinity.
        radius_px: half size of the patch.
        min_correlation: smallest accepted correlation.
    """
    direction = rays(left_px, rig.left)
    far = distort(rig.right, project(direction @ rig.right_T_left[:3, :3].T, rig.right))
    near = distort(rig.right, project(rig.right_points(direction * nearest_m), rig.right))
    # A ray that leaves the lens model's field on the near side is searched up to the rim of the image.
    near = np.where(np.isfinite(near), near, np.clip(far - [rig.right.width, 0.0], 0.0, None))
    found = np.full((len(left_px), 2), np.nan)
    for i in range(len(left_px)):
        if np.isfinite(far[i]).all():
            found[i] = _search(left, right, left_raw_px[i], far[i], near[i], gate_px, radius_px, min_correlation)
    return found


def _search(
    left: Image, right: Image, px: Float, far: Float, near: Float, gate: float, radius: int, min_correlation: float
) -> Float:
    u, v = (round(value) for value in px.tolist())
    template = left[max(v - radius, 0) : v + radius + 1, max(u - radius, 0) : u + radius + 1]
    if template.shape != (2 * radius + 1, 2 * radius + 1):
        return np.full(2, np.nan)
    low = np.floor(np.minimum(far, near) - gate).astype(int) - radius
    high = np.ceil(np.maximum(far, near) + gate).astype(int) + radius
    low, high = np.maximum(low, 0), np.minimum(high, (right.shape[1] - 1, right.shape[0] - 1))
    strip = right[low[1] : high[1] + 1, low[0] : high[0] + 1]
    if strip.shape[0] < template.shape[0] or strip.shape[1] < template.shape[1]:
        return np.full(2, np.nan)
    correlation = cv2.matchTemplate(strip, template, cv2.TM_CCOEFF_NORMED)
    _, best, _, place = cv2.minMaxLoc(correlation)
    if best < min_correlation:
        return np.full(2, np.nan)
    column = correlation.max(axis=0)
    column[max(place[0] - 3, 0) : place[0] + 4] = -1.0
    if column.size and column.max() > best - _RIVAL:
        return np.full(2, np.nan)
    fraction = px - (u, v)
    return np.array([place[0] + low[0] + radius, place[1] + low[1] + radius]) + fraction
