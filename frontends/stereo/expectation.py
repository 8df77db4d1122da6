"""Where the tracks should be in the next image, by how the camera moves."""

import numpy as np

from ...factors.camera import CameraModel
from ..undistort import distort
from .geometry import Float, inverse, project, transform
from .tracks import Tracks

_FARTHEST = 0.3
"""Share of the image's diagonal beyond which no flow is expected."""


def expected_flow(tracks: Tracks, left: CameraModel, keyframe_T_last: Float, keyframe_T_this: Float) -> Float:
    """Expected raw pixels (n, 2): points move with the camera, the rest as the median of them."""
    before = distort(left, project(transform(inverse(keyframe_T_last), tracks.points), left))
    after = distort(left, project(transform(inverse(keyframe_T_this), tracks.points), left))
    shift = after - before
    known = np.isfinite(shift).all(axis=1)
    if not known.all():
        shift[~known] = np.median(shift[known], axis=0) if known.any() else 0.0
    most = _FARTHEST * float(np.hypot(left.width, left.height))
    return tracks.raw_px + np.clip(shift, -most, most)
