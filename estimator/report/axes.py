"""The directions in which a cutter thinks: along the pipe, across it, and in depth away from the machine."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import chdtri

from ..result import PointEstimate

Float = NDArray[np.float64]

K3 = float(np.sqrt(chdtri(3, 0.05)))
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

    Signs are such that in the machine's image an upright pipe points up and across points right; for a pipe that lies
    it is the other way round. Without a pipe: right, down and forward of the machine's camera.
    """
    if point.axis is None or not np.isfinite(point.axis).all() or np.linalg.norm(point.axis) < 1e-9:
        return Triad(("right", "down", "forward"), np.eye(3))
    along = point.axis / np.linalg.norm(point.axis)
    sight = point.position_m if np.linalg.norm(np.cross(point.position_m, along)) > 1e-6 else np.eye(3)[2]
    depth = sight - (sight @ along) * along
    if np.linalg.norm(depth) < 1e-6:
        depth = np.eye(3)[0] - along[0] * along
    depth /= np.linalg.norm(depth)
    across = np.cross(depth, along)
    first, second = (along, across) if is_upright(along) else (across, along)
    up = first if first[1] < 0 else -first
    right = second if second[0] > 0 else -second
    rows = (up, right, depth) if is_upright(along) else (right, up, depth)
    return Triad(("along", "across", "depth"), np.array(rows, dtype=np.float64))


def is_upright(axis: Float) -> bool:
    """Whether a direction is nearer to the vertical than to the horizontal of the machine's image."""
    return bool(abs(axis[1]) >= abs(axis[0]))


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
