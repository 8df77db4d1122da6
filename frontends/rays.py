"""Pixels and rays of a camera with distortion, by OpenCV."""

import cv2
import numpy as np
from numpy.typing import NDArray

from ..factors.camera import CameraModel

Float = NDArray[np.float64]


def pixel_rays(camera: CameraModel) -> Float:
    """Normalised coordinates (x, y) of the rays with z = 1 through every pixel, shape (height, width, 2)."""
    u, v = np.meshgrid(np.arange(camera.width, dtype=float), np.arange(camera.height, dtype=float))
    return normalised(np.column_stack((u.ravel(), v.ravel())), camera).reshape(camera.height, camera.width, 2)


def normalised(raw_px: Float, camera: CameraModel) -> Float:
    """Raw pixels (n, 2) to normalised coordinates (x, y) with z = 1, shape (n, 2)."""
    if camera.distortion_model == "none" or not np.any(camera.D):
        return (raw_px - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
    points = np.ascontiguousarray(raw_px, dtype=float).reshape(-1, 1, 2)
    if camera.distortion_model == "equidistant":
        return cv2.fisheye.undistortPoints(points, camera.K, camera.D).reshape(-1, 2)
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 40, 1e-9)
    return cv2.undistortPointsIter(points, camera.K, camera.D, np.eye(3), np.eye(3), criteria).reshape(-1, 2)


def ideal_from_raw(raw_px: Float, camera: CameraModel) -> Float:
    """Raw pixels (n, 2) to ideal pixels (n, 2)."""
    return normalised(raw_px, camera) * (camera.fx, camera.fy) + (camera.cx, camera.cy)


def raw_from_ideal(ideal_px: Float, camera: CameraModel) -> Float:
    """Ideal pixels (n, 2) to where they show in the image, raw pixels (n, 2)."""
    if camera.distortion_model == "none" or not np.any(camera.D):
        return np.asarray(ideal_px, dtype=float)
    xy = (np.asarray(ideal_px, dtype=float) - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
    if camera.distortion_model == "equidistant":
        return cv2.fisheye.distortPoints(xy.reshape(-1, 1, 2), camera.K, camera.D).reshape(-1, 2)
    rays = np.column_stack((xy, np.ones(len(xy))))
    pixels, _ = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), camera.K, camera.D)
    return pixels.reshape(-1, 2)
