"""The directions in which a cutter thinks: along the pipe, across it, and in depth away from the machine."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi

from ..region_probability import ball_probability
from ..result import PointEstimate

Float = NDArray[np.float64]

COVERAGE = 0.95
K3 = float(chi.ppf(COVERAGE, 3))
"""Coverage factor of a 3-D region, 2.80: what 1.96 is for a single number."""


@dataclass(frozen=True, slots=True)
class Triad:
    """Three unit vectors in {b}, and what they are called."""

    names: tuple[str, str, str]
    rows: Float
    """Shape (3, 3), one direction per row."""

    def turned(self, covariance_m2: Float) -> Float:
        """The covariance along these directions, shape (3, 3)."""
        return self.rows @ covariance_m2 @ self.rows.T


@dataclass(frozen=True, slots=True)
class HalfAxis:
    """One half axis of the 95 % ellipsoid."""

    length_m: float
    angles_deg: tuple[float, float, float]
    """Angles to the triad's directions, 0 to 90."""


def triad(point: PointEstimate) -> Triad:
    """Along the pipe's axis, across it, and the part of the line of sight from {b} that is perpendicular to it.

    Without a pipe: right, down and forward of the machine's camera.
    """
    if point.axis is None or not np.isfinite(point.axis).all() or np.linalg.norm(point.axis) < 1e-9:
        return Triad(("right", "down", "forward"), np.eye(3))
    along = point.axis / np.linalg.norm(point.axis)
    sight = point.position_m if np.linalg.norm(np.cross(point.position_m, along)) > 1e-6 else np.eye(3)[2]
    depth = sight - (sight @ along) * along
    if np.linalg.norm(depth) < 1e-6:
        depth = np.eye(3)[0] - along[0] * along
    depth /= np.linalg.norm(depth)
    return Triad(("along", "across", "depth"), np.stack([along, np.cross(along, depth), depth]))


def half_axes(point: PointEstimate, directions: Triad) -> tuple[HalfAxis, ...]:
    """The 95 % ellipsoid's half axes, longest first."""
    values, vectors = np.linalg.eigh(point.covariance_m2)
    order = np.argsort(values)[::-1]
    cosines = np.clip(np.abs(directions.rows @ vectors), 0, 1)
    return tuple(
        HalfAxis(
            K3 * float(np.sqrt(max(values[i], 0.0))),
            (
                float(np.degrees(np.arccos(cosines[0, i]))),
                float(np.degrees(np.arccos(cosines[1, i]))),
                float(np.degrees(np.arccos(cosines[2, i]))),
            ),
        )
        for i in order
    )


def radius95(covariance_m2: Float) -> float:
    """Radius [m] of the sphere that holds the truth with 95 %, by bisection."""
    largest = float(np.sqrt(np.linalg.eigvalsh(covariance_m2)[-1]))
    low, high = 1.9 * largest, 2.9 * largest
    while high - low > 1e-6 * high:
        middle = (low + high) / 2
        low, high = (low, middle) if ball_probability(covariance_m2, middle) >= COVERAGE else (middle, high)
    return high
