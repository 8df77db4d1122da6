"""Which pixels tell where a marker's corners are: those near the edges of its pattern, spread evenly."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .pattern_model import UNIT, homography

# NumPy's own annotations widen every sum and product: double and single precision are told apart for the reader
Float = NDArray[Any]
Single = NDArray[Any]
Window = tuple[int, int, int, int]
Windows = Sequence[Window]

_MARGIN_CELLS = 0.9
"""How far outside the border the page is taken to be white."""
_BLOCK_PX, _BLOCK_PIXELS = 3, 8
"""Least size of the blocks in which residuals are tested for hanging together, and chosen pixels in each."""


@dataclass(frozen=True, slots=True)
class Pixels:
    """Chosen pixels, m markers by n pixels, padded with weight 0; in no order of place."""

    origin: Float
    """Shape (m, 2): near the marker, taken off the positions to keep single precision fine."""
    xy: Single
    value: Single
    weight: Single
    block: NDArray[np.int64]
    """Which small block of the image a pixel is in, from 0 in each marker."""

    def of(self, which: NDArray[np.int64]) -> "Pixels":
        if len(which) == len(self.value):
            return self
        return Pixels(self.origin[which], self.xy[which], self.value[which], self.weight[which], self.block[which])


@dataclass(frozen=True, slots=True)
class Choice:
    """Which pixels of a marker are looked at."""

    reach_px: Float
    """Distance from an edge of the pattern, shape (m,)."""
    lattice: int
    """Pixels that are looked at to choose from."""
    most: int


def choose_pixels(
    image: NDArray[np.uint8],
    positions: Float | None,
    windows: Windows,
    corners: Float,
    patterns: list[Float],
    choice: Choice,
) -> Pixels:
    """Pixels near the edges of each marker's pattern, spread evenly.

    `positions` holds the ideal pixel of each image pixel, shape (height, width, 2); None where they are the same.
    """
    width = image.shape[1]
    origin = corners.mean(1)
    H = homography(corners)
    chosen = [
        _near_edges(H[k], patterns[k], width, positions, windows[k], choice, choice.reach_px[k])
        for k in range(len(corners))
    ]
    n = max((len(c) for c in chosen), default=0)
    m = len(corners)
    xy, value, weight = np.zeros((m, n, 2), np.float32), np.zeros((m, n), np.float32), np.zeros((m, n), np.float32)
    block = np.zeros((m, n), np.int64)
    for k, index in enumerate(chosen):
        rows, columns = np.divmod(index, width)
        count = len(index)
        here = np.column_stack([columns, rows]) if positions is None else positions[rows, columns]
        xy[k, :count], value[k, :count], weight[k, :count] = here - origin[k], image[rows, columns], 1.0
        if count:
            x0, y0, x1, y1 = windows[k]
            size = max(_BLOCK_PX, int(np.sqrt((x1 - x0) * (y1 - y0) * _BLOCK_PIXELS / count)))
            across = (columns - x0) // size
            block[k, :count] = (rows - y0) // size * ((x1 - x0) // size + 1) + across
    return Pixels(origin, xy, value, weight, block)


def _near_edges(
    H: Float, pattern: Float, width: int, positions: Float | None, window: Window, choice: Choice, reach_px: float
) -> NDArray[np.int64]:
    """Flat indices of the pixels of one marker, in no order of place."""
    x0, y0, x1, y1 = window
    if x1 - x0 < 4 or y1 - y0 < 4:
        return np.zeros(0, np.int64)
    # every so manieth pixel: on a large marker enough to choose from; the odd step runs along no edge for long
    step = max(1, (x1 - x0) * (y1 - y0) // choice.lattice)
    step += (x1 - x0) % step == 0 and step > 1
    rows, columns = np.divmod(np.arange(0, (x1 - x0) * (y1 - y0), step), x1 - x0)
    rows, columns = rows + y0, columns + x0
    xy = np.column_stack([columns, rows]).astype(float) if positions is None else positions[rows, columns]
    inverse = np.linalg.inv(H)
    r = xy @ inverse[:, :2].T + inverse[:, 2]
    cells = len(pattern)
    a, b = r[:, 0] / r[:, 2] * cells, r[:, 1] / r[:, 2] * cells
    off = np.maximum(np.abs(a - cells / 2), np.abs(b - cells / 2))
    inside = (r[:, 2] > 0) & (off < cells / 2 + _MARGIN_CELLS)
    a, b = a[inside], b[inside]
    corners = (H @ np.column_stack([UNIT, np.ones(4)]).T).T
    corners = corners[:, :2] / corners[:, 2:]
    u = float(np.linalg.norm(corners[1] - corners[0] + corners[2] - corners[3])) / 2
    v = float(np.linalg.norm(corners[3] - corners[0] + corners[2] - corners[1])) / 2
    in_x, in_y = _edges(pattern)
    near = _edge_within(a, b, in_x, reach_px * cells / u) | _edge_within(b, a, in_y, reach_px * cells / v)
    index = (rows * width + columns)[inside][near]
    scatter = (index * 2654435761) % 4294967296
    if len(index) <= choice.most:
        return index
    return index[np.argpartition(scatter, choice.most)[: choice.most]]


def _edge_within(across: Float, along: Float, edges: NDArray[np.bool_], reach_cells: float) -> NDArray[np.bool_]:
    """Whether the grid line nearest in `across` is an edge of the pattern there, and within reach."""
    line = np.rint(across).astype(np.intp)
    cell = np.floor(along).astype(np.intp) + 1
    return edges[line, cell] & (np.abs(across - line) < reach_cells)


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


def surroundings(corners: Float, cells: int, size: tuple[int, int]) -> Window:
    """x0, y0, x1, y1 (exclusive) round a marker and a little more than a cell, within an image (width, height)."""
    diagonal = max(np.linalg.norm(corners[2] - corners[0]), np.linalg.norm(corners[3] - corners[1]))
    grow = diagonal / cells + 2.0
    low, high = np.nan_to_num(corners.min(0) - grow), np.nan_to_num(corners.max(0) + grow)
    x0, y0 = max(int(low[0]), 0), max(int(low[1]), 0)
    return x0, y0, min(int(high[0]) + 2, size[0]), min(int(high[1]) + 2, size[1])
