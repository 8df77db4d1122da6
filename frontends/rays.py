"""The rays of a camera's pixels as a table."""

import numpy as np
from numpy.typing import NDArray

from ..factors.camera import CameraModel
from .undistort import undistort

Float = NDArray[np.float64]


def ideal_grid(camera: CameraModel) -> Float:
    """The ideal pixel of every raw pixel, shape (height, width, 2); NaN where the lens model has no inverse."""
    u, v = np.meshgrid(np.arange(camera.width, dtype=float), np.arange(camera.height, dtype=float))
    return undistort(camera, np.dstack((u, v)))[0]


def pixel_rays(camera: CameraModel) -> Float:
    """Normalised coordinates (x, y) of the rays with z = 1 through every pixel, shape (height, width, 2)."""
    return (ideal_grid(camera) - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
