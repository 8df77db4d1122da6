"""Robust motion between two stereo frames: P3P consensus, then refinement in both cameras with covariances."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from .geometry import Float, StereoGeometry, inverse
from .left_motion import LeftProblem
from .stereo_motion import StereoProblem

Bool = NDArray[np.bool_]

_MAJORITY = 0.7
"""Share of points that follow a predicted motion beyond which no other motion can hold more."""


@dataclass(frozen=True, slots=True)
class Motion:
    """Pose of this left camera in the reference's."""

    reference_T_this: Float
    inliers: Bool
    """Shape (n,)."""
    chi2: Float
    """Shape (n,): squared residual in sigmas, of 4 components where the right image has the point, else of 2."""

    def of_all(self, used: Bool) -> "Motion":
        """The same for all points: those that were not used (m,) are no inliers, and have no residual."""
        inliers, chi2 = np.zeros(len(used), dtype=bool), np.full(len(used), np.nan)
        inliers[used], chi2[used] = self.inliers, self.chi2
        return Motion(self.reference_T_this, inliers, chi2)


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
    shared_covariance: Float | None = None,
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
        shared_covariance: (n, 4, 4), px^2, of what all points may be off by together: the motion follows it, the test
            of each point does not hold it against the point.
    """
    if len(points) < max(min_inliers, 6):
        return None
    data = _problem(points, points_covariance, px, px_covariance, rig)
    candidates = list(predicted)
    # The weights hardly depend on the pose: those of one serve until the end.
    information = data.information(candidates[0] if candidates else np.eye(4))
    pose = _followed(data, candidates, information)
    if pose is None:
        candidates += [p for p in (_consensus(points, px[:, :2], rig),) if p is not None]
        if not candidates:
            return None
        start = min(candidates, key=lambda p: data.cost(p, information))
        pose = min((data.refine(start, information), start), key=lambda p: data.cost(p, information))
    if shared_covariance is not None:
        data = _problem(points, points_covariance, px, px_covariance + shared_covariance, rig)
    chi2 = data.chi2(pose, data.information(pose))
    inliers = chi2 < data.gate(chi2)
    if inliers.sum() < min_inliers:
        return None
    return Motion(pose, inliers, chi2)


def _problem(
    points: Float, points_covariance: Float, px: Float, px_covariance: Float, rig: StereoGeometry
) -> LeftProblem | StereoProblem:
    """In both images, or in the left one alone where no point is in the right."""
    if np.isfinite(px[:, 2]).any():
        return StereoProblem(points, points_covariance, px, px_covariance, rig)
    return LeftProblem(points, points_covariance, px, px_covariance, rig.left)


def _followed(data: LeftProblem | StereoProblem, candidates: list[Float], information: Float) -> Float | None:
    """The refined prediction, if most points follow it; else it joins the candidates."""
    if not candidates:
        return None
    start = candidates[0]
    if data.share(start, information) < _MAJORITY:
        start = min(candidates, key=lambda p: data.cost(p, information))
    pose = data.refine(start, information)
    if data.share(pose, information) >= _MAJORITY:
        return pose
    candidates.append(pose)
    return None


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
