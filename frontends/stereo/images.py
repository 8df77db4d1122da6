"""From camera images to comparable 8-bit grey ones: conversion, gain for dark views, brightness between frames."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]
Float32 = NDArray[np.float32]

_BINOMIAL_VARIANCE = 0.25
"""Of the kernel (1, 4, 6, 4, 1) / 16 on half pixels, px^2."""


def to_grey(image: NDArray[np.generic]) -> Image:
    """Grey 8-bit image (h, w) from grey or BGR, 8 or 16 bit.

    16-bit images are shifted down by eight bits: their dark part is lost, as in the 8-bit recording of the same camera.
    """
    if image.dtype == np.uint16:
        image = np.asarray(image, dtype=np.uint16) >> 8
    grey = np.ascontiguousarray(image, dtype=np.uint8)
    if grey.ndim == 2:
        return grey
    if grey.shape[2] == 1:
        return np.ascontiguousarray(grey[:, :, 0])
    return np.asarray(cv2.cvtColor(np.ascontiguousarray(grey[:, :, :3]), cv2.COLOR_BGR2GRAY), dtype=np.uint8)


def quantiles(image: Image) -> NDArray[np.float64]:
    """Grey values (3,) below which 2, 50 and 98 % of the pixels lie."""
    counts = np.cumsum(cv2.calcHist([image], [0], None, [256], [0, 256]).ravel())
    return np.searchsorted(counts, np.array([0.02, 0.5, 0.98]) * counts[-1]).astype(np.float64)


def contrast_table(levels: NDArray[np.float64], largest_gain: float = 6.0) -> tuple[Image, float] | None:
    """Look-up table (256,) that stretches a dark or flat image, and its gain; None for an image that uses its range."""
    low, _, high = levels
    gain = min(largest_gain, 200.0 / max(high - low, 1.0))
    if gain < 1.5:
        return None
    table = (np.arange(256) - low) * gain + 20.0
    return np.clip(np.rint(table), 0, 255).astype(np.uint8), gain


def brightness_table(levels_from: NDArray[np.float64], levels_to: NDArray[np.float64]) -> Image | None:
    """Look-up table that takes one image's brightness to another's; None where they agree.

    Optical flow compares grey values; an exposure step between two frames breaks it, this repairs the step.
    """
    if np.all(np.abs(levels_from - levels_to) <= 0.06 * np.maximum(levels_to, 40.0)):
        return None
    gain = max(levels_to[2] - levels_to[0], 1.0) / max(levels_from[2] - levels_from[0], 1.0)
    gain = float(np.clip(gain, 0.2, 5.0))
    table = (np.arange(256) - levels_from[1]) * gain + levels_to[1]
    return np.clip(np.rint(table), 0, 255).astype(np.uint8)


def smooth(image: Image | Float32, sigma_px: float) -> Float32:
    """Float image, low-passed; bilinear sampling of the raw image shifts by some hundredths of a pixel."""
    return np.asarray(cv2.GaussianBlur(image.astype(np.float32), (0, 0), sigma_px), dtype=np.float32)


@dataclass(frozen=True, slots=True)
class Picture:
    """A smoothed image with `density` samples per pixel along either axis; sample `density * i` is pixel i's centre."""

    values: Float32
    density: int = 1

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width in pixels."""
        return self.values.shape[0] // self.density, self.values.shape[1] // self.density


def dense(image: Image | Float32, sigma_px: float) -> Picture:
    """Low-passed, with two samples per pixel.

    Linear interpolation between pixels is itself a low-pass, half-way between them only: patches look sharper at whole
    pixels, and all that move together are drawn there together. The binomial kernel of the pyramid (a cubic B-spline)
    smooths alike at and between the pixels up to the fourth order, and leaves a quarter of the step to interpolate.
    """
    before = float(np.sqrt(max(sigma_px**2 - _BINOMIAL_VARIANCE, 0.04)))
    return Picture(np.asarray(cv2.pyrUp(smooth(image, before)), dtype=np.float32), 2)


def noise_sigma(image: Image, gain: float = 1.0) -> float:
    """Robust standard deviation of the pixel noise, in grey values.

    Median of the absolute Laplacian difference (Immerkaer, Fast noise variance estimation, 1996), which texture
    raises; the median keeps to the smooth half of the image. At least the rounding noise, times the gain that the
    values have been stretched by.
    """
    kernel = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], dtype=np.float32)
    response = np.abs(cv2.filter2D(image, cv2.CV_32F, kernel)[::2, ::2])
    return max(float(np.median(response)) / (0.6745 * 6.0), 0.3 * gain)
