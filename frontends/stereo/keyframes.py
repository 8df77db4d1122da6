"""When a stereo pair becomes a keyframe."""

import numpy as np

from .geometry import Float, median, rotation_angle
from .settings import StereoSettings


def keyframe_reason(
    flow_px: Float,
    keyframe_T_this: Float,
    tracks_now: int,
    tracks_then: int,
    diagonal_px: float,
    settings: StereoSettings,
) -> str | None:
    """Why this frame should be a keyframe; None when it need not.

    Args:
        flow_px: (n, 2), displacement of the tracks since the last keyframe.
        keyframe_T_this: (4, 4), motion since then.
        tracks_now: number of living tracks.
        tracks_then: number of tracks at the last keyframe.
        diagonal_px: of the image.
        settings: thresholds.

    A camera that stands still makes none, however few tracks it has: nothing new would come into view.
    """
    moved = median(np.hypot(flow_px[:, 0], flow_px[:, 1])) if len(flow_px) else np.inf
    if moved < settings.still_px:
        return None
    if moved > settings.keyframe_parallax * diagonal_px:
        return "parallax"
    if rotation_angle(keyframe_T_this[:3, :3]) > settings.keyframe_rotation_rad:
        return "rotation"
    if tracks_now < settings.keyframe_share * tracks_then:
        return "share"
    if tracks_now < settings.min_tracks and tracks_now < 0.9 * tracks_then:
        return "few tracks"
    return None
