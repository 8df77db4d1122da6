"""The clicked image with the estimate's 95 % region drawn over it."""

import io

import numpy as np
from PIL import Image, UnidentifiedImageError

from ..result import PickView
from .figure import Figure, Label, Path, Picture, Stroke, clipped, ellipse, line

K2 = float(np.sqrt(-2 * np.log(0.05)))
"""Coverage factor of a 2-D region, 2.45 for 95 %."""
WIDTH = 240.0
LARGEST = 960
"""Wider images are scaled down, so that a report stays small [px]."""


def pick_figure(view: PickView) -> Figure:
    """Image, cross and curve; white under black, so that both show on any ground."""
    try:
        data, (columns, rows) = _small(view.image)
    except (UnidentifiedImageError, OSError, ValueError):
        return Figure(WIDTH, 20, (Label(0, 12, "The image cannot be decoded."),), "Image missing")
    scale = WIDTH / columns
    height = rows * scale
    # OpenCV puts (0, 0) on the centre of the first pixel, the figure on its corner.
    x, y = (np.asarray(view.pixel) + 0.5) * scale
    strokes: list[Stroke] = [Picture(0, 0, WIDTH, height, data)]
    if np.isfinite([x, y]).all() and np.isfinite(view.ellipse_px2).all():
        curve = clipped(ellipse((x, y), view.ellipse_px2 * scale**2, K2), 0, 0, WIDTH, height)
        strokes += _twice([] if curve is None else [curve])
        strokes += _twice(
            [line(x - 9, y, x - 3, y), line(x + 3, y, x + 9, y), line(x, y - 9, x, y - 3), line(x, y + 3, x, y + 9)]
        )
    return Figure(WIDTH, height, tuple(strokes), f"{view.point_id} in {view.camera} with its 95 % region")


def _twice(paths: list[Path]) -> list[Stroke]:
    wide = [Path(p.points, p.closed, 2.6, 1.0) for p in paths]
    return [*wide, *(Path(p.points, p.closed, 1.1, 0.0) for p in paths)]


def _small(data: bytes) -> tuple[bytes, tuple[int, int]]:
    """The image as PNG or JPEG of at most LARGEST columns, and its original size."""
    with Image.open(io.BytesIO(data)) as image:
        size = image.size
        if image.width <= LARGEST and image.format in ("PNG", "JPEG"):
            return data, size
        rows = max(1, round(image.height * LARGEST / image.width))
        small = image.convert("L" if image.mode in ("L", "I;16", "1") else "RGB").resize((LARGEST, rows))
    stream = io.BytesIO()
    small.save(stream, "JPEG", quality=82)
    return stream.getvalue(), size
