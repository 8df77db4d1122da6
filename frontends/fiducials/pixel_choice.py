"""Which pixels tell where a marker's corners are: those near the edges of its pattern, spread evenly."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .pattern_model import homography

# NumPy's own annotations widen every sum and product: double and single precision are told apart for the reader
Float = NDArray[Any]
Single = NDArray[Any]
Window = tuple[int, int, int, int]
Windows = Sequence[Window]

_MARGIN_CELLS = 0.9
"""How far outside the border the page is taken to be white."""
_SPARE = 2.0
"""Places per wanted pixel: some fall on the same one."""
_GOLDEN = 0.6180339887498949


@dataclass(frozen=True, slots=True)
class Pixels:
    """Chosen pixels, m markers by n pixels, padded with weight 0."""

    origin: Float
    """Shape (m, 2): near the marker, taken off the positions to keep single precision fine."""
    xy: Single
    """Shape (m, 2, n)."""
    value: Single
    weight: Single

    def of(self, which: NDArray[np.int64]) -> "Pixels":
        if len(which) == len(self.value):
            return self
        return Pixels(self.origin[which], self.xy[which], self.value[which], self.weight[which])


@dataclass(frozen=True, slots=True)
class Choice:
    """Which pixels of a marker are looked at."""

    reach_px: Float
    """Distance from an edge of the pattern, shape (m,)."""
    most: int


def choose_pixels(
    image: NDArray[np.uint8],
    positions: Float | None,
    raw: Float,
    corners: Float,
    patterns: list[Float],
    choice: Choice,
) -> Pixels:
    """Pixels near the edges of each marker's pattern, spread evenly along them.

    Args:
        positions: the ideal pixel of each image pixel, shape (height, width, 2); None where they are the same.
        raw: corners in the image, shape (m, 4, 2). Within a marker the lens is taken for straight here: its bend is
            far less than the reach, and decides on nothing but which pixels are looked at.
        corners: the same in ideal pixels.
    """
    width = image.shape[1]
    origin = corners.mean(1)
    chosen = _distinct(_near_edges(raw, patterns, choice), image.shape, choice.most)
    m, n = len(corners), max((len(c) for c in chosen), default=0)
    index, weight = np.zeros((m, n), np.int64), np.zeros((m, n), np.float32)
    for k, mine in enumerate(chosen):
        count = len(mine)
        if count:
            index[k, :count], index[k, count:], weight[k, :count] = mine, mine[0], 1.0
    flat = index.ravel()
    value = image.reshape(-1)[flat].astype(np.float32).reshape(m, n)
    if positions is None:
        rows = index // width
        xy = np.stack([index - rows * width, rows], 1)
    else:
        xy = positions.reshape(-1, 2)[flat].reshape(m, n, 2).transpose(0, 2, 1)
    return Pixels(origin, np.ascontiguousarray(xy - origin[..., None], np.float32), value, weight)


def _near_edges(raw: Float, patterns: list[Float], choice: Choice) -> Float:
    """Places on both sides of the edges of each marker, shape (m, 2, n), in the image."""
    H = homography(raw).astype(np.float32)
    samples = _samples_of(tuple(p.tobytes() for p in patterns), len(patterns[0]), round(_SPARE * choice.most))
    sides = np.linalg.norm(raw[:, [1, 3]] - raw[:, :1] + raw[:, 2:3] - raw[:, [3, 1]], axis=2) / 2
    cell = 1.0 / len(patterns[0])
    reach = np.minimum(choice.reach_px[:, None] / sides, _MARGIN_CELLS * cell).astype(np.float32)
    q = H[:, :, :2] @ (samples[:, :2] + samples[:, 2:] * reach[:, :, None])
    q += H[:, :, 2:]
    q[:, 2][q[:, 2] <= 0] = np.nan
    return q[:, :2] / q[:, 2:]


@lru_cache(maxsize=256)
def _samples_of(patterns: tuple[bytes, ...], cells: int, count: int) -> Single:
    """Of several patterns, see `_samples`: places, and shifts off the edge in units of the reach; shape (m, 4, n)."""
    samples = np.stack([_samples(pattern, cells, count) for pattern in patterns])
    parts = samples[..., :2], samples[..., 2:4] * samples[..., 4:]
    return np.ascontiguousarray(np.concatenate(parts, -1).transpose(0, 2, 1), np.float32)


def _samples(pattern: bytes, cells: int, count: int) -> Float:
    """Points along the edges of a pattern: place (2) in the unit square, unit vector across (2), and how far (1) in
    units of the reach, -1 to 1. Shape (count, 5). Evenly spread by the golden ratio (a Kronecker sequence)."""
    across_x, across_y = _edges(np.frombuffer(pattern).reshape(cells, cells))
    pieces = [(line, along - 1, 1.0, 0.0) for line, along in np.argwhere(across_x)]
    pieces += [(along - 1, line, 0.0, 1.0) for line, along in np.argwhere(across_y)]
    edge = np.array(pieces, float)
    k = np.arange(count)
    at = (k + 0.5) / count * len(edge)
    piece = np.minimum(at.astype(int), len(edge) - 1)
    result = np.empty((count, 5))
    result[:, 2:4] = edge[piece, 2:]
    result[:, :2] = (edge[piece, :2] + (at - piece)[:, None] * result[:, 3:1:-1]) / cells
    result[:, 4] = 2.0 * (k * _GOLDEN % 1.0) - 1.0
    return result


def _distinct(places: Float, shape: tuple[int, ...], most: int) -> list[NDArray[np.int64]]:
    """Flat indices of the pixels that places (m, 2, n) fall on, in order, each once, in the image, not too many."""
    height, width = shape[:2]
    near = np.rint(places)
    x, y = near[:, 0], near[:, 1]
    inside = (x >= 0) & (y >= 0) & (x < width) & (y < height)
    # in double precision: a large image has more pixels than single precision has whole numbers
    flat = np.where(inside, y.astype(float) * width + x, -1.0).astype(np.int64)
    flat.sort(axis=1)
    first = flat >= 0
    first[:, 1:] &= flat[:, 1:] != flat[:, :-1]
    chosen = [row[keep] for row, keep in zip(flat, first, strict=True)]
    return [c if len(c) <= most else c[np.linspace(0, len(c) - 1, most).astype(np.int64)] for c in chosen]


def _edges(pattern: Float) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which pieces of the grid lines part black from white: [line in x, cell in y] and [line in y, cell in x].

    Lines and cells count from one cell outside the border on the cells' side; a line outside (index -1) is no edge.
    """
    n = len(pattern)
    extended = np.ones((n + 2, n + 2))
    extended[1:-1, 1:-1] = pattern
    across, along = np.zeros((n + 3, n + 2), bool), np.zeros((n + 3, n + 2), bool)
    across[: n + 1] = np.diff(extended, axis=0) != 0
    along[: n + 1] = np.diff(extended.T, axis=0) != 0
    return across, along


def surroundings(corners: Float, cells: int, size: tuple[int, int]) -> list[Window]:
    """x0, y0, x1, y1 (exclusive) round each marker (m, 4, 2) and a little more than a cell, within an image of a size
    (width, height)."""
    diagonal = np.hypot(*(corners[:, 2:] - corners[:, :2]).transpose(2, 0, 1)).max(1)
    grow = (diagonal / cells + 2.0)[:, None]
    low = np.maximum(np.nan_to_num(corners.min(1) - grow).astype(int), 0)
    high = np.minimum(np.nan_to_num(corners.max(1) + grow).astype(int) + 2, size)
    return [(x0, y0, x1, y1) for (x0, y0), (x1, y1) in zip(low.tolist(), high.tolist(), strict=True)]
