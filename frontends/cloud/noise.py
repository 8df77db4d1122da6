"""Published noise of depth cameras: standard deviation along the ray per pixel, and what does not average out.

- Kinect v1: Nguyen, Izadi, Lovell, "Modeling Kinect Sensor Noise for Improved 3D Reconstruction" (2012);
  depth step: Khoshelham and Oude Elberink, Sensors 12 (2012) 1437.
- Kinect v2: Fankhauser et al., "Kinect v2 for Mobile Robot Navigation" (ICAR 2015).
- Azure Kinect: as v2; Kurillo et al., Sensors 22 (2022) 2469 find the two comparable below 2.5 m.
- RealSense D400: stereo, sigma_z = z^2 sigma_d / (f b) with 0.08 px (Intel's figure for textured walls), f 640 px at
  848 columns and b 50 mm; disparities come in steps of 1/32 px.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]
DepthModel = Literal["kinect_v1", "kinect_v2", "azure", "realsense"]

SMOOTH_SHARE = 0.005
"""Slowly varying depth error across the image, as a part of the depth: lens and disparity distortion that factory
calibration leaves (Herrera, Kannala, Heikkila 2012, find up to 1 % for Kinect v1)."""
SMOOTH_RAD = np.deg2rad(15.0)
"""Part of the view over which that counts as one error."""
_REALSENSE_Z2 = 0.08 / (640.0 * 0.05)
_MESSAGE_STEP_M = 0.001


@dataclass(frozen=True, slots=True)
class DepthNoise:
    """Noise of one depth camera model; `z` in metres, `theta` the angle between ray and surface normal in rad."""

    axial: Callable[[Float, Float | float], Float]
    """Standard deviation of a pixel's depth, m."""
    step: Callable[[Float], Float]
    """Spacing of the depths that the sensor can report at z, m."""
    minimum_m: float
    maximum_m: float
    lateral_px: float
    """Standard deviation of where a depth edge shows, px."""


def depth_noise(model: DepthModel) -> DepthNoise:
    """The published noise of a camera model."""
    return _MODELS[model]


def _grazing(theta: Float | float) -> Float:
    """theta^2 / (pi/2 - theta)^2, bounded short of the pole at grazing incidence."""
    bounded = np.minimum(theta, np.deg2rad(88.0))
    return (bounded / (np.pi / 2 - bounded)) ** 2


def _kinect_v1(z: Float, theta: Float | float) -> Float:
    beyond = np.where(np.greater(theta, np.deg2rad(60.0)), 0.0001 * _grazing(theta), 0.0)
    frontal = 0.0012 + 0.0019 * (z - 0.4) ** 2
    return frontal + beyond / np.sqrt(z) if np.any(beyond) else frontal


def _kinect_v2(z: Float, theta: Float | float) -> Float:
    return 0.001 * (1.5 - 0.5 * z + 0.3 * z**2 + 0.1 * z**1.5 * _grazing(theta))


def _realsense(z: Float, theta: Float | float) -> Float:
    return np.maximum(_REALSENSE_Z2 * z**2, _MESSAGE_STEP_M) + 0.0 * theta


_MODELS: dict[str, DepthNoise] = {
    "kinect_v1": DepthNoise(_kinect_v1, lambda z: 2.85e-3 * z**2, 0.35, 5.0, 0.85),
    "kinect_v2": DepthNoise(_kinect_v2, lambda z: np.full_like(z, _MESSAGE_STEP_M), 0.4, 5.0, 0.6),
    "azure": DepthNoise(_kinect_v2, lambda z: np.full_like(z, _MESSAGE_STEP_M), 0.25, 5.5, 0.6),
    "realsense": DepthNoise(
        _realsense, lambda z: np.maximum(z**2 / (32 * 640.0 * 0.05), _MESSAGE_STEP_M), 0.2, 6.0, 1.0
    ),
}
