"""The motion problem in the left camera alone: what every frame between keyframes solves, in closed rows of numbers."""

import numpy as np
from numpy.typing import NDArray

from ...factors.camera import CameraModel
from .geometry import Float, exponential, median, projection_jacobian

GATE_2 = 11.9
"""Chi-square of 2 degrees of freedom at 0.9973."""
MEDIAN_2 = 1.386
"""Median of chi-square of 2 degrees of freedom."""
_STILL = 1e-3
"""A step whose square in sigmas is smaller ends the refinement: it is a guess for the graph, and the next frame's."""


class LeftProblem:
    """Residuals of points seen again in the left image, with the covariance of points and pixels together.

    The same as `stereo_motion.StereoProblem` without right pixels, at a third of its time. Arrays hold one row per
    component and one column per point.
    """

    def __init__(self, points: Float, points_cov: Float, px: Float, px_cov: Float, camera: CameraModel) -> None:
        self.points, self.camera = points, camera
        self._columns = np.ascontiguousarray(points.T)
        self._px = np.ascontiguousarray(px[:, :2].T)
        self._points_cov, self._px_cov = points_cov, px_cov[:, :2, :2]
        self._focal = np.array([[camera.fx], [camera.fy]])
        self._centre = np.array([[camera.cx], [camera.cy]])

    def information(self, pose: Float) -> Float:
        """Weights (3, n): elements uu, uv and vv of the residuals' inverse covariance, as seen from `pose`."""
        here = transform_inverse(pose, self._columns).T
        here[:, 2] = np.maximum(here[:, 2], 1e-3)
        jacobian = projection_jacobian(here, self.camera) @ pose[:3, :3].T
        covariance = self._px_cov + jacobian @ self._points_cov @ jacobian.transpose(0, 2, 1)
        uu, uv, vv = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
        return np.stack((vv, -uv, uu)) / (uu * vv - uv * uv)

    def chi2(self, pose: Float, information: Float) -> Float:
        """Squared residuals (n,) in sigmas."""
        return _square(self._residuals(self._plane(pose)[0]), information)

    def cost(self, pose: Float, information: Float) -> float:
        """Truncated squares: what outliers cost is bounded."""
        return float(np.minimum(self.chi2(pose, information) / GATE_2, 1.0).sum())

    def share(self, pose: Float, information: Float) -> float:
        """Share of points within the gate of their own covariance."""
        return np.count_nonzero(self.chi2(pose, information) < GATE_2) / len(self.points)

    def gate(self, chi2: Float) -> float:
        """Limit of squared residuals, widened by how much they (n,) exceed their covariance."""
        return GATE_2 * min(max(median(chi2) / MEDIAN_2, 1.0), 16.0)

    def refine(self, pose: Float, information: Float, steps: int = 10) -> Float:
        """Gauss-Newton with the weights of Geman and McClure, as `stereo_motion.StereoProblem.refine`."""
        uu, uv, vv = information
        scale = None
        for _ in range(steps):
            plane, inverse_depth = self._plane(pose)
            residual = self._residuals(plane)
            square = _square(residual, information)
            scale = self.gate(square) if scale is None else scale
            weight = (1.0 + square / scale) ** -2
            along_u, along_v = self._by_pose(plane, inverse_depth)
            weighted_u = (weight * uu) * along_u + (weight * uv) * along_v
            weighted_v = (weight * uv) * along_u + (weight * vv) * along_v
            normal = weighted_u @ along_u.T + weighted_v @ along_v.T
            normal[np.diag_indices(6)] += 1e-6
            moment = weighted_u @ residual[0] + weighted_v @ residual[1]
            step = np.linalg.solve(normal, moment)
            pose = pose @ exponential(step)
            if step @ moment < _STILL:
                break
        return pose

    def _plane(self, pose: Float) -> tuple[Float, Float]:
        """Points at unit depth (2, n) in the camera at `pose`, and their inverse depths (n,)."""
        here = transform_inverse(pose, self._columns)
        inverse_depth = 1.0 / np.maximum(here[2], 1e-3)
        return here[:2] * inverse_depth, inverse_depth

    def _residuals(self, plane: Float) -> Float:
        return self._px - (self._focal * plane + self._centre)

    def _by_pose(self, plane: Float, inverse_depth: Float) -> tuple[Float, Float]:
        """Derivatives (6, n) of u and of v by the pose, moved from the right."""
        x, y = plane
        product = x * y
        along_u = np.empty((6, len(x)))
        along_u[0], along_u[1], along_u[2] = product, -1.0 - x * x, y
        along_u[3], along_u[4], along_u[5] = -inverse_depth, 0.0, x * inverse_depth
        along_v = np.empty((6, len(x)))
        along_v[0], along_v[1], along_v[2] = 1.0 + y * y, -product, -x
        along_v[3], along_v[4], along_v[5] = 0.0, -inverse_depth, y * inverse_depth
        along_u *= self.camera.fx
        along_v *= self.camera.fy
        return along_u, along_v


def transform_inverse(a_T_b: Float, a_p: NDArray[np.float64]) -> Float:
    """Points (3, n) of frame a in frame b."""
    return np.asarray(a_T_b[:3, :3].T @ (a_p - a_T_b[:3, 3:]), dtype=np.float64)


def _square(residual: Float, information: Float) -> Float:
    """Squared residuals (n,) in sigmas."""
    u, v = residual
    uu, uv, vv = information
    return uu * u * u + 2.0 * uv * u * v + vv * v * v
