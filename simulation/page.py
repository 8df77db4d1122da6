"""The fiducial page as it hangs in the cell: paper with printed markers, at true size."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

_INK, _PAPER = 0.045, 0.78
_SUB = 4


@dataclass(frozen=True, slots=True)
class PrintedMarker:
    """One marker as printed. Corners 0..3 = (-,-), (+,-), (+,+), (-,+) in its own frame, x right, y up."""

    id: int
    pattern_id: int
    """What is really printed there; differs from `id` where two markers were swapped."""
    centre_m: tuple[float, float]
    side_m: float
    rotation_rad: float = 0.0

    def corners_m(self) -> NDArray[np.float64]:
        """True corners on the page, shape (4, 3), z = 0."""
        half = self.side_m / 2
        square = np.array([[-half, -half], [half, -half], [half, half], [-half, half]])
        c, s = np.cos(self.rotation_rad), np.sin(self.rotation_rad)
        flat = square @ np.array([[c, s], [-s, c]]) + self.centre_m
        return np.concatenate([flat, np.zeros((4, 1))], axis=1)


def page_texture(
    markers: Sequence[PrintedMarker], dictionary: str = "DICT_4X4_50"
) -> Callable[..., NDArray[np.float32]]:
    """Texture of a page: chart u = x + width/2, v = height/2 - y."""

    def texture(width_m: float, height_m: float, texel_m: float, rng: np.random.Generator) -> NDArray[np.float32]:
        rows, columns = int(np.ceil(height_m / texel_m - 1e-9)), int(np.ceil(width_m / texel_m - 1e-9))
        page = np.full((rows, columns), _PAPER, np.float32)
        for marker in markers:
            _print(page, marker, (width_m, height_m), texel_m, dictionary)
        coarse = rng.standard_normal((9, 12)).astype(np.float32)
        shade = cv2.resize(coarse, (columns, rows), interpolation=cv2.INTER_CUBIC)
        return (page * (1 + 0.012 * shade)).astype(np.float32)

    return texture


def _print(
    page: NDArray[np.float32], marker: PrintedMarker, page_m: tuple[float, float], texel_m: float, dictionary: str
) -> None:
    """Print one marker in place, every texel with its exact share of ink to 1/16."""
    cells = marker_cells(dictionary, marker.pattern_id)
    centre = np.array([marker.centre_m[0] + page_m[0] / 2, page_m[1] / 2 - marker.centre_m[1]]) / texel_m
    reach = marker.side_m * 0.75 / texel_m + 2
    left, top = np.maximum(np.floor(centre - reach).astype(int), 0)
    right, bottom = np.minimum(np.ceil(centre + reach).astype(int), page.shape[::-1])
    sub = (np.arange(_SUB) + 0.5) / _SUB
    x = (np.arange(left, right)[:, None] + sub).ravel() * texel_m - page_m[0] / 2 - marker.centre_m[0]
    y = page_m[1] / 2 - (np.arange(top, bottom)[:, None] + sub).ravel() * texel_m - marker.centre_m[1]
    c, s = np.cos(marker.rotation_rad), np.sin(marker.rotation_rad)
    along = (c * x[None, :] + s * y[:, None]) / marker.side_m + 0.5
    down = 0.5 - (-s * x[None, :] + c * y[:, None]) / marker.side_m
    count = len(cells)
    inside = (along >= 0) & (along < 1) & (down >= 0) & (down < 1)
    column = np.clip((along * count).astype(int), 0, count - 1)
    row = np.clip((down * count).astype(int), 0, count - 1)
    black = inside & (cells[row, column] == 0)
    share = black.reshape(bottom - top, _SUB, right - left, _SUB).mean(axis=(1, 3), dtype=np.float32)
    page[top:bottom, left:right] += share * np.float32(_INK - _PAPER)


def marker_cells(dictionary: str, marker_id: int) -> NDArray[np.uint8]:
    """Cells of an upright marker with its border, 0 black, 255 white, shape (n, n)."""
    known = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
    count = known.markerSize + 2
    return np.asarray(cv2.aruco.generateImageMarker(known, marker_id, count, borderBits=1), np.uint8)
