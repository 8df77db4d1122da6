"""Finding and reading markers: OpenCV's detector on the part of the image where the boards were, and on all of it."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from .dictionaries import MarkerDictionary

Float = NDArray[np.float64]
Window = tuple[int, int, int, int]

_FULL_EVERY = 15
"""Frames between looks at the whole image while everything is in view."""
_SMALL_PX = 45.0
"""Markers with a side below this are looked for in the image upsampled twice."""
_UPSAMPLED_AREA = 700_000
"""Largest area of an image, in pixels, that is upsampled at every look."""
_MIN_SIDE_PX = 8.0
_UPSAMPLED_WINDOW_PX = 13
"""Smallest window of the adaptive threshold in an upsampled image. OpenCV's smallest, 3 px, is half a cell of the
smallest marker there: it shows noise, costs a third of the search, and read none of 383 markers in 945 rendered images
that this one did not read with the same corners."""


@dataclass(frozen=True, slots=True)
class Candidate:
    """A marker that was read: corners in raw pixels and OpenCV's order, shape (4, 2)."""

    dictionary: str
    marker: int
    corners: Float

    @property
    def key(self) -> tuple[str, int]:
        return self.dictionary, self.marker


class MarkerSearch:
    """Finds markers of any of some dictionaries, and remembers where."""

    def __init__(self, dictionaries: tuple[MarkerDictionary, ...]) -> None:
        self._names = [d.name for d in dictionaries]
        self._dictionaries = [d.opencv for d in dictionaries]
        self._window: Window | None = None
        self._smallest = 0.0
        self._expected = 0
        self._since_full = 0
        self._blank = 0

    def due(self) -> bool:
        """Is it time to look at the whole image again?"""
        return self._window is None or self._since_full + 1 >= _FULL_EVERY

    def passed(self) -> None:
        """One more image in which nothing had to be looked for."""
        self._since_full += 1

    def find(self, grey: NDArray[np.uint8]) -> list[Candidate]:
        """Markers in a grey image, of any id."""
        height, width = grey.shape
        self._since_full += 1
        if self._window is not None and self._since_full < _FULL_EVERY:
            found = self._detect(grey, self._window, self._smallest < _SMALL_PX)
            if len(found) >= self._expected:
                return found
        self._since_full = 0
        whole = (0, 0, width, height)
        small = width * height <= _UPSAMPLED_AREA
        found = self._detect(grey, whole, small)
        if not found and not small:
            # a large image with nothing in it: look for small markers too, at every fourth try
            self._blank += 1
            found = self._detect(grey, whole, True) if self._blank % 4 == 1 else found
        return found

    def remember(self, corners: list[Float], shape: tuple[int, ...]) -> None:
        """The markers that were accepted, raw pixels: where to look first in the next image."""
        self._expected = len(corners)
        if not corners:
            self._window = None
            return
        quads = np.stack(corners)
        sides = np.hypot(*np.moveaxis(quads - quads[:, [3, 0, 1, 2]], -1, 0)).mean(1)
        points = quads[np.isfinite(quads).all(2)]
        self._smallest = float(sides.min())
        margin = max(20.0, 0.6 * float(sides.max()))
        low, high = np.floor(points.min(0) - margin).astype(int), np.ceil(points.max(0) + margin).astype(int)
        self._window = (
            max(int(low[0]), 0),
            max(int(low[1]), 0),
            min(int(high[0]), shape[1]),
            min(int(high[1]), shape[0]),
        )

    def _detect(self, grey: NDArray[np.uint8], window: Window, upsample: bool) -> list[Candidate]:
        x0, y0, x1, y1 = window
        crop = np.ascontiguousarray(grey[y0:y1, x0:x1])
        scale = 2 if upsample else 1
        if upsample:
            crop = cv2.resize(crop, None, fx=2, fy=2, interpolation=cv2.INTER_LINEAR)
        detector = cv2.aruco.ArucoDetector(self._dictionaries, _parameters(max(crop.shape), scale))
        corners, ids, _, which = detector.detectMarkersMultiDict(crop)
        if ids is None or not len(ids):
            return []
        place = np.array([x0, y0], float)
        return [
            Candidate(self._names[int(w)], int(i), (np.asarray(c, float).reshape(4, 2) + 0.5) / scale - 0.5 + place)
            for c, i, w in zip(corners, np.ravel(ids), np.ravel(which), strict=True)
        ]


def _parameters(longest: int, scale: int) -> cv2.aruco.DetectorParameters:
    """Corners as the contour has them (the fit refines them), and markers down to `_MIN_SIDE_PX`."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_NONE
    parameters.minMarkerPerimeterRate = min(0.5, 4 * _MIN_SIDE_PX * scale / longest)
    parameters.minDistanceToBorder = 1
    if scale > 1:
        parameters.adaptiveThreshWinSizeMin = _UPSAMPLED_WINDOW_PX
    return parameters
