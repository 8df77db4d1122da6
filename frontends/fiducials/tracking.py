"""Following markers from image to image: optical flow of their corners, where the next fit begins."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from .pattern_fit import Warm

Float = NDArray[np.float64]
Grey = NDArray[np.uint8]

_WINDOW_PX = 15
_LEVELS = 3
_MARGIN_PX = 48
"""How far markers may go between two images, beside a share of their board's own size."""
_LEAST_SIDE_PX = 12.0
_FARTHEST_SHARE = 0.35
"""Corners of one marker that flow apart by more than this share of its side have been confused."""


@dataclass(frozen=True, slots=True)
class Followed:
    """A marker that was fitted: where it was, and what the fit knows of its light."""

    dictionary: str
    marker: int
    raw: Float
    """Shape (4, 2), in the image, our corner order."""
    correlation: float
    warm: Warm


class MarkerFlow:
    """Remembers one image's markers and finds where they are in the next."""

    def __init__(self) -> None:
        self._image: Grey | None = None
        self._markers: list[Followed] = []

    @property
    def markers(self) -> list[Followed]:
        return self._markers

    def remember(self, image: Grey, markers: list[Followed]) -> None:
        """An image and what was found in it."""
        self._image, self._markers = image, markers

    def follow(self, image: Grey) -> Float | None:
        """Corners of the remembered markers in a new image, shape (m, 4, 2); None where any of them is lost."""
        if self._image is None or not self._markers or image.shape != self._image.shape:
            return None
        before = np.stack([m.raw for m in self._markers])
        sides = np.linalg.norm(before - np.roll(before, 1, axis=1), axis=2)
        if not np.isfinite(before).all() or sides.min() < _LEAST_SIDE_PX:
            return None
        low, high = before.min((0, 1)), before.max((0, 1))
        margin = _MARGIN_PX + 0.1 * float((high - low).max())
        x0, y0 = np.maximum(low - margin, 0).astype(int)
        x1, y1 = np.minimum(high + margin + 1, image.shape[::-1]).astype(int)
        place = np.array([x0, y0], float)
        start = np.ascontiguousarray((before - place).reshape(-1, 1, 2), np.float32)
        moved, found, _ = cv2.calcOpticalFlowPyrLK(
            self._image[y0:y1, x0:x1],
            image[y0:y1, x0:x1],
            start,
            None,  # type: ignore[arg-type]
            winSize=(_WINDOW_PX, _WINDOW_PX),
            maxLevel=_LEVELS,
        )
        if moved is None or not np.all(found):
            return None
        after = moved.reshape(-1, 4, 2).astype(float) + place
        flow = after - before
        apart = np.linalg.norm(flow - np.median(flow, axis=1, keepdims=True), axis=2)
        if (apart > _FARTHEST_SHARE * sides.min(1, keepdims=True)).any():
            return None
        return after
