"""The motion problem in both cameras, with the covariance of points and pixels together."""

import numpy as np

from .geometry import Float, StereoGeometry, exponential, inverse, median, transform
from .left_motion import GATE_2, MEDIAN_2

GATE_4 = 16.3
"""Chi-square of 4 degrees of freedom at 0.9973."""
MEDIAN_4 = 3.357
"""Median of chi-square of 4 degrees of freedom."""
_STILL = 1e-5
"""A step whose square in sigmas is smaller ends the refinement."""


class StereoProblem:
    """Residuals of points seen again, with the covariance of points and pixels together."""

    def __init__(self, points: Float, points_cov: Float, px: Float, px_cov: Float, rig: StereoGeometry) -> None:
        self.points, self.points_cov, self.rig = points, points_cov, rig
        both = np.isfinite(px[:, 2])
        self._expected = np.where(both, MEDIAN_4, MEDIAN_2)
        self._gate = np.where(both, GATE_4, GATE_2)
        self.seen = np.isfinite(px)
        self.px = np.where(self.seen, px, 0.0)
        # A right pixel that is missing gets a variance that lets its residual, set to zero, say nothing.
        self.px_cov = np.array(px_cov)
        self.px_cov[~both, 2:, 2:] = 1e6 * np.eye(2)

    def _residuals(self, here: Float) -> Float:
        px = self.rig.project(here)
        return np.where(self.seen, self.px - np.where(np.isfinite(px), px, 1e4), 0.0)

    def _here(self, pose: Float) -> Float:
        here = transform(inverse(pose), self.points)
        here[:, 2] = np.maximum(here[:, 2], 1e-3)
        return here

    def information(self, pose: Float) -> Float:
        """Weights (n, k, k) of the residuals: inverse covariance of pixels and of points seen from `pose`."""
        jacobian = self.rig.jacobian(self._here(pose)) @ pose[:3, :3].T
        covariance = self.px_cov + jacobian @ self.points_cov @ jacobian.transpose(0, 2, 1)
        return np.asarray(np.linalg.inv(covariance), dtype=np.float64)

    def chi2(self, pose: Float, information: Float) -> Float:
        """Squared residuals (n,) in sigmas."""
        return _square(self._residuals(self._here(pose)), information)

    def cost(self, pose: Float, information: Float) -> float:
        """Truncated squares: what outliers cost is bounded."""
        return float(np.minimum(self.chi2(pose, information) / self._gate, 1.0).sum())

    def share(self, pose: Float, information: Float) -> float:
        """Share of points within the gate of their own covariance."""
        return float((self.chi2(pose, information) < self._gate).mean())

    def gate(self, chi2: Float) -> Float:
        """Limits (n,) of squared residuals, widened by how much they (n,) exceed their covariance."""
        return self._gate * min(max(median(chi2 / self._expected), 1.0), 16.0)

    def refine(self, pose: Float, information: Float, steps: int = 10) -> Float:
        """Gauss-Newton with the weights of Geman and McClure; the pose is moved from the right.

        They fall off faster than the pull of near points grows, so that an arm close to the lens is let go.
        """
        scale = self.gate(self.chi2(pose, information))
        for _ in range(steps):
            here = self._here(pose)
            residual = self._residuals(here)
            weight = 1.0 / (1.0 + _square(residual, information) / scale) ** 2
            by_point = self.rig.jacobian(here)
            by_pose = np.concatenate((by_point @ _cross(here), -by_point), axis=2)
            weighted = (weight[:, None, None] * information) @ by_pose
            normal = weighted.reshape(-1, 6).T @ by_pose.reshape(-1, 6) + 1e-6 * np.eye(6)
            moment = weighted.reshape(-1, 6).T @ residual.ravel()
            step = np.asarray(np.linalg.solve(normal, moment), dtype=np.float64)
            pose = pose @ exponential(step)
            if step @ moment < _STILL:
                break
        return pose


def _square(residual: Float, information: Float) -> Float:
    """Squared residuals (n,) in sigmas."""
    return ((residual[:, None, :] @ information)[:, 0] * residual).sum(axis=1)


def _cross(p: Float) -> Float:
    """Cross product matrices (n, 3, 3)."""
    matrix = np.zeros((len(p), 3, 3))
    matrix[:, 0, 1], matrix[:, 0, 2] = -p[:, 2], p[:, 1]
    matrix[:, 1, 0], matrix[:, 1, 2] = p[:, 2], -p[:, 0]
    matrix[:, 2, 0], matrix[:, 2, 1] = -p[:, 1], p[:, 0]
    return matrix
