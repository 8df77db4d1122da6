"""Robust motion between two stereo frames: P3P consensus, then refinement in both cameras with covariances."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from .geometry import Float, StereoGeometry, exponential, inverse, project, projection_jacobian, transform

Bool = NDArray[np.bool_]

GATE_2, GATE_4 = 11.9, 16.3
"""Chi-square of 2 and 4 degrees of freedom at 0.9973."""
_MAJORITY = 0.7
"""Share of points that follow a predicted motion beyond which no other motion can hold more."""
_STILL = 1e-5
"""A step whose square in sigmas is smaller ends the refinement."""
MEDIAN_2, MEDIAN_4 = 1.386, 3.357
"""Medians of chi-square of 2 and 4 degrees of freedom."""


@dataclass(frozen=True, slots=True)
class Motion:
    """Pose of this left camera in the reference's."""

    reference_T_this: Float
    inliers: Bool
    """Shape (n,)."""
    chi2: Float
    """Shape (n,): squared residual in sigmas, of 4 components where the right image has the point, else of 2."""


def point_covariance(points: Float, covariance: Float, rig: StereoGeometry) -> Float:
    """Covariance (n, 3, 3) of triangulated points from that of their pixels (n, 4, 4), first order."""
    jacobian = rig.jacobian(points)
    information = jacobian.transpose(0, 2, 1) @ np.linalg.inv(covariance) @ jacobian
    return np.asarray(np.linalg.inv(information + 1e-12 * np.eye(3)), dtype=np.float64)


def estimate_motion(
    points: Float,
    points_covariance: Float,
    px: Float,
    px_covariance: Float,
    predicted: Sequence[Float],
    rig: StereoGeometry,
    min_inliers: int,
) -> Motion | None:
    """Motion from points of the reference frame seen again; None without consensus.

    Args:
        points: (n, 3) in the reference's left camera.
        points_covariance: (n, 3, 3), m^2.
        px: (n, 4), ideal left and right pixels in this frame; the right ones may be NaN.
        px_covariance: (n, 4, 4), px^2.
        predicted: poses (4, 4), `reference_T_this` as it may be; they compete with the consensus search, so that a
            body that moves by itself has to hold more points than the rest to be followed. Where most points follow
            one of them there is no search.
        rig: nominal geometry.
        min_inliers: fewer give None.
    """
    if len(points) < max(min_inliers, 6):
        return None
    data = _Problem(points, points_covariance, px, px_covariance, rig)
    candidates = list(predicted)
    # The weights hardly depend on the pose: those of one serve until the end.
    information = data.information(candidates[0] if candidates else np.eye(4))
    pose = None
    if candidates:
        pose = data.refine(min(candidates, key=lambda p: data.cost(p, information)), information)
    if pose is None or data.share(pose, information) < _MAJORITY:
        consensus = _consensus(points, px[:, :2], rig)
        candidates += [p for p in (pose, consensus) if p is not None]
        start = min(candidates, key=lambda p: data.cost(p, information))
        pose = min((data.refine(start, information), start), key=lambda p: data.cost(p, information))
    chi2 = data.chi2(pose, data.information(pose))
    inliers = chi2 < data.gate * data.excess(chi2)
    if inliers.sum() < min_inliers:
        return None
    return Motion(pose, inliers, chi2)


def _consensus(points: Float, left_px: Float, rig: StereoGeometry) -> Float | None:
    scale = max(2.0, 0.004 * rig.left.width)
    found, rotation, translation, inliers = cv2.solvePnPRansac(
        points,
        left_px,
        rig.left.K,
        None,
        iterationsCount=120,
        reprojectionError=scale,
        confidence=0.9999,
        flags=cv2.SOLVEPNP_AP3P,
    )
    if not found or inliers is None or len(inliers) < 5:
        return None
    this_T_reference = np.eye(4)
    this_T_reference[:3, :3] = cv2.Rodrigues(rotation)[0]
    this_T_reference[:3, 3] = translation.ravel()
    return inverse(this_T_reference)


class _Problem:
    """Residuals of points seen again, with the covariance of points and pixels together.

    Without any right pixel only the left two components are formed.
    """

    def __init__(self, points: Float, points_cov: Float, px: Float, px_cov: Float, rig: StereoGeometry) -> None:
        self.points, self.points_cov, self.rig = points, points_cov, rig
        both = np.isfinite(px[:, 2])
        self.size = 4 if both.any() else 2
        self.expected = np.where(both, MEDIAN_4, MEDIAN_2)
        self.gate = np.where(both, GATE_4, GATE_2)
        self.px = np.where(np.isfinite(px), px, 0.0)[:, : self.size]
        self.seen = np.isfinite(px)[:, : self.size]
        # A right pixel that is missing gets a variance that lets its residual, set to zero, say nothing.
        self.px_cov = np.array(px_cov[:, : self.size, : self.size])
        self.px_cov[~both, 2:, 2:] = 1e6 * np.eye(self.size - 2)

    def _residuals(self, here: Float) -> Float:
        px = self.rig.project(here) if self.size == 4 else project(here, self.rig.left)
        return np.where(self.seen, self.px - np.where(np.isfinite(px), px, 1e4), 0.0)

    def _jacobian(self, here: Float) -> Float:
        return self.rig.jacobian(here) if self.size == 4 else projection_jacobian(here, self.rig.left)

    def _here(self, pose: Float) -> Float:
        here = transform(inverse(pose), self.points)
        here[:, 2] = np.maximum(here[:, 2], 1e-3)
        return here

    def information(self, pose: Float) -> Float:
        """Weights (n, k, k) of the residuals: inverse covariance of pixels and of points seen from `pose`."""
        jacobian = self._jacobian(self._here(pose)) @ pose[:3, :3].T
        covariance = self.px_cov + jacobian @ self.points_cov @ jacobian.transpose(0, 2, 1)
        return np.asarray(np.linalg.inv(covariance), dtype=np.float64)

    def chi2(self, pose: Float, information: Float) -> Float:
        """Squared residuals (n,) in sigmas."""
        return _square(self._residuals(self._here(pose)), information)

    def cost(self, pose: Float, information: Float) -> float:
        """Truncated squares: what outliers cost is bounded."""
        return float(np.minimum(self.chi2(pose, information) / self.gate, 1.0).sum())

    def share(self, pose: Float, information: Float) -> float:
        """Share of points within the gate of their own covariance."""
        return float((self.chi2(pose, information) < self.gate).mean())

    def excess(self, chi2: Float) -> float:
        """By how much squared residuals (n,) exceed their covariance, from the median; at least one."""
        return float(np.clip(np.median(chi2 / self.expected), 1.0, 16.0))

    def refine(self, pose: Float, information: Float, steps: int = 10) -> Float:
        """Gauss-Newton with the weights of Geman and McClure; the pose is moved from the right.

        They fall off faster than the pull of near points grows, so that an arm close to the lens is let go.
        """
        scale = self.gate * self.excess(self.chi2(pose, information))
        for _ in range(steps):
            here = self._here(pose)
            residual = self._residuals(here)
            weight = 1.0 / (1.0 + _square(residual, information) / scale) ** 2
            by_point = self._jacobian(here)
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
