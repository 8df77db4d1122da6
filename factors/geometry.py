"""Poses and their covariances between the conventions: GTSAM's tangent, ROS's fixed axes, plain matrices."""

from collections.abc import Sequence

import gtsam
import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]


def skew(v: Float) -> Float:
    """The matrix [v]x with [v]x w = v x w, shape (3, 3)."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def cross(a: Sequence[float], b: Sequence[float]) -> tuple[float, float, float]:
    """The vector product of two triples: NumPy takes ten times as long for one."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def pose3(matrix: Float) -> gtsam.Pose3:
    """Pose3 from `a_T_b`, shape (4, 4)."""
    return gtsam.Pose3(gtsam.Rot3(matrix[:3, :3]), matrix[:3, 3])


def pose_from_vectors(translation_m: tuple[float, ...], rotation_vector_rad: tuple[float, ...]) -> gtsam.Pose3:
    """Pose3 from a rig file's pose."""
    return gtsam.Pose3(gtsam.Rot3.Expmap(np.asarray(rotation_vector_rad, float)), np.asarray(translation_m, float))


def ros_covariance(a_T_b: gtsam.Pose3, covariance: Float) -> Float:
    """GTSAM's covariance of a Pose3 (rotation first, body frame) in the ROS order.

    Args:
        a_T_b: the pose at which the covariance holds.
        covariance: shape (6, 6), of xi in `a_T_b * Exp(xi)`, xi = (omega, v).

    Returns:
        Shape (6, 6): translation in a, then rotation about the fixed axes of a (first order:
        dt = R v, dtheta = R omega), as in `geometry_msgs/PoseWithCovariance`.
    """
    R = a_T_b.rotation().matrix()
    J = np.zeros((6, 6))
    J[:3, 3:] = R
    J[3:, :3] = R
    return J @ covariance @ J.T


def gtsam_covariance(a_T_b: gtsam.Pose3, covariance: Float) -> Float:
    """The inverse of `ros_covariance`."""
    R = a_T_b.rotation().matrix()
    J = np.zeros((6, 6))
    J[:3, 3:] = R.T
    J[3:, :3] = R.T
    return J @ covariance @ J.T


def point_to_frame(a_T_b: gtsam.Pose3, a_p: Float) -> tuple[Float, Float, Float]:
    """`b_p = a_T_b^-1 a_p` with its Jacobians.

    Returns:
        b_p shape (3,), d b_p / d xi shape (3, 6), d b_p / d a_p shape (3, 3).
    """
    R = a_T_b.rotation().matrix()
    b_p = R.T @ (a_p - a_T_b.translation())
    return b_p, np.hstack([skew(b_p), -np.eye(3)]), R.T


def seen_from(a_T_b: gtsam.Pose3, a_p: Float) -> Float:
    """`b_p` of `point_to_frame` alone, to the last bit."""
    return a_T_b.rotation().matrix().T @ (a_p - a_T_b.translation())


def point_from_frame(a_T_b: gtsam.Pose3, b_p: Float) -> tuple[Float, Float, Float]:
    """`a_p = a_T_b b_p` with its Jacobians.

    Returns:
        a_p shape (3,), d a_p / d xi shape (3, 6), d a_p / d b_p shape (3, 3).
    """
    R = a_T_b.rotation().matrix()
    return R @ b_p + a_T_b.translation(), np.hstack([-R @ skew(b_p), R]), R
