"""Right match of new features: correlation along the nominal epipolar line, with room for a rig that is off."""

import cv2
import numpy as np

from ..undistort import distort
from .flow import Image, inside
from .geometry import Float, StereoGeometry, project, rays

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
    centre = np.rint(left_raw_px).astype(int)
    limit = np.array([right.shape[1], right.shape[0]])
    with np.errstate(invalid="ignore"):
        ends = np.nan_to_num(np.stack((far, near)), nan=-1e6)
        low = np.maximum(np.floor(ends.min(axis=0) - gate_px).astype(int) - radius_px, 0)
        high = np.minimum(np.ceil(ends.max(axis=0) + gate_px).astype(int) + radius_px + 1, limit)
    usable = np.isfinite(far).all(axis=1) & ((high - low) > 2 * radius_px).all(axis=1)
    usable &= inside(centre.astype(np.float64), left.shape, radius_px)
    found = np.full((len(left_px), 2), np.nan)
    for i in np.flatnonzero(usable).tolist():
        u, v = centre[i].tolist()
        template = left[v - radius_px : v + radius_px + 1, u - radius_px : u + radius_px + 1]
        place = _best(right[low[i, 1] : high[i, 1], low[i, 0] : high[i, 0]], template, min_correlation)
        if place is not None:
            found[i] = place
    return found + low + radius_px + (left_raw_px - centre)


def _best(strip: Image, template: Image, min_correlation: float) -> tuple[int, int] | None:
    """Column and row of the one place in the strip that the template fits."""
    correlation = cv2.matchTemplate(strip, template, cv2.TM_CCOEFF_NORMED)
    _, best, _, (column, row) = cv2.minMaxLoc(correlation)
    if best < min_correlation:
        return None
    rivals = correlation.max(axis=0)
    rivals[max(column - 3, 0) : column + 4] = -1.0
    return None if rivals.max() > best - _RIVAL else (column, row)
