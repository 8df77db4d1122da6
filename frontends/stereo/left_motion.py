"""The motion problem in the left camera alone: what every frame between keyframes solves, in closed rows of numbers."""

import numpy as np

from ...factors.camera import CameraModel
from .geometry import Float, exponential, median

GATE_2 = 11.9
"""Chi-square of 2 degrees of freedom at 0.9973."""
MEDIAN_2 = 1.386
"""Median of chi-square of 2 degrees of freedom."""
_STILL = 1e-3
"""A step whose square in sigmas is smaller ends the refinement: it is a guess for the graph, and the next frame's."""


class LeftProblem:
    """Residuals of points seen again in the left image, with the covariance of points and pixels together.

    The same as `stereo_motion.StereoProblem` without right pixels, at a fifth of its time. Arrays hold one row per
    component and one column per point; residuals are in units of the focal lengths.
    """

    def __init__(self, points: Float, points_cov: Float, px: Float, px_cov: Float, camera: CameraModel) -> None:
        self.points = points
        self._columns = np.ascontiguousarray(points.T)
        self._points_cov = np.ascontiguousarray(points_cov.transpose(1, 2, 0))
        fx, fy = camera.fx, camera.fy
        self._plane_px = np.stack(((px[:, 0] - camera.cx) / fx, (px[:, 1] - camera.cy) / fy))
        self._px_cov = px_cov[:, 0, 0] / fx**2, px_cov[:, 0, 1] / (fx * fy), px_cov[:, 1, 1] / fy**2

    def information(self, pose: Float) -> Float:
        """Weights (3, n): elements uu, uv and vv of the residuals' inverse covariance, as seen from `pose`."""
        plane, inverse_depth = self._plane(pose)
        turn = pose[:3, :3].T[:, :, None]
        along = turn[:2] - plane[:, None] * turn[2]  # by the point in the reference, (2, 3, n)
        along *= inverse_depth
        carried = (self._points_cov * along[:, None]).sum(axis=2)
        uu, uv, vv = self._px_cov
        uu = uu + (carried[0] * along[0]).sum(axis=0)
        uv = uv + (carried[0] * along[1]).sum(axis=0)
        vv = vv + (carried[1] * along[1]).sum(axis=0)
        information = np.stack((vv, -uv, uu))
        information /= uu * vv - uv * uv
        return information

    def chi2(self, pose: Float, information: Float) -> Float:
        """Squared residuals (n,) in sigmas."""
        residual = self._plane_px - self._plane(pose)[0]
        return (_pulled(residual, information) * residual).sum(axis=0)

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
        scale = None
        along = np.zeros((6, 2, len(self.points)))
        rows = along.reshape(6, -1)
        for _ in range(steps):
            plane, inverse_depth = self._plane(pose)
            residual = self._plane_px - plane
            pulled = _pulled(residual, information)
            square = (pulled * residual).sum(axis=0)
            scale = self.gate(square) if scale is None else scale
            weight = 1.0 / (1.0 + square / scale)
            weight *= weight
            _by_pose(plane, inverse_depth, along)
            uu, uv, vv = weight * information
            weighted = np.empty_like(along)
            weighted[:, 0] = uu * along[:, 0] + uv * along[:, 1]
            weighted[:, 1] = uv * along[:, 0] + vv * along[:, 1]
            normal = weighted.reshape(6, -1) @ rows.T
            normal.flat[::7] += 1e-6
            moment = rows @ (weight * pulled).ravel()
            step = np.linalg.solve(normal, moment)
            pose = pose @ exponential(step)
            if step @ moment < _STILL:
                break
        return pose

    def _plane(self, pose: Float) -> tuple[Float, Float]:
        """Points at unit depth (2, n) in the camera at `pose`, and their inverse depths (n,)."""
        here = pose[:3, :3].T @ (self._columns - pose[:3, 3:])
        inverse_depth = 1.0 / np.maximum(here[2], 1e-3)
        return here[:2] * inverse_depth, inverse_depth


def _by_pose(plane: Float, inverse_depth: Float, along: Float) -> None:
    """Derivatives (6, 2, n) of u and v by the pose, moved from the right; two of them stay zero."""
    x, y = plane
    np.multiply(x, y, out=along[0, 0])
    np.negative(along[0, 0], out=along[1, 1])
    along[0, 1] = 1.0 + y * y
    along[1, 0] = -1.0 - x * x
    along[2, 0] = y
    np.negative(x, out=along[2, 1])
    np.negative(inverse_depth, out=along[3, 0])
    along[4, 1] = along[3, 0]
    np.multiply(plane, inverse_depth, out=along[5])


def _pulled(residual: Float, information: Float) -> Float:
    """Residuals (2, n) times their information."""
    uu, uv, vv = information
    pulled = np.empty_like(residual)
    pulled[0] = uu * residual[0] + uv * residual[1]
    pulled[1] = uv * residual[0] + vv * residual[1]
    return pulled
