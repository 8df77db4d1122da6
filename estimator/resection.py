"""A frame's pose from the map alone: where its left image shows landmarks that the graph has placed."""

from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray

from ..factors import keys
from .odometry import SeenTracks

Float = NDArray[np.float64]
Int = NDArray[np.int64]

ITERATIONS = 3
"""Gauss-Newton converges within two from a few pixels; the weights need one more."""
LEAST = 12
"""Landmarks below which a frame stays where the front end has put it."""
TUKEY = 4.685
"""95 % efficiency for Gaussian residuals."""
NEAREST_M = 0.05


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


def resected(o_T_guess: gtsam.Pose3, tracks: SeenTracks, known: Map) -> gtsam.Pose3 | None:
    """`o_T_m` by Gauss-Newton over reprojection errors with Tukey's weights; None where the map does not hold it."""
    order = np.searchsorted(known.ids, tracks.ids)
    order[order == len(known.ids)] = 0
    shown = known.ids[order] == tracks.ids if len(known.ids) else np.zeros(len(tracks.ids), dtype=bool)
    points, px = known.points_m[order[shown]], tracks.left_px[shown].astype(np.float64)
    pose = o_T_guess
    for _ in range(ITERATIONS):
        residual, jacobian, ahead = _linear(pose, points, px, known.calibration)
        if ahead.sum() < LEAST:
            return None
        weight = _weights(residual, ahead)
        root = np.sqrt(weight)[:, None]
        rows = (jacobian * root[:, :, None]).reshape(-1, 6)
        step, _, rank, _ = np.linalg.lstsq(rows, (residual * root).ravel(), rcond=1e-7)
        if rank < 6 or (weight > 0).sum() < LEAST:
            return None
        pose = pose.retract(step)
    return pose


def _weights(residual: Float, ahead: NDArray[np.bool_]) -> Float:
    """Tukey's weights about the median length of the residuals, shape (n,)."""
    length = np.hypot(residual[:, 0], residual[:, 1])
    scale = max(float(np.median(length[ahead])) / 1.1774, 1e-3)  # the median of a Rayleigh distribution
    ratio = np.where(ahead, length / (TUKEY * scale), np.inf)
    return np.where(ratio < 1.0, (1.0 - np.minimum(ratio, 1.0) ** 2) ** 2, 0.0)


def _linear(o_T_m: gtsam.Pose3, points: Float, px: Float, cal: Float) -> tuple[Float, Float, NDArray[np.bool_]]:
    """Pixels less projections, (n, 2), their derivative by the pose's body tangent, (n, 2, 6), and what is ahead.

    What the lens model leaves over is in the projection and, being a fraction of a pixel, not in the derivative.
    """
    m_T_o = o_T_m.inverse().matrix()
    c_p = points @ m_T_o[:3, :3].T + m_T_o[:3, 3]
    ahead = c_p[:, 2] > NEAREST_M
    z = np.where(ahead, c_p[:, 2], 1.0)
    x, y = c_p[:, 0] / z, c_p[:, 1] / z
    fx, fy, skew, u0, v0, k1, k2, p1, p2 = cal
    rr = x * x + y * y
    radial = 1.0 + k1 * rr + k2 * rr * rr
    xd = radial * x + 2.0 * p1 * x * y + p2 * (rr + 2.0 * x * x)
    yd = radial * y + p1 * (rr + 2.0 * y * y) + 2.0 * p2 * x * y
    residual = px - np.stack([fx * xd + skew * yd + u0, fy * yd + v0], axis=1)
    one, nil = 1.0 / z, np.zeros_like(z)
    # d(x, y) by rotation, then translation of the camera in its own axes: a point moves against both.
    by_pose = np.stack(
        [
            np.stack([x * y, -(1.0 + x * x), y, -one, nil, x * one], axis=1),
            np.stack([1.0 + y * y, -x * y, -x, nil, -one, y * one], axis=1),
        ],
        axis=1,
    )
    return residual, by_pose * np.array([fx, fy])[None, :, None], ahead
