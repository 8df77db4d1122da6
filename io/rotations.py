"""Unit quaternions (x, y, z, w), as messages carry them, to rotation matrices and back."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

Float = NDArray[np.float64]


def matrix_from_quaternion(xyzw: ArrayLike) -> Float:
    """Rotation matrix, shape (3, 3), of a quaternion of any length but zero.

    Raises:
        ValueError: the quaternion is zero or not finite.
    """
    q = np.asarray(xyzw, dtype=np.float64)
    norm = float(np.linalg.norm(q))
    if not np.isfinite(norm) or norm < 1e-9:
        raise ValueError("quaternion is zero or not finite")
    x, y, z, w = (float(value) for value in q / norm)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def quaternion_from_matrix(rotation: ArrayLike) -> Float:
    """Quaternion (x, y, z, w) with w >= 0 of a rotation matrix, shape (3, 3).

    It is the dominant eigenvector of a symmetric 4x4 matrix (Bar-Itzhack 2000): no case distinction, and a slightly
    non-orthogonal matrix gives the nearest rotation.
    """
    r = np.asarray(rotation, dtype=np.float64)
    trace = r[0, 0] + r[1, 1] + r[2, 2]
    k = np.empty((4, 4))
    k[:3, :3] = r + r.T - trace * np.eye(3)
    k[:3, 3] = k[3, :3] = (r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1])
    k[3, 3] = trace
    q = np.linalg.eigh(k)[1][:, 3]
    return np.negative(q) if q[3] < 0 else q


def pose_matrix(translation: ArrayLike, xyzw: ArrayLike) -> Float:
    """`a_T_b`, shape (4, 4). Raises ValueError as `matrix_from_quaternion`, or when a coordinate is not finite."""
    matrix = np.eye(4)
    matrix[:3, :3] = matrix_from_quaternion(xyzw)
    matrix[:3, 3] = translation
    if not np.isfinite(matrix).all():
        raise ValueError("translation is not finite")
    return matrix
