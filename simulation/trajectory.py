"""How the mobile camera moves: from the board round the panel, to three places that see the pipe, and back or not."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline, PchipInterpolator
from scipy.ndimage import gaussian_filter1d

from .cell import Cell
from .rigid import looking, transform, view_angles
from .scenario import Scenario

Float = NDArray[np.float64]
_GRID_HZ = 200
_AWAY_RAD = 2.0
_AWAY_S = 0.25
"""How long it takes to look away: 8 rad/s, half an image from one frame to the next."""
# Amplitude and frequency of a hand's tremor: metres, radians, hertz.
_TREMOR = ((0.0015, 0.003, 0.7), (0.0006, 0.0016, 2.3), (0.00025, 0.0009, 6.1))


@dataclass(frozen=True, slots=True)
class Trajectory:
    """`w_T_m` at any time, and when the camera dwells at the places where the operator clicks."""

    path: CubicSpline
    """x, y, z, yaw, pitch, roll by time."""
    dwells_s: tuple[tuple[float, float], ...]

    def pose(self, time_s: float) -> Float:
        """`w_T_m`, shape (4, 4), of the left optical frame."""
        x, y, z, yaw, pitch, roll = self.path(time_s)
        return looking((x, y, z), yaw, pitch, roll)

    def length_m(self, duration_s: float) -> float:
        """Length of the path."""
        places = self.path(np.arange(0, duration_s, 0.05))[:, :3]
        return float(np.linalg.norm(np.diff(places, axis=0), axis=1).sum())


@dataclass(frozen=True, slots=True)
class _Stop:
    """A point of the plan: share of the duration, place, what is looked at."""

    share: float
    place: Float
    target: Float


def plan(scenario: Scenario, cell: Cell, w_T_c: Float, rng: np.random.Generator) -> Trajectory:
    """Draw a trajectory in the cell, the machine standing at `w_T_c`."""
    stops, dwells = _stops(scenario, cell, w_T_c, rng)
    if scenario.motion == "sharp":
        stops = _sharpened(stops, dwells, rng)
    duration = scenario.duration_s
    times = np.array([stop.share for stop in stops]) * duration
    angles = np.unwrap([view_angles(stop.target - stop.place) for stop in stops], axis=0)
    knots = np.concatenate([np.array([stop.place for stop in stops]), angles], axis=1)
    grid = np.arange(-0.5, duration + 0.5, 1 / _GRID_HZ)
    softness = 0.22 if scenario.motion == "smooth" else 0.08
    warped = _warped(grid, scenario.timeline.still, duration, 4.5 * softness)
    values = PchipInterpolator(times, knots, axis=0)(np.clip(warped[0], times[0], times[-1]))
    values = np.concatenate([values, 0.03 * np.sin(warped[0][:, None] * 0.6 + rng.uniform(0, 6))], axis=1)
    values = gaussian_filter1d(values, softness * _GRID_HZ, axis=0, mode="nearest")
    calm = gaussian_filter1d(warped[1], 0.1 * _GRID_HZ)[:, None]
    values += calm * _tremor(grid, 1.0 if scenario.motion == "smooth" else 1.8, rng)
    values[:, 3] += _looking_away(grid, scenario.timeline.turned)
    moved = [tuple(np.interp([a * duration, b * duration], warped[0], grid)) for a, b in dwells]
    return Trajectory(CubicSpline(grid, values), tuple((float(a), float(b)) for a, b in moved))


def _stops(
    scenario: Scenario, cell: Cell, w_T_c: Float, rng: np.random.Generator
) -> tuple[list[_Stop], list[tuple[float, float]]]:
    """Board, way round the panel, three dwells at the pipe, way back."""
    w_T_f = w_T_c @ cell.c_T_f
    starts = ((1.25, 0.0, 0.05), (1.05, 0.25, 0.12), (1.4, -0.2, -0.03))
    away, across, up = starts[scenario.initialisation % 3] + rng.normal(0, [0.04, 0.04, 0.03])
    board = w_T_f[:3, 3]
    start = transform(w_T_f, (across, up, away))
    start[2] = np.clip(start[2], 0.9, 1.7)
    pipe = cell.pipe.at_height(1.1)
    forward = start + np.array([cell.side * 0.12, 0.5, 0.05])
    ahead = np.array([cell.side * 0.2, 3.2, 1.2])
    shares = (0.36, 0.53, 0.70) if scenario.return_to_board else (0.40, 0.63, 0.88)
    stops = [
        _Stop(0.0, start, board),
        _Stop(0.05, start + rng.normal(0, 0.03, 3), board),
        _Stop(0.13, start + np.array([cell.side * 0.05, 0.04, 0.05]), board + np.array([0, 0.05, -0.03])),
        _Stop(0.24, forward, 0.35 * board + 0.65 * ahead),
    ]
    dwells = []
    for share, bearing in zip(shares, np.deg2rad([-28, 14, 52]), strict=True):
        angle = bearing + rng.normal(0, 0.06)
        reach = rng.uniform(0.95, 1.2)
        offset = reach * np.array([cell.side * np.cos(angle), np.sin(angle)])
        place = np.array([*(pipe[:2] + offset), 1.25 + rng.normal(0, 0.1)])
        place = np.clip(place, [cell.room_m[0] + 0.75, 0.9, 0.9], [cell.room_m[1] - 0.75, cell.room_m[3] - 0.65, 1.6])
        target = pipe + rng.normal(0, 0.06, 3)
        stops += [_Stop(share - 0.03, place, target), _Stop(share + 0.03, place + rng.normal(0, 0.02, 3), target)]
        dwells.append((share - 0.03, share + 0.03))
    if scenario.return_to_board:
        stops += [
            _Stop(0.83, forward + rng.normal(0, 0.05, 3), 0.5 * board + 0.5 * ahead),
            _Stop(0.93, start + rng.normal(0, 0.08, 3), board),
            _Stop(1.0, start + rng.normal(0, 0.08, 3), board + rng.normal(0, 0.04, 3)),
        ]
    else:
        stops.append(_Stop(1.0, stops[-1].place + rng.normal(0, 0.04, 3), pipe))
    return stops, dwells


def _sharpened(stops: list[_Stop], dwells: list[tuple[float, float]], rng: np.random.Generator) -> list[_Stop]:
    """Between the stops: darts to the side and glances away, there and back within about a second."""
    sharp = [stops[0]]
    for last, stop in pairwise(stops):
        gap = stop.share - last.share
        if gap > 0.065:
            middle = 0.5 * (last.place + stop.place)
            dart = rng.normal(0, 1, 3) * [0.22, 0.22, 0.15]
            glance = rng.uniform(0.5, 0.95) * rng.choice([-1, 1])
            view = 0.5 * (last.target - last.place) / np.linalg.norm(last.target - last.place)
            view = view + 0.5 * (stop.target - stop.place) / np.linalg.norm(stop.target - stop.place)
            c, s = np.cos(glance), np.sin(glance)
            turned = np.array([c * view[0] - s * view[1], s * view[0] + c * view[1], view[2]])
            sharp.append(_Stop(last.share + 0.40 * gap, middle + dart, middle + dart + turned))
            sharp.append(_Stop(last.share + 0.62 * gap, middle - 0.6 * dart, middle - 0.6 * dart + view))
        sharp.append(stop)
    return sharp


def _warped(
    grid: Float, still: tuple[tuple[float, float], ...], duration: float, margin_s: float
) -> tuple[Float, Float]:
    """Time along the plan for each time of the grid, and 1 where the hand holds the camera, 0 where it is put down.

    The plan pauses `margin_s` longer on both sides, so that smoothing leaves the interval itself at rest.
    """
    pace = np.ones_like(grid)
    for start, end in still:
        pace[(grid >= start - margin_s) & (grid <= end + margin_s)] = 0
    free = np.maximum(pace * (grid >= 0) * (grid <= duration), 0)
    progress = np.cumsum(free)
    return progress / max(progress[-1], 1) * duration, pace


def _looking_away(grid: Float, turned: tuple[tuple[float, float], ...]) -> Float:
    """Yaw (n,) on top of the plan's, with a smooth start and end of each turn."""
    total = np.zeros_like(grid)
    for start, end in turned:
        there, back = (np.clip((grid - at) / _AWAY_S, 0.0, 1.0) for at in (start, end))
        total += _AWAY_RAD * sum(sign * share**2 * (3.0 - 2.0 * share) for sign, share in ((1, there), (-1, back)))
    return total


def _tremor(grid: Float, strength: float, rng: np.random.Generator) -> Float:
    """Shake of the hand, shape (n, 6): x, y, z, yaw, pitch, roll."""
    total = np.zeros((len(grid), 6))
    for shift, turn, hertz in _TREMOR:
        for column in range(6):
            rate, phase = hertz * rng.uniform(0.7, 1.3), rng.uniform(0, 2 * np.pi)
            total[:, column] += (shift if column < 3 else turn) * np.sin(2 * np.pi * rate * grid + phase)
    return strength * total
