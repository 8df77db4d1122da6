"""Poses of many frames from the map alone: where their left images show landmarks that the graph has placed."""

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ..factors import keys
from .odometry import SeenTracks

Bool = NDArray[np.bool_]
Float = NDArray[np.float64]
Int = NDArray[np.int64]

ITERATIONS = 3
"""Gauss-Newton converges within two from a few pixels; the weights need one more."""
LEAST = 12
"""Landmarks below which a frame stays where the front end has put it."""
TUKEY = 4.685
"""95 % efficiency for Gaussian residuals."""
NEAREST_M = 0.05
LOOSEST = 1e-12
"""Smallest eigenvalue of the information over its largest, at which a pose is held."""
TOGETHER = 128
"""Frames that are worked on at once: what bounds the memory."""


@dataclass(frozen=True, slots=True)
class Map:
    """The landmarks of a solved graph and the camera that sees them."""

    ids: Int
    """Shape (n,), sorted."""
    points_m: Float
    """Shape (n, 3), in {o}."""
    calibration: Float
    """Shape (9,): fx, fy, skew, u0, v0, k1, k2, p1, p2 of the left camera, as the graph has them."""

    @classmethod
    def of(cls, values: gtsam.Values, tracks: Int) -> "Map":
        """Of those of the tracks that became landmarks."""
        ids = np.array([t for t in np.unique(tracks).tolist() if values.exists(keys.landmark(t))], dtype=np.int64)
        points = np.array([values.atPoint3(keys.landmark(t)) for t in ids.tolist()]).reshape(-1, 3)
        return cls(ids, points, values.atCal3DS2(keys.intrinsics("m_left")).vector())


@dataclass(frozen=True, slots=True)
class _Seen:
    """What frames show of the map, filled up to the same number n of landmarks."""

    points_m: Float
    """Shape (frames, n, 3)."""
    px: Float
    """Shape (frames, n, 2)."""
    real: Bool
    """Shape (frames, n): not filled up."""


def resected(o_T_guess: Float, tracks: Sequence[SeenTracks], known: Map) -> tuple[Float, Bool]:
    """`o_T_m` of frames by Gauss-Newton over reprojection errors with Tukey's weights.

    Args:
        o_T_guess: (n, 4, 4), where to begin.
        tracks: n, what each of them shows.

    Returns:
        Poses, (n, 4, 4), and whether the map holds each of them, (n,); the others are as they were.
    """
    parts = [
        _together(o_T_guess[i : i + TOGETHER], tracks[i : i + TOGETHER], known) for i in range(0, len(tracks), TOGETHER)
    ]
    if not parts:
        return o_T_guess.copy(), np.zeros(0, dtype=bool)
    return np.concatenate([poses for poses, _ in parts]), np.concatenate([held for _, held in parts])


def _together(o_T_guess: Float, tracks: Sequence[SeenTracks], known: Map) -> tuple[Float, Bool]:
    seen = _seen(tracks, known)
    poses, held = o_T_guess.copy(), np.ones(len(tracks), dtype=bool)
    for _ in range(ITERATIONS):
        residual, jacobian, ahead = _linear(poses, seen, known.calibration)
        weight = _weights(residual, ahead)
        rows = (jacobian * np.sqrt(weight)[..., None, None]).reshape(len(tracks), -1, 6)
        pull = (residual * np.sqrt(weight)[..., None]).reshape(len(tracks), -1, 1)
        normal = rows.transpose(0, 2, 1) @ rows
        information = np.linalg.eigvalsh(normal)
        held &= ((weight > 0).sum(axis=1) >= LEAST) & (information[:, 0] > LOOSEST * information[:, -1])
        step = np.zeros((len(tracks), 6))
        step[held] = np.linalg.solve(normal[held], (rows.transpose(0, 2, 1) @ pull)[held])[..., 0]
        poses = _moved(poses, step)
    return np.where(held[:, None, None], poses, o_T_guess), held


def _seen(tracks: Sequence[SeenTracks], known: Map) -> _Seen:
    shown = [np.isin(t.ids, known.ids) for t in tracks]
    n = max((int(s.sum()) for s in shown), default=0)
    points, px = np.zeros((len(tracks), n, 3)), np.zeros((len(tracks), n, 2))
    real = np.zeros((len(tracks), n), dtype=bool)
    for i, (frame, those) in enumerate(zip(tracks, shown, strict=True)):
        k = int(those.sum())
        points[i, :k] = known.points_m[np.searchsorted(known.ids, frame.ids[those])]
        px[i, :k], real[i, :k] = frame.left_px[those], True
    return _Seen(points, px, real)


def _moved(poses: Float, step: Float) -> Float:
    """Poses (n, 4, 4) moved in their own axes by rotation vector and translation, (n, 6)."""
    moved = poses.copy()
    moved[:, :3, :3] = poses[:, :3, :3] @ Rotation.from_rotvec(step[:, :3]).as_matrix()
    moved[:, :3, 3] += (poses[:, :3, :3] @ step[:, 3:, None])[..., 0]
    return moved


def _weights(residual: Float, ahead: Bool) -> Float:
    """Tukey's weights about the median length of a frame's residuals, shape (frames, n)."""
    length = np.where(ahead, np.hypot(residual[..., 0], residual[..., 1]), np.inf)
    count = ahead.sum(axis=1)
    middle = np.sort(length, axis=1)[np.arange(len(length)), np.maximum(count - 1, 0) // 2] if length.size else 0.0
    scale = np.where(count > 0, middle, 1.0) / 1.1774  # the median of a Rayleigh distribution
    ratio = length / (TUKEY * np.maximum(scale, 1e-3))[:, None]
    return np.where(ratio < 1.0, (1.0 - np.minimum(ratio, 1.0) ** 2) ** 2, 0.0)


def _linear(o_T_m: Float, seen: _Seen, cal: Float) -> tuple[Float, Float, Bool]:
    """Pixels less projections, (f, n, 2), their derivative by the pose's own axes, (f, n, 2, 6), and what is ahead.

    What the lens model leaves over is in the projection and, being a fraction of a pixel, not in the derivative.
    """
    c_p = (seen.points_m - o_T_m[:, None, :3, 3]) @ o_T_m[:, :3, :3]
    ahead = seen.real & (c_p[..., 2] > NEAREST_M)
    z = np.where(ahead, c_p[..., 2], 1.0)
    x, y = c_p[..., 0] / z, c_p[..., 1] / z
    fx, fy, skew, u0, v0, k1, k2, p1, p2 = cal
    rr = x * x + y * y
    radial = 1.0 + k1 * rr + k2 * rr * rr
    xd = radial * x + 2.0 * p1 * x * y + p2 * (rr + 2.0 * x * x)
    yd = radial * y + p1 * (rr + 2.0 * y * y) + 2.0 * p2 * x * y
    residual = seen.px - np.stack([fx * xd + skew * yd + u0, fy * yd + v0], axis=-1)
    one, nil = 1.0 / z, np.zeros_like(z)
    # A point moves against the camera, which turns first and then shifts, in its own axes.
    u = np.stack([x * y, -(1.0 + x * x), y, -one, nil, x * one], axis=-1)
    v = np.stack([1.0 + y * y, -x * y, -x, nil, -one, y * one], axis=-1)
    return residual, np.stack([fx * u, fy * v], axis=-2), ahead
