"""A drawing as a list of strokes, so that HTML and PDF show the same one. Points (1/72 inch), y downwards."""

from dataclasses import dataclass
from typing import Literal, TypedDict, Unpack

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]


class Style(TypedDict, total=False):
    """The fields of `Path` that say how it is drawn."""

    pen: float
    grey: float
    fill: float | None
    dash: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Path:
    """A polyline or polygon."""

    points: Float
    """Shape (n, 2)."""
    closed: bool = False
    pen: float = 0.8
    """Width of the stroke; 0 for none."""
    grey: float = 0.0
    """Of the stroke: 0 black, 1 white."""
    fill: float | None = None
    """Grey of the area."""
    dash: tuple[float, ...] = ()


@dataclass(frozen=True, slots=True)
class Label:
    """A line of text; (x, y) is on its base line."""

    x: float
    y: float
    text: str
    size: float = 8.0
    anchor: Literal["start", "middle", "end"] = "start"
    bold: bool = False
    italic: bool = False
    grey: float = 0.0


@dataclass(frozen=True, slots=True)
class Picture:
    """A raster image under the strokes."""

    x: float
    y: float
    width: float
    height: float
    data: bytes
    """PNG or JPEG."""


Stroke = Path | Label | Picture


@dataclass(frozen=True, slots=True)
class Figure:
    """Width and height in points, strokes in painting order, and what it shows in words."""

    width: float
    height: float
    strokes: tuple[Stroke, ...]
    title: str


def line(x1: float, y1: float, x2: float, y2: float, **style: Unpack[Style]) -> Path:
    """A straight stroke."""
    return Path(np.array([[x1, y1], [x2, y2]]), **style)


def rectangle(x: float, y: float, width: float, height: float, **style: Unpack[Style]) -> Path:
    """Upper left corner, width, height."""
    corners = np.array([[x, y], [x + width, y], [x + width, y + height], [x, y + height]])
    return Path(corners, closed=True, **style)


def ellipse(centre: tuple[float, float], covariance: Float, factor: float, **style: Unpack[Style]) -> Path:
    """The curve at `factor` standard deviations of a 2-D covariance, shape (2, 2)."""
    values, vectors = np.linalg.eigh(covariance)
    turn = np.linspace(0, 2 * np.pi, 97)[:-1]
    unit = np.stack([np.cos(turn), np.sin(turn)])
    curve = vectors @ (factor * np.sqrt(np.maximum(values, 0))[:, None] * unit)
    return Path(curve.T + np.asarray(centre), closed=True, **style)


def clipped(path: Path, x: float, y: float, width: float, height: float) -> Path | None:
    """A closed path cut to a rectangle (Sutherland and Hodgman 1974); None where nothing is left."""
    points = path.points
    for axis, limit, sign in ((0, x, 1), (0, x + width, -1), (1, y, 1), (1, y + height, -1)):
        points = _clip_side(points, axis, limit, sign)
        if len(points) < 3:
            return None
    return Path(points, path.closed, path.pen, path.grey, path.fill, path.dash)


def _clip_side(points: Float, axis: int, limit: float, sign: int) -> Float:
    kept: list[Float] = []
    depth = sign * (points[:, axis] - limit)
    for i in range(len(points)):
        a, b, da, db = points[i - 1], points[i], depth[i - 1], depth[i]
        if da * db < 0:
            kept.append(a + (b - a) * da / (da - db))
        if db >= 0:
            kept.append(b)
    return np.array(kept).reshape(-1, 2)
