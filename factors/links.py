"""Poses held together: the gauge, the tape-measured mount, and motion where nothing was seen."""

import gtsam
import numpy as np

from .geometry import pose_from_vectors
from .noise import gaussian, pose_sigmas
from .rig import Mount

GAUGE_ROTATION_RAD = 1e-7
GAUGE_TRANSLATION_M = 1e-7
LARGEST_TURN_RAD = 1.0
"""Sigma beyond which a rotation is unknown anyhow, and its tangent means nothing."""


def gauge_prior(keyframe: int) -> gtsam.NonlinearFactor:
    """{o} is the left camera at the first keyframe, by definition."""
    noise = pose_sigmas(GAUGE_ROTATION_RAD, GAUGE_TRANSLATION_M)
    return gtsam.PriorFactorPose3(keyframe, gtsam.Pose3(), noise)


def mount_pose(mount: Mount) -> gtsam.Pose3:
    """`f_T_b` as taped."""
    return pose_from_vectors(mount.f_T_b.translation_m, mount.f_T_b.rotation_vector_rad)


def mount_factor(mount: Mount, board: int, base: int) -> gtsam.NonlinearFactor:
    """`f_T_b` with its tolerance.

    The tolerance is of {b}'s place in the page and of its orientation, both isotropic, so the body frame's
    covariance is the same.
    """
    noise = pose_sigmas(mount.rotation_sigma_rad, mount.translation_sigma_m)
    return gtsam.BetweenFactorPose3(board, base, mount_pose(mount), noise)


def motion_prior(
    earlier: int, later: int, motion: gtsam.Pose3, seconds: float, speed_m_s: float, turn_rad_s: float
) -> gtsam.NonlinearFactor:
    """Between two keyframes that no track connects: `motion` is a guess, wrong by what the camera may have done.

    Args:
        speed_m_s, turn_rad_s: standard deviation of the velocity that the guess does not know.
    """
    rotation = float(np.clip(turn_rad_s * seconds, 1e-3, LARGEST_TURN_RAD))
    translation = max(speed_m_s * seconds, 1e-3)
    return gtsam.BetweenFactorPose3(earlier, later, motion, pose_sigmas(rotation, translation))


def weak_pose_prior(key: int, pose: gtsam.Pose3, sigma_rad: float, sigma_m: float) -> gtsam.NonlinearFactor:
    """Keeps a variable determinate without informing it (sigmas far beyond anything measured)."""
    return gtsam.PriorFactorPose3(key, pose, pose_sigmas(sigma_rad, sigma_m))


def base_motion_factor(earlier: int, later: int, a_T_b: np.ndarray, covariance: np.ndarray) -> gtsam.NonlinearFactor:
    """The machine between two stations, `b[j]_T_b[j+1]`; covariance (6, 6) rotation first, body frame of the later."""
    return gtsam.BetweenFactorPose3(earlier, later, gtsam.Pose3(a_T_b), gaussian(covariance))


CARRIED_RAD, CARRIED_M = 2e-4, 2e-4
"""How exactly a board that is screwed to the machine keeps its place on it, from station to station."""


def carried_factor(base: int, board: int, later_base: int, later_board: int) -> gtsam.CustomFactor:
    """A board on the machine keeps its place in {b}: `(b^-1 f)^-1 (b'^-1 f')` is the identity; residual (6,)."""
    variables = [base, board, later_base, later_board]

    def error(factor: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[np.ndarray] | None) -> np.ndarray:
        b, f, b2, f2 = (values.atPose3(key) for key in variables)
        then, now = b.between(f), b2.between(f2)
        moved = then.between(now)
        if jacobians is not None:
            back = moved.inverse().AdjointMap()
            outer = gtsam.Pose3.LogmapDerivative(moved)
            jacobians[0] = outer @ back @ then.inverse().AdjointMap()
            jacobians[1] = -outer @ back
            jacobians[2] = -outer @ now.inverse().AdjointMap()
            jacobians[3] = outer
        return gtsam.Pose3.Logmap(moved)

    return gtsam.CustomFactor(pose_sigmas(CARRIED_RAD, CARRIED_M), variables, error)
