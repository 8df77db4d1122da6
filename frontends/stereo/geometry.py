"""Stereo geometry on arrays: projection, triangulation with covariance, small motions."""

import cv2
import numpy as np
from numpy.typing import NDArray

from ...factors.camera import CameraModel

Float = NDArray[np.float64]


def inverse(a_T_b: Float) -> Float:
    """`b_T_a`, shape (4, 4)."""
    b_T_a = np.eye(4)
    b_T_a[:3, :3] = a_T_b[:3, :3].T
    b_T_a[:3, 3] = -a_T_b[:3, :3].T @ a_T_b[:3, 3]
    return b_T_a


def transform(a_T_b: Float, b_p: Float) -> Float:
    """Points (n, 3) of frame b in frame a."""
    return np.asarray(b_p @ a_T_b[:3, :3].T + a_T_b[:3, 3], dtype=np.float64)


def exponential(tangent: Float) -> Float:
    """Pose (4, 4) of a small motion (6,), rotation vector first; the translation is not coupled to the rotation."""
    pose = np.eye(4)
    pose[:3, :3] = cv2.Rodrigues(np.ascontiguousarray(tangent[:3]))[0]
    pose[:3, 3] = tangent[3:]
    return pose


def logarithm(pose: Float) -> Float:
    """The tangent (6,) whose `exponential` is the pose (4, 4)."""
    rotation = np.asarray(cv2.Rodrigues(pose[:3, :3])[0], dtype=np.float64)
    return np.concatenate((rotation.ravel(), pose[:3, 3]))


def rotation_angle(rotation: Float) -> float:
    """Angle in rad of a rotation matrix (3, 3)."""
    return float(np.arccos(np.clip((np.trace(rotation) - 1.0) / 2.0, -1.0, 1.0)))


def median(values: Float) -> float:
    """Median of finite numbers (n,), n > 0; NumPy's own takes ten times as long on a hundred."""
    n = len(values)
    half = n // 2
    if n % 2:
        return float(np.partition(values, half)[half])
    middle = np.partition(values, (half - 1, half))
    return float(0.5 * (middle[half - 1] + middle[half]))


def least_spread(px: Float) -> float:
    """Standard deviation of pixels (n, 2) where it is least; those in one corner or on one line hold a pose badly."""
    u, v = (px - px.mean(axis=0)).T
    uu, uv, vv = (float(product) / (len(px) - 1) for product in (u @ u, u @ v, v @ v))
    return float(np.sqrt(max(0.5 * (uu + vv) - float(np.hypot(0.5 * (uu - vv), uv)), 0.0)))


def rays(px: Float, camera: CameraModel) -> Float:
    """Directions (n, 3) with unit z through ideal pixels (n, 2)."""
    plane = np.ones((len(px), 3))
    plane[:, 0] = (px[:, 0] - camera.cx) / camera.fx
    plane[:, 1] = (px[:, 1] - camera.cy) / camera.fy
    return plane


def project(points: Float, camera: CameraModel) -> Float:
    """Ideal pixels (..., 2) of points (..., 3); NaN behind the camera."""
    z = np.where(points[..., 2:] > 1e-6, points[..., 2:], np.nan)
    return points[..., :2] / z * (camera.fx, camera.fy) + (camera.cx, camera.cy)


def projection_jacobian(points: Float, camera: CameraModel) -> Float:
    """Derivative (n, 2, 3) of the ideal pixels by the points (n, 3)."""
    z = points[:, 2]
    jacobian = np.zeros((len(points), 2, 3))
    jacobian[:, 0, 0] = camera.fx / z
    jacobian[:, 1, 1] = camera.fy / z
    jacobian[:, 0, 2] = -camera.fx * points[:, 0] / z**2
    jacobian[:, 1, 2] = -camera.fy * points[:, 1] / z**2
    return jacobian


class StereoGeometry:
    """A nominal stereo rig: two cameras and `left_T_right` (4, 4)."""

    def __init__(self, left: CameraModel, right: CameraModel, left_T_right: Float) -> None:
        self.left = left
        self.right = right
        self.left_T_right = np.asarray(left_T_right, dtype=np.float64)
        self.right_T_left = inverse(self.left_T_right)
        self.baseline_m = float(np.linalg.norm(self.left_T_right[:3, 3]))

    def right_points(self, left_p: Float) -> Float:
        """Points (n, 3) of the left camera in the right one."""
        return transform(self.right_T_left, left_p)

    def project(self, left_p: Float) -> Float:
        """Pixels (n, 4): left u, v and right u, v of points (n, 3) in the left camera."""
        return np.hstack((project(left_p, self.left), project(self.right_points(left_p), self.right)))

    def jacobian(self, left_p: Float) -> Float:
        """Derivative (n, 4, 3) of `project`."""
        right = projection_jacobian(self.right_points(left_p), self.right) @ self.right_T_left[:3, :3]
        return np.concatenate((projection_jacobian(left_p, self.left), right), axis=1)

    def triangulate(self, left_px: Float, right_px: Float) -> Float:
        """Points (n, 3) in the left camera from ideal pixels (n, 2); NaN where rays do not meet ahead.

        Depth comes from the two rays' closest approach along the epipolar plane, weighted by nothing: the vertical
        residual carries no depth for a rig whose baseline is about horizontal.
        """
        left_ray = rays(left_px, self.left)
        right_ray = rays(right_px, self.right) @ self.left_T_right[:3, :3].T
        baseline = self.left_T_right[:3, 3]
        # z_left * left_ray - z_right * right_ray = baseline, least squares in (z_left, z_right).
        a, b, c = (np.einsum("ij,ij->i", x, y) for x, y in
                   ((left_ray, left_ray), (left_ray, right_ray), (right_ray, right_ray)))  # fmt: skip
        d, e = left_ray @ baseline, right_ray @ baseline
        determinant = a * c - b * b
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = (c * d - b * e) / determinant
            behind = (b * d - a * e) / determinant
        good = (determinant > 1e-12) & (depth > 1e-3) & (behind > 1e-3)
        return left_ray * np.where(good, depth, np.nan)[:, None]


def block_diagonal(left: Float, right: Float) -> Float:
    """Covariances (n, 4, 4) of left and right pixels from (n, 2, 2) each."""
    both = np.zeros((len(left), 4, 4))
    both[:, :2, :2] = left
    both[:, 2:, 2:] = right
    return both
