"""Rigid motions as 4x4 matrices: `a_T_b` carries b's coordinates into a's."""

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

Float = NDArray[np.float64]


def rigid(rotation: ArrayLike | Rotation | None = None, translation_m: ArrayLike = (0.0, 0.0, 0.0)) -> Float:
    """A (4, 4) pose from a rotation (matrix, rotation vector in rad, or scipy rotation) and a translation (3,)."""
    matrix = np.eye(4)
    if isinstance(rotation, Rotation):
        matrix[:3, :3] = rotation.as_matrix()
    elif rotation is not None:
        given = np.asarray(rotation, dtype=float)
        matrix[:3, :3] = given if given.shape == (3, 3) else Rotation.from_rotvec(given).as_matrix()
    matrix[:3, 3] = np.asarray(translation_m, dtype=float)
    return matrix


def inverse(a_T_b: Float) -> Float:
    """`b_T_a`, shape (4, 4)."""
    result = np.eye(4)
    result[:3, :3] = a_T_b[:3, :3].T
    result[:3, 3] = -a_T_b[:3, :3].T @ a_T_b[:3, 3]
    return result


def transform(a_T_b: Float, b_points: ArrayLike) -> Float:
    """Points (..., 3) of b in a."""
    return np.asarray(b_points, dtype=float) @ a_T_b[:3, :3].T + a_T_b[:3, 3]


def looking(position: ArrayLike, yaw_rad: float, pitch_rad: float, roll_rad: float = 0.0) -> Float:
    """`w_T_camera` of an optical frame (x right, y down, z forward) in a world whose z is up.

    Yaw turns the view about the world's z axis from +y towards -x, pitch raises it, roll turns it about itself.
    """
    level = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    turn = Rotation.from_euler("ZX", [yaw_rad, pitch_rad]).as_matrix()
    return rigid(turn @ level @ Rotation.from_euler("z", roll_rad).as_matrix(), position)


def view_angles(direction: ArrayLike) -> tuple[float, float]:
    """Yaw and pitch (rad) for `looking` along a direction (3,)."""
    x, y, z = np.asarray(direction, dtype=float)
    return float(np.arctan2(-x, y)), float(np.arctan2(z, np.hypot(x, y)))


def rotation_vector(a_T_b: Float) -> Float:
    """The rotation's axis times its angle, rad, shape (3,)."""
    return Rotation.from_matrix(a_T_b[:3, :3]).as_rotvec()


def quaternion_xyzw(a_T_b: Float) -> Float:
    """Unit quaternion (x, y, z, w), w not negative."""
    return Rotation.from_matrix(a_T_b[:3, :3]).as_quat(canonical=True)
