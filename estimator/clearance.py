"""Distance between what the blade sweeps and what it must not touch.

The blade crosses the pipe in a solid disc: the pipe's radius wide, the blade's width thick. The distance of two convex
bodies is the largest gap over all directions n, gap(n) = (least n . x of the other body) - (largest n . x of the disc);
negative where they overlap, by the depth. The largest over a finite set of directions is never more than the true
distance, so the figure errs on the safe side; the set holds every direction at which the gap can have a kink.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .region_probability import axis_frame

Float = NDArray[np.float64]

CIRCLE = 720
SPHERE = 4000


@dataclass(frozen=True, slots=True)
class SweptDisc:
    """What the blade sweeps at a cut, in {b}; without a known axis a ball."""

    centre_m: Float
    """Shape (3,)."""
    axis: Float | None
    """Shape (3,), unit."""
    radius_m: float
    half_width_m: float

    def reach(self, directions: Float) -> Float:
        """How far the disc extends from its centre along unit directions of shape (n, 3)."""
        if self.axis is None:
            return np.full(len(directions), np.hypot(self.radius_m, self.half_width_m))
        along = np.abs(directions @ self.axis)
        return self.radius_m * np.sqrt(np.maximum(1 - along**2, 0)) + self.half_width_m * along


def box_gap(disc: SweptDisc, minimum_m: Float, maximum_m: Float) -> tuple[float, Float]:
    """Signed distance [m] of the disc to an axis-parallel box, and its direction, disc to box, shape (3,)."""
    low, high = np.minimum(minimum_m, maximum_m), np.maximum(minimum_m, maximum_m)
    axes = list(np.eye(3)) if disc.axis is None else [*np.eye(3), disc.axis]
    directions = np.concatenate([*(circle_about(axis) for axis in axes), _signs(np.stack(axes)), _sphere()])
    nearest = np.minimum(directions * (low - disc.centre_m), directions * (high - disc.centre_m)).sum(1)
    return _largest(nearest - disc.reach(directions), directions)


def pipe_gap(disc: SweptDisc, point_m: Float, axis: Float, radius_m: float) -> tuple[float, Float]:
    """Signed distance [m] of the disc to an endless cylinder, and its direction, disc to cylinder, shape (3,)."""
    directions = circle_about(axis)
    return _largest(directions @ (point_m - disc.centre_m) - radius_m - disc.reach(directions), directions)


def circle_about(axis: Float) -> Float:
    """Unit vectors across an axis, shape (CIRCLE, 3)."""
    _, side, other = axis_frame(axis)
    turn = np.arange(CIRCLE) * 2 * np.pi / CIRCLE
    return np.outer(np.cos(turn), side) + np.outer(np.sin(turn), other)


def _signs(axes: Float) -> Float:
    return np.concatenate([axes, -axes])


def _sphere() -> Float:
    """Even directions on a golden spiral (Fibonacci lattice)."""
    index = np.arange(SPHERE) + 0.5
    height = 1 - 2 * index / SPHERE
    turn = np.pi * (1 + np.sqrt(5)) * index
    flat = np.sqrt(1 - height**2)
    return np.stack([flat * np.cos(turn), flat * np.sin(turn), height], axis=1)


def _largest(gaps: Float, directions: Float) -> tuple[float, Float]:
    best = int(np.argmax(gaps))
    return float(gaps[best]), directions[best]
