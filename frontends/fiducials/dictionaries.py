"""Marker dictionaries by name, their printed patterns, and the corner orders of those who detect them."""

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from ...factors.errors import RigError

_FROM_OPENCV = (3, 2, 1, 0)
"""Our corner k is OpenCV's corner _FROM_OPENCV[k]: lower left, lower right, upper right, upper left."""
_FROM_OPENCV_APRILTAG = (1, 0, 3, 2)
"""The same for OpenCV's AprilTag dictionaries, which hold the patterns turned by 180 degrees."""


@dataclass(frozen=True, slots=True)
class MarkerDictionary:
    """One family of markers, as OpenCV knows it."""

    name: str
    """The canonical OpenCV name."""
    opencv: cv2.aruco.Dictionary
    cells: int
    """Cells along a side, with the black border of one cell on either end."""
    from_opencv: tuple[int, int, int, int]
    """Index of OpenCV's corner for each of ours."""

    def pattern(self, marker: int) -> NDArray[np.float64]:
        """Reflectance of the cells, 0 black and 1 white, shape (cells, cells), indexed [x to the right, y up]."""
        image = self.opencv.generateImageMarker(marker, self.cells).astype(float) / 255.0
        upright = image[::-1, ::-1] if self.from_opencv == _FROM_OPENCV_APRILTAG else image
        return upright[::-1].T.copy()

    @property
    def size(self) -> int:
        """Number of markers."""
        return len(self.opencv.bytesList)


def canonical_name(name: str) -> str:
    """`DICT_APRILTAG_36h11` for `tag36h11`, `36h11` and other spellings; unknown names come back unchanged."""
    plain = name.strip().upper().removeprefix("DICT_").replace("-", "_")
    for prefix in ("APRILTAG_", "APRILTAG", "TAG_", "TAG"):
        if plain.startswith(prefix):
            plain = plain.removeprefix(prefix)
            break
    known = _names()
    return known.get(plain, known.get("APRILTAG_" + plain, name))


@lru_cache(maxsize=1)
def _names() -> dict[str, str]:
    """Canonical names by their upper-case spelling without `DICT_`."""
    names = sorted(n for n in dir(cv2.aruco) if n.startswith("DICT_"))
    return {n.upper().removeprefix("DICT_"): n for n in reversed(names)} | {
        n.upper().removeprefix("DICT_"): n for n in names if "h" in n
    }


def all_names() -> tuple[str, ...]:
    """Every dictionary that OpenCV can find in an image."""
    return tuple(sorted(set(_names().values())))


@lru_cache(maxsize=64)
def marker_dictionary(name: str) -> MarkerDictionary:
    """The dictionary of that name (any spelling that `canonical_name` knows), or of a file in OpenCV's format.

    Raises:
        RigError: OpenCV has no such dictionary, or the file cannot be read.
    """
    if name.lower().endswith((".yml", ".yaml", ".json", ".xml")):
        return _from_file(name)
    canonical = canonical_name(name)
    value = getattr(cv2.aruco, canonical, None)
    if value is None or not canonical.startswith("DICT_"):
        raise RigError(f"dictionary {name!r} is not known; known are {', '.join(all_names())}")
    opencv = cv2.aruco.getPredefinedDictionary(value)
    order = _FROM_OPENCV_APRILTAG if "APRILTAG" in canonical else _FROM_OPENCV
    return MarkerDictionary(canonical, opencv, opencv.markerSize + 2, order)


def _from_file(name: str) -> MarkerDictionary:
    """A user's own dictionary: `nmarkers`, `markersize`, `maxCorrectionBits` and the bits, as OpenCV writes them."""
    if not Path(name).is_file():
        raise RigError(f"dictionary file {name} is not there; give its path from where surecut is started")
    opencv = cv2.aruco.Dictionary()
    storage = cv2.FileStorage(name, cv2.FILE_STORAGE_READ)
    if not opencv.readDictionary(storage.root()) or opencv.markerSize < 2:
        raise RigError(f"dictionary file {name} is no dictionary in OpenCV's format")
    return MarkerDictionary(name, opencv, opencv.markerSize + 2, _FROM_OPENCV)
