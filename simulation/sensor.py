"""From light to pixels: where a camera's rays go, and what its sensor makes of the light."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..factors.camera import CameraModel
from .scenario import Light

Float = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class RayGrid:
    """Directions of a camera's sub-samples, fixed for a recording."""

    width: int
    height: int
    directions: tuple[NDArray[np.float32], ...]
    """One for each place in the pixel, shape (height * width, 3), z = 1, in the camera's optical frame."""
    spread: float
    """Distance between neighbouring samples, at z = 1."""


def ray_grid(camera: CameraModel, per_axis: int = 2) -> RayGrid:
    """`per_axis` squared sub-samples per pixel, distortion undone."""
    places = (np.arange(per_axis) + 0.5) / per_axis - 0.5
    grids = []
    for dv in places:
        for du in places:
            u, v = np.meshgrid(np.arange(camera.width) + du, np.arange(camera.height) + dv)
            grids.append(directions(camera, np.stack([u.ravel(), v.ravel()], axis=1)).astype(np.float32))
    return RayGrid(camera.width, camera.height, tuple(grids), 1 / camera.fx / per_axis)


def directions(camera: CameraModel, pixels: Float) -> Float:
    """Rays with z = 1 through raw pixels (n, 2), shape (n, 3)."""
    if np.any(camera.D):
        criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 60, 1e-10)
        flat = cv2.undistortPoints(pixels[:, None], camera.K, camera.D, criteria=criteria).reshape(-1, 2)
    else:
        flat = (pixels - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    return np.concatenate([np.asarray(flat, dtype=float), np.ones((len(flat), 1))], axis=1)


def project(camera: CameraModel, points: Float) -> Float:
    """Raw pixels (n, 2) of points (n, 3) in the camera's optical frame; NaN behind it."""
    points = np.asarray(points, dtype=float).reshape(-1, 3)
    pixels, _ = cv2.projectPoints(points[:, None], np.zeros(3), np.zeros(3), camera.K, camera.D)
    return np.where(points[:, 2:] > 1e-6, np.asarray(pixels, dtype=float).reshape(-1, 2), np.nan)


def expose(light: NDArray[np.float32], settings: Light, gain: float, rng: np.random.Generator) -> NDArray[np.uint8]:
    """Digital image of radiance (height, width) or (height, width, 3).

    Lens blur and vignetting, then photon noise, read noise, gamma and eight bits. `gain` takes radiance to full
    scale 1.
    """
    if settings.blur_px > 0:
        light = np.asarray(cv2.GaussianBlur(light, (0, 0), settings.blur_px), np.float32)
    height, width = light.shape[:2]
    u = (np.arange(width) - (width - 1) / 2) / (width / 2)
    v = (np.arange(height) - (height - 1) / 2) / (width / 2)
    falloff = 1 - settings.vignetting * (u[None, :] ** 2 + v[:, None] ** 2) / (1 + (height / width) ** 2)
    signal = light * (gain * falloff.astype(np.float32)[(...,) + (None,) * (light.ndim - 2)])
    sigma = np.sqrt(np.maximum(signal, 0) / settings.full_well_electrons + settings.read_noise**2)
    noisy = signal + sigma * rng.standard_normal(light.shape, dtype=np.float32)
    return (255 * np.clip(noisy, 0, 1) ** (1 / settings.gamma) + 0.5).astype(np.uint8)
