"""Does the stereo pair still stand as the map says? The right image shows it at once, long before the graph follows."""

from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray

from ...factors import keys
from ...factors.camera import CameraModel
from ...factors.geometry import pose3
from ...factors.measurements import Event, StereoFrame
from ...frontends.resection import camera_pose
from ..engine import Engine

Float = NDArray[np.float64]

FEWEST = 8
SEEN_BEFORE = 3
"""Keyframes that a landmark has been seen in, so that its depth is known by more than the pair as it stands now."""
LEFT_PX = 1.0
"""Largest median reprojection error in the left image of a pose that is believed."""
LIMIT_PX, LIMIT_SIGMA = 0.3, 8.0
"""Both have to be passed. Among the keyframes of 40 rendered recordings the farthest was off by 0.11 px."""
LEAST_SHARE, SOUND_SHARE = 0.05, 0.5
"""Of the landmarks whose place is in the right image, those that it shows: mostly three quarters. And of the features
that are no landmarks: with fewer it is the right image that is covered."""
RIM = 0.04
"""Of the image's width: nearer to the rim nothing is found."""
TOLD_NS = 60_000_000_000
"""So long, by stamp, a departure is told: by then the graph is half-way between what the pair was and what it is."""


@dataclass(frozen=True, slots=True)
class Departure:
    """By how much the right image is off from where the map and the left image put it."""

    shift_px: Float
    """Shape (2,), median over the landmarks; NaN where the right image does not show them."""
    sigma_px: Float
    """Shape (2,), of that median, from their spread."""

    def told(self) -> str | None:
        """What is wrong, None where nothing is."""
        if np.isnan(self.shift_px).any():
            return (
                "the right image of the mobile camera shows nothing of the map where the left one says; look whether "
                "its lens is covered and both cameras are firm, and calibrate again"
            )
        limit = np.maximum(LIMIT_PX, LIMIT_SIGMA * self.sigma_px)
        if (np.abs(self.shift_px) < limit).all():
            return None
        u, v = self.shift_px
        return (
            f"the right image of the mobile camera has moved by ({u:+.2f}, {v:+.2f}) px against the left one; "
            "look whether both cameras are firm, calibrate again and begin anew"
        )


class Drift:
    """Watches the keyframes of one engine."""

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        self.suspects: tuple[Event, ...] = ()

    def see(self, frame: StereoFrame | None) -> bool:
        """A frame, before the graph takes it; True when what is suspected has changed."""
        if frame is None or not frame.is_keyframe:
            return False
        found = departure(self._engine, frame)
        text = None if found is None else found.told()
        if found is not None and text is not None:
            u, v = (float(x) for x in np.nan_to_num(found.shift_px))
            values = {"right_u_px": u, "right_v_px": v}
            self.suspects = (Event(frame.stamp_ns, "calibration_drift", text, "error", values),)
            return True
        kept = tuple(event for event in self.suspects if 0 <= frame.stamp_ns - event.stamp_ns < TOLD_NS)
        self.suspects, before = kept, self.suspects
        return kept != before


def departure(engine: Engine, frame: StereoFrame) -> Departure | None:
    """Of a keyframe that is not in the graph yet; None where too few landmarks show it."""
    state, counts = engine.state, engine.odometry.observations
    rows = [
        row
        for row, track in enumerate(frame.track_ids.tolist())
        if counts.get(track, 0) >= SEEN_BEFORE and state.has(keys.landmark(track))
    ]
    if len(rows) < FEWEST:
        return None
    points = np.array([state.point(keys.landmark(int(frame.track_ids[row]))) for row in rows])
    found = camera_pose(points, frame.left_px[rows], _K(engine, "m_left"))
    if found is None or found[1] > LEFT_PX:
        return None
    expected, off = _apart(engine, frame, points, rows, pose3(found[0]))
    shown = np.asarray(np.isfinite(frame.right_px).all(axis=1))
    inside = _inside(expected, engine.cameras["m_right"])
    others = np.append(np.delete(shown, rows), False)
    if inside.sum() >= FEWEST and shown[rows][inside].mean() < LEAST_SHARE and others.mean() > SOUND_SHARE:
        return Departure(np.full(2, np.nan), np.full(2, np.nan))
    off = off[np.isfinite(off).all(axis=1)]
    if len(off) < FEWEST:
        return None
    shift = np.median(off, axis=0)
    spread = 1.4826 * np.median(np.abs(off - shift), axis=0)
    return Departure(shift, 1.2533 * spread / np.sqrt(len(off)))


def _apart(
    engine: Engine, frame: StereoFrame, points: Float, rows: list[int], o_T_left: gtsam.Pose3
) -> tuple[Float, Float]:
    """Where the right image should show the points, px (n, 2), and the residuals there less those in the left one: what
    the pose has wrong is in both."""
    o_T_right = o_T_left.compose(engine.state.pose(keys.extrinsics("m_right")))
    left = frame.left_px[rows] - _projected(points, o_T_left, _K(engine, "m_left"))
    right = _projected(points, o_T_right, _K(engine, "m_right"))
    return right, frame.right_px[rows] - right - left


def _inside(px: Float, camera: CameraModel) -> NDArray[np.bool_]:
    rim, size = RIM * camera.width, np.array([camera.width, camera.height])
    return np.asarray(((px > rim) & (px < size - rim)).all(axis=1))


def _K(engine: Engine, camera: str) -> Float:
    return engine.state.intrinsics(keys.intrinsics(camera)).K()


def _projected(points: Float, o_T_c: gtsam.Pose3, K: Float) -> Float:
    """Ideal pixels (n, 2) of points (n, 3); NaN behind the camera."""
    c_p = (points - o_T_c.translation()) @ o_T_c.rotation().matrix()
    px = c_p @ K.T
    return px[:, :2] / np.where(c_p[:, 2:] > 0.05, px[:, 2:], np.nan)
