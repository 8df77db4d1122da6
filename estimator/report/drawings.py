"""The report's figures: verdict sign, three views, bars of the budget, acceptance intervals."""

from dataclasses import dataclass, replace
from typing import Unpack

import numpy as np
from numpy.typing import NDArray

from ...factors.rig import Cut
from ..decision import Verdict, along_room_m
from ..result import FamilyConsistency, PointEstimate
from .axes import K3, Triad, is_upright, triad
from .figure import Figure, Label, Path, Stroke, Style, clipped, ellipse, line, rectangle
from .text import significant

Float = NDArray[np.float64]

WIDTH = 504.0
"""Of the text on an A4 page, points."""
LIGHT, MIDDLE = 0.86, 0.55
MEASURED: Style = {"pen": 1.3, "fill": 0.72}
WITH_TOOL: Style = {"pen": 1.1, "dash": (1.5, 2.0)}
TOLERANCE: Style = {"pen": 1.0, "dash": (6.0, 2.5), "fill": 0.94}


def verdict_sign(verdict: Verdict | None) -> Figure:
    """A tick in a circle, a bar in an octagon, a question mark in a triangle; an empty circle without a verdict."""
    strokes: tuple[Stroke, ...]
    if verdict == "GO":
        tick = Path(np.array([[12.0, 24.5], [20.5, 33.0], [36.0, 15.0]]), pen=4.5)
        strokes = (_polygon(64, 21.0, pen=2.4), tick)
    elif verdict == "NO-GO":
        strokes = (_polygon(8, 22.0, np.pi / 8, fill=0.0), rectangle(11, 20, 26, 8, pen=0, fill=1.0))
    elif verdict == "MEASURE MORE":
        corners = np.array([[24.0, 3.0], [46.0, 43.0], [2.0, 43.0]])
        strokes = (Path(corners, closed=True, pen=2.6), Label(24, 38, "?", 26, "middle", bold=True))
    else:
        strokes = (_polygon(64, 21.0, pen=2.4, dash=(4, 3)), line(14, 24, 34, 24, pen=3))
    return Figure(48, 48, strokes, f"Sign: {verdict or 'no verdict'}")


def _polygon(corners: int, radius: float, turn: float = 0.0, **style: Unpack[Style]) -> Path:
    angle = turn + np.arange(corners) * 2 * np.pi / corners
    points = 24 + radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return Path(points, closed=True, **style)


@dataclass(frozen=True, slots=True)
class View:
    """One projection: which of the triad's directions go right and up."""

    title: str
    right: int
    up: int
    up_sign: int = 1


def three_views(point: PointEstimate, cut: Cut | None) -> Figure:
    """Tolerance, 95 % region of the measurement and of measurement and tool, to one scale, on three planes."""
    directions = triad(point)
    measured = directions.turned(point.covariance_m2)
    total = measured + (cut.tool_sigma_m**2 if cut else 0.0) * np.eye(3)
    room = max(along_room_m(cut), cut.tolerance_across_m) if cut else 0.0
    extent = 1.15 * max(room, K3 * float(np.sqrt(np.diag(total).max())), 1e-6)
    size = 134.0
    strokes: list[Stroke] = []
    for index, view in enumerate(_views(directions)):
        x = index * (WIDTH - size) / 2
        strokes += _panel(view, directions, measured, total, cut, (x, 16.0), size, extent)
    strokes += _scale_bar(extent, size, 16 + size + 14)
    strokes += _key(cut, 16 + size + 14)
    return Figure(WIDTH, size + 42, tuple(strokes), f"Uncertainty of {point.id} in three views, to scale")


def _views(directions: Triad) -> tuple[View, View, View]:
    if directions.names[0] != "along":
        return View("As the machine sees it", 0, 1, -1), View("From the side", 2, 1, -1), View("From above", 0, 2)
    if is_upright(directions.rows[0]):
        return View("As the machine sees it", 1, 0), View("From the side", 2, 0), View("Along the pipe", 1, 2)
    return View("As the machine sees it", 0, 1), View("From above", 0, 2), View("Along the pipe", 2, 1)


