"""All charts of a scene in one mip-mapped image: one lookup serves every ray."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

SCALE = 12000.0
"""Radiance 1 as stored; sixteen bits hold up to 5.4."""
_LEVELS = 9
_BORDER = 1
_ROW = 8192


@dataclass(frozen=True, slots=True)
class Atlas:
    """The packed mip levels. A chart's level l starts at `offset_px[chart, l]` and has texels 2^l times as large."""

    image: NDArray[np.uint16]
    offset_px: NDArray[np.float32]
    """Shape (charts, levels, 2): atlas position of chart coordinate 0, pixel centres at integers."""
    top_level: NDArray[np.int32]
    """Shape (charts,), the coarsest level of each chart."""

    def sample(self, chart: NDArray[np.int32], texels: NDArray[np.float32], level: NDArray[np.float32]) -> NDArray:
        """Trilinear radiance, shape (n,).

        Args:
            chart: shape (n,).
            texels: chart coordinates in texels of level 0, shape (2, n), inside the chart.
            level: wanted level, a texel of level l being 2^l of level 0, shape (n,).
        """
        level = np.clip(level, 0, self.top_level[chart])
        low = level.astype(np.int32)
        share = level - low
        fine = self._bilinear(chart, texels, low)
        coarse = self._bilinear(chart, texels, np.minimum(low + 1, self.top_level[chart]))
        return (fine + share * (coarse - fine)) * np.float32(1 / SCALE)

    def _bilinear(
        self, chart: NDArray[np.int32], texels: NDArray[np.float32], level: NDArray[np.int32]
    ) -> NDArray[np.float32]:
        offset = self.offset_px.reshape(-1, 2)[chart * self.offset_px.shape[1] + level]
        size = np.ldexp(np.float32(1), -level)
        # remap's output is limited to 32767 pixels a side: fold the rays into rows of 1024.
        count = len(chart)
        rows = -(-count // 1024)
        x = np.zeros(rows * 1024, np.float32)
        y = np.zeros(rows * 1024, np.float32)
        np.multiply(texels[0], size, out=x[:count])
        x[:count] += offset[:, 0]
        np.multiply(texels[1], size, out=y[:count])
        y[:count] += offset[:, 1]
        shape = (rows, 1024)
        found = cv2.remap(
            self.image, x.reshape(shape), y.reshape(shape), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        return found.reshape(-1)[:count].astype(np.float32)


def build_atlas(charts: list[NDArray[np.float32]]) -> Atlas:
    """Pack the charts (radiance, shape (rows, columns) each) with their mip levels."""
    levels = [_mip_levels(chart) for chart in charts]
    places, height = _pack([level.shape for chart in levels for level in chart])
    image = np.zeros((height, _ROW), np.uint16)
    offset = np.zeros((len(charts), _LEVELS, 2), np.float32)
    place = iter(places)
    for index, chart in enumerate(levels):
        for number, level in enumerate(chart):
            row, column = next(place)
            image[row : row + level.shape[0], column : column + level.shape[1]] = level
            offset[index, number] = column + _BORDER - 0.5, row + _BORDER - 0.5
    top = np.array([len(chart) - 1 for chart in levels], np.int32)
    return Atlas(image, offset, top)


def _mip_levels(chart: NDArray[np.float32]) -> list[NDArray[np.uint16]]:
    """The chart and its halvings (box filter), each with a border for the bilinear lookup."""
    levels = []
    current = chart
    while True:
        bordered = cv2.copyMakeBorder(current, _BORDER, _BORDER, _BORDER, _BORDER, cv2.BORDER_REPLICATE)
        levels.append(np.clip(bordered * SCALE + 0.5, 0, 65535).astype(np.uint16))
        if len(levels) == _LEVELS or min(current.shape) < 2:
            return levels
        even = cv2.copyMakeBorder(current, 0, current.shape[0] % 2, 0, current.shape[1] % 2, cv2.BORDER_REPLICATE)
        current = even.reshape(even.shape[0] // 2, 2, even.shape[1] // 2, 2).mean(axis=(1, 3))


def _pack(shapes: list[tuple[int, ...]]) -> tuple[list[tuple[int, int]], int]:
    """Shelf packing: top left (row, column) of each rectangle, and the height used."""
    places: list[tuple[int, int]] = [(0, 0)] * len(shapes)
    row = column = shelf = 0
    for index in sorted(range(len(shapes)), key=lambda i: shapes[i][0], reverse=True):
        high, wide = shapes[index]
        if wide > _ROW:
            raise ValueError(f"a chart of {wide} texels is wider than the atlas; use larger texels")
        if column + wide > _ROW:
            row, column, shelf = row + shelf, 0, 0
        places[index] = row, column
        column += wide
        shelf = max(shelf, high)
    return places, row + shelf
