"""The part of an image round a click, small enough to be kept."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..factors.errors import SurecutError

LARGEST_PX = 240
SMALLEST_PX = 120
SHARE = 3
"""A cut-out shows so much of the image's width: enough to know the place, and each pixel of the click still shows."""


@dataclass(frozen=True, slots=True)
class CutOut:
    """A piece of a grey image."""

    png: bytes
    corner_px: tuple[int, int]
    """Column and row of its first pixel in the whole image."""


def cut_out(image: NDArray[np.uint8], px: NDArray[np.float64]) -> CutOut:
    """The neighbourhood of a pixel, 120 to 240 pixels wide and high (less where the image is smaller), as grey PNG.

    Args:
        image: shape (height, width) or (height, width, 3), the latter BGR.
        px: shape (2,), the click; near the border it is not in the middle.

    Raises:
        SurecutError: the image is empty.
    """
    if image.size == 0:
        raise SurecutError("the image under a pick is empty; record images of the camera")
    height, width = image.shape[:2]
    side = int(np.clip(width // SHARE, SMALLEST_PX, LARGEST_PX))
    size = min(side, width), min(side, height)
    column = int(np.clip(round(float(px[0])) - size[0] // 2, 0, width - size[0]))
    row = int(np.clip(round(float(px[1])) - size[1] // 2, 0, height - size[1]))
    part = image[row : row + size[1], column : column + size[0]]
    grey = part if part.ndim == 2 else cv2.cvtColor(part, cv2.COLOR_BGR2GRAY)
    written, data = cv2.imencode(".png", np.ascontiguousarray(grey), [cv2.IMWRITE_PNG_COMPRESSION, 9])
    if not written:
        raise SurecutError("the image under a pick cannot be stored as PNG; record 8 bit images")
    return CutOut(data.tobytes(), (column, row))
