"""One stereo pair, made comparable with the pair before."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from . import images
from .images import Image, Picture

Float = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class StereoPair:
    """Grey images with the gain of a dark view taken up."""

    stamp_ns: int
    left: Image
    right: Image
    levels: Float
    """Shape (3,), quantiles of the left image."""
    gain: float = 1.0
    """By which the grey values were stretched."""

    def noise(self) -> float:
        """Standard deviation of the pixel noise, grey values; takes half a millisecond, and keyframes alone need it."""
        return images.noise_sigma(self.left, self.gain)

    def smooth(self, sigma_px: float) -> tuple[Picture, Picture]:
        """Both images as floats, low-passed."""
        return images.dense(self.left, sigma_px), images.dense(self.right, sigma_px)

    def left_as_bright_as(self, other: "StereoPair") -> Image:
        """The left image with the other pair's exposure."""
        table = images.brightness_table(self.levels, other.levels)
        return self.left if table is None else cv2.LUT(self.left, table).astype(np.uint8, copy=False)


def prepare(stamp_ns: int, left: NDArray[np.generic], right: NDArray[np.generic]) -> StereoPair:
    """A pair from camera images (h, w) or (h, w, 3)."""
    grey = (images.to_grey(left), images.to_grey(right))
    levels = images.quantiles(grey[0])
    stretch = images.contrast_table(levels)
    if stretch is None:
        return StereoPair(stamp_ns, *grey, levels)
    table, gain = stretch
    bright = tuple(cv2.LUT(image, table).astype(np.uint8, copy=False) for image in grey)
    return StereoPair(stamp_ns, bright[0], bright[1], images.quantiles(bright[0]), gain)
