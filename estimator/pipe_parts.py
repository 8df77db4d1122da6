"""What is known of single points and pipes while a run goes on, and the place where rays meet."""

from dataclasses import dataclass, field

import gtsam
import numpy as np
from numpy.typing import NDArray

from ..factors.measurements import OutlineSighting, Pick
from ..factors.rig import Pipe

Float = NDArray[np.float64]

MINIMUM_PARALLAX_RAD = 0.03
"""Below it two rays do not place a point well enough to start from."""


@dataclass(frozen=True, slots=True)
class SeenFrom:
    """A pose that a camera hangs on: the key in the graph, and where the camera is believed to be."""

    key: int
    o_T_c: gtsam.Pose3


@dataclass(slots=True)
class PipePoint:
    index: int
    id: str
    role: str
    pipe: str | None
    held: list[tuple[SeenFrom, Pick]] = field(default_factory=list)
    known: bool = False
    on_axis: bool = False
    picks: int = 0
    stamp_ns: int = 0


@dataclass(slots=True)
class PipeCylinder:
    index: int
    pipe: Pipe
    known: bool = False
    held: list[tuple[SeenFrom, OutlineSighting]] = field(default_factory=list)
    outlines: int = 0


def known_point(
    index: int,
    name: str,
    role: str,
    pipe: str | None,
    on_axis: bool,
    picks: int,
    stamp_ns: int,
) -> PipePoint:
    """A point that an earlier run knew."""
    return PipePoint(index, name, role, pipe, known=True, on_axis=on_axis, picks=picks, stamp_ns=stamp_ns)


def known_cylinder(index: int, pipe: Pipe, outlines: int) -> PipeCylinder:
    """A pipe that an earlier run knew."""
    return PipeCylinder(index, pipe, known=True, outlines=outlines)


def intersection(rays: list[tuple[Float, Float]]) -> Float | None:
    """The point nearest to all rays, None without parallax."""
    if len(rays) < 2:
        return None
    cosines = [abs(float(a[1] @ b[1])) for a in rays for b in rays]
    if np.arccos(np.clip(min(cosines), -1, 1)) < MINIMUM_PARALLAX_RAD:
        return None
    projectors = [np.eye(3) - np.outer(d, d) for _, d in rays]
    place = np.linalg.solve(
        np.sum(projectors, axis=0), np.sum([P @ o for P, (o, _) in zip(projectors, rays, strict=True)], axis=0)
    )
    ahead = all(float((place - o) @ d) > 0.05 for o, d in rays)
    return place if ahead else None