def _panel(
    view: View,
    directions: Triad,
    measured: Float,
    total: Float,
    cut: Cut | None,
    corner: tuple[float, float],
    size: float,
    extent: float,
) -> list[Stroke]:
    x, y = corner
    scale = size / 2 / extent
    centre = (x + size / 2, y + size / 2)
    flip = np.array([[1.0, 0.0], [0.0, -float(view.up_sign)]])
    pick = np.ix_([view.right, view.up], [view.right, view.up])
    strokes: list[Stroke] = [
        Label(x, y - 5, view.title, 8.5, bold=True),
        rectangle(x, y, size, size, pen=0.5, grey=MIDDLE),
    ]
    tolerance = [] if cut is None else _tolerance(view, directions, cut, centre, scale, (x, y, size))
    strokes += tolerance
    for covariance, style in ((total, WITH_TOOL), (measured, MEASURED)):
        curve = ellipse(centre, flip @ (covariance[pick] * scale**2) @ flip.T, K3, **style)
        kept = clipped(curve, x, y, size, size)
        strokes += [kept] if kept is not None else []
    # Again without its fill, so that a region larger than the tolerance does not hide it.
    strokes += [replace(stroke, fill=None) for stroke in tolerance]
    cx, cy = centre
    strokes += [line(cx - 4, cy, cx + 4, cy, pen=0.9), line(cx, cy - 4, cx, cy + 4, pen=0.9)]
    right, up = directions.names[view.right], directions.names[view.up]
    strokes += [Label(x + size - 16, y + size - 4, right, 7.5, "end", italic=True)]
    strokes += _arrow((x + size - 13, y + size - 6.5), (10, 0))
    strokes += [Label(x + 9, y + 10, up, 7.5, italic=True)]
    strokes += _arrow((x + 5, y + 13), (0, -10)) if view.up_sign > 0 else _arrow((x + 5, y + 3), (0, 10))
    return strokes


def _arrow(start: tuple[float, float], step: tuple[float, float]) -> list[Stroke]:
    tail, way = np.array(start), np.array(step)
    head, side = tail + way, 0.22 * np.array([-way[1], way[0]])
    barbs = np.stack([head - 0.4 * way + side, head, head - 0.4 * way - side])
    return [Path(np.stack([tail, head]), pen=0.7), Path(barbs, pen=0.7)]


def _tolerance(
    view: View,
    directions: Triad,
    cut: Cut,
    centre: tuple[float, float],
    scale: float,
    frame: tuple[float, float, float],
) -> list[Path]:
    """The tolerance region's outline: a disc along the pipe, a rectangle from the side, a ball without an axis."""
    along, across = max(along_room_m(cut), 0.0) * scale, cut.tolerance_across_m * scale
    if directions.names[0] != "along":
        radius = min(along, across)
        shape = ellipse(centre, np.eye(2) * radius**2, 1.0, **TOLERANCE)
    elif 0 in (view.right, view.up):
        wide, high = (along, across) if view.right == 0 else (across, along)
        shape = rectangle(centre[0] - wide, centre[1] - high, 2 * wide, 2 * high, **TOLERANCE)
    else:
        shape = ellipse(centre, np.eye(2) * across**2, 1.0, **TOLERANCE)
    kept = clipped(shape, frame[0], frame[1], frame[2], frame[2])
    return [] if kept is None else [kept]


def _scale_bar(extent_m: float, size: float, y: float) -> list[Stroke]:
    goal = extent_m * 1e3 * 0.6
    power = 10.0 ** np.floor(np.log10(goal))
    length = next(step for step in (5, 2, 1) if step * power <= goal) * power
    width = length * 1e-3 * size / 2 / extent_m
    ends = [line(x, y - 3, x, y + 3) for x in (0.5, width + 0.5)]
    return [line(0.5, y, width + 0.5, y), *ends, Label(width + 6, y + 3, f"{length:g} mm", 8)]


def _key(cut: Cut | None, y: float) -> list[Stroke]:
    strokes: list[Stroke] = []
    entries = [("measured point, 95 %", MEASURED)]
    if cut is not None:
        entries += [
            ("with tool, 95 %", WITH_TOOL),
            ("tolerance", TOLERANCE),
        ]
    x = WIDTH - 118.0 * len(entries)
    for text, style in entries:
        strokes += [rectangle(x, y - 5, 18, 10, **style), Label(x + 23, y + 3, text, 8)]
        x += 124.0
    return strokes


def budget_bars(shares: list[tuple[str, float]], title: str) -> Figure:
    """Horizontal bars of the share of each source in the total variance, largest first; a share may be negative."""
    row, left = 13.5, 150.0
    room = WIDTH - left - 60
    largest = max([abs(share) for _, share in shares] or [1.0]) or 1.0
    strokes: list[Stroke] = [line(left, 0, left, row * len(shares), pen=0.6)]
    for index, (name, share) in enumerate(shares):
        y = index * row
        width = max(abs(share) / largest * room, 0.4)
        fill = 0.35 if share >= 0 else 1.0
        strokes += [
            Label(left - 6, y + 9.8, shortened(name), 8.5, "end"),
            rectangle(left, y + 2.5, width, row - 5, pen=0.6, grey=0.2, fill=fill),
            Label(left + width + 5, y + 9.8, f"{significant(share * 100)} %", 8.5),
        ]
    return Figure(WIDTH, row * len(shares) + 2, tuple(strokes), title)


def acceptance_intervals(all_families: tuple[FamilyConsistency, ...]) -> Figure:
    """Chi-square per degree of freedom of each family against its limits, on a logarithmic scale about 1.

    A family without a degree of freedom of its own can neither agree nor disagree and is left out.
    """
    families = [family for family in all_families if np.isfinite(_ratio(family))]
    row, left = 16.0, 150.0
    room = WIDTH - left - 70
    values = [_ratio(family) for family in families]
    numbers = [
        v for f, r in zip(families, values, strict=True) for v in (f.lower, f.upper, r) if np.isfinite(v) and v > 0
    ]
    low, high = np.log(max(min([*numbers, 0.8]), 0.02)) - 0.1, np.log(min(max([*numbers, 1.25]), 50.0)) + 0.1

    def at(value: float) -> float:
        return left + room * float(np.clip((np.log(max(value, 1e-9)) - low) / (high - low), 0, 1))

    height = row * len(families)
    strokes: list[Stroke] = [
        line(at(1), 0, at(1), height, pen=0.6, dash=(2, 2)),
        Label(at(1), height + 9, "1", 8, "middle"),
    ]
    for index, (family, value) in enumerate(zip(families, values, strict=True)):
        y = index * row + row / 2
        word = "ABOVE" if value > family.upper else "below" if value < family.lower else "within"
        lower, upper = at(family.lower), at(family.upper)
        strokes += [
            Label(left - 6, y + 3, shortened(family.family), 8.5, "end"),
            rectangle(lower, y - 3.5, max(upper - lower, 0.6), 7, pen=0.6, grey=0.4, fill=LIGHT),
            Path(_diamond(at(value), y, 4.0), closed=True, fill=1.0 if word == "ABOVE" else 0.0, pen=1.2),
            Label(WIDTH, y + 3, word, 8.5, "end", bold=word == "ABOVE"),
        ]
    return Figure(WIDTH, height + 12, tuple(strokes), "Chi-square per degree of freedom against its limits")


def residual_tenths(families: list[FamilyConsistency]) -> Figure:
    """One small histogram for each family: how its residuals fill the tenths of their expected distribution."""
    columns, width, height, row = 4, WIDTH / 4 - 12, 44.0, 70.0
    strokes: list[Stroke] = []
    for index, family in enumerate(families):
        x, y = (index % columns) * WIDTH / columns, (index // columns) * row + 12
        total, step = max(sum(family.tenths), 1), width / len(family.tenths)
        even = height / 2.5
        strokes.append(Label(x, y - 3, shortened(family.family, 26), 8))
        for tenth, count in enumerate(family.tenths):
            high = min(count / total * len(family.tenths) * even, height)
            strokes.append(rectangle(x + tenth * step, y + height - high, step, high, pen=0.4, grey=0.2, fill=0.72))
        strokes.append(line(x, y + height - even, x + width, y + height - even, pen=0.8, dash=(3, 2)))
        strokes.append(line(x, y + height, x + width, y + height, pen=0.6))
    rows = -(-len(families) // columns)
    return Figure(WIDTH, rows * row - 10, tuple(strokes), "Residuals against their expected distribution")


def shortened(name: str, letters: int = 36) -> str:
    """A label that fits beside a bar."""
    return name if len(name) <= letters else f"{name[: letters - 1]}…"


def _ratio(family: FamilyConsistency) -> float:
    return family.chi2 / family.dof if family.dof > 1e-6 else float("nan")


def _diamond(x: float, y: float, radius: float) -> Float:
    return np.array([[x - radius, y], [x, y - radius], [x + radius, y], [x, y + radius]])


def sigma_bars(rows: list[tuple[str, float]], title: str) -> Figure:
    """Signed numbers of sigmas with the limits of 2 and 3 drawn in."""
    row, left = 15.0, 190.0
    room = WIDTH - left - 56
    reach = max([abs(value) for _, value in rows if np.isfinite(value)] + [3.5])
    signed = any(value < 0 for _, value in rows)
    zero = left + room / 2 if signed else left
    scale = (room / 2 if signed else room) / reach
    height = row * len(rows)
    strokes: list[Stroke] = [line(zero, 0, zero, height, pen=0.6)]
    for limit, dash in ((2.0, (1.5, 2.5)), (3.0, (5.0, 2.5))):
        for side in (1, -1) if signed else (1,):
            x = zero + side * limit * scale
            strokes += [
                line(x, 0, x, height, pen=0.6, dash=dash),
                Label(x, height + 9, f"{limit:g} σ", 7.5, "middle"),
            ]
    for index, (name, value) in enumerate(rows):
        y = index * row
        shown = value if np.isfinite(value) else 0.0
        start, width = (zero, shown * scale) if shown >= 0 else (zero + shown * scale, -shown * scale)
        strokes += [
            Label(left - 6, y + 9.8, shortened(name), 8.5, "end"),
            rectangle(start, y + 3, max(width, 0.5), row - 6, pen=0.6, grey=0.2, fill=0.35 if abs(shown) <= 3 else 0.0),
            Label(WIDTH, y + 9.8, f"{significant(value)} σ", 8.5, "end", bold=abs(shown) > 3),
        ]
    return Figure(WIDTH, height + 12, tuple(strokes), title)
