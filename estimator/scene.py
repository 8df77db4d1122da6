"""A result as coloured points in {b}: surroundings, pipe, points with their 95 % ellipsoids, the camera's way."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..factors.chance import chi2_ppf
from .region_probability import axis_frame
from .result import PipeEstimate, PointEstimate, Result
from .surroundings import map_rows

Float = NDArray[np.float64]

K3 = float(np.sqrt(chi2_ppf(0.95, 3)))
LANDMARK, KINECT, PIPE, WAY = (90, 140, 220), (150, 150, 150), (240, 150, 30), (60, 190, 190)
ROLES = {"cut": (220, 30, 30), "grasp": (30, 160, 60)}
OTHER = (150, 60, 200)
PIPE_REACH_M = 0.4
"""The pipe is drawn so far to both sides of its points."""
RING_M = 0.01
ROUND = 90
BALL = 600
CROSS_M = 0.01


@dataclass(frozen=True, slots=True)
class Scene:
    """Points of {b}."""

    points_m: NDArray[np.float32]
    """Shape (n, 3)."""
    colours: NDArray[np.uint8]
    """Shape (n, 3)."""
    sigma_m: NDArray[np.float32]
    """Shape (n,), of mapped points; 0 for what is drawn."""


def build_scene(result: Result) -> Scene:
    """All that the result knows of the place."""
    parts: list[tuple[Float, tuple[int, int, int], Float]] = []
    if result.surroundings is not None:
        rows = map_rows(result.surroundings).astype(float)
        count = result.surroundings.landmarks
        parts += [(rows[:count, :3], LANDMARK, rows[:count, 3]), (rows[count:, :3], KINECT, rows[count:, 3])]
    for pipe in result.pipes:
        parts.append(_drawn(_mantle(pipe, [p for p in result.points if p.pipe_id == pipe.id]), PIPE))
    for point in result.points:
        parts.append(_drawn(_ellipsoid(point), ROLES.get(point.role, OTHER)))
    parts.append(_drawn(_way(result), WAY))
    return Scene(
        np.concatenate([p for p, _, _ in parts]).astype(np.float32),
        np.concatenate([np.tile(np.array(c, np.uint8), (len(p), 1)) for p, c, _ in parts]),
        np.concatenate([s for _, _, s in parts]).astype(np.float32),
    )


def _drawn(points: Float, colour: tuple[int, int, int]) -> tuple[Float, tuple[int, int, int], Float]:
    return points, colour, np.zeros(len(points))


def _mantle(pipe: PipeEstimate, points: list[PointEstimate]) -> Float:
    """Rings of the pipe's mantle about its points."""
    along = [float((p.position_m - pipe.point_m) @ pipe.axis) for p in points] or [0.0]
    places = np.arange(min(along) - PIPE_REACH_M, max(along) + PIPE_REACH_M, RING_M)
    axis, side, other = axis_frame(pipe.axis)
    turn = np.arange(ROUND) * 2 * np.pi / ROUND
    ring = pipe.radius_m * (np.outer(np.cos(turn), side) + np.outer(np.sin(turn), other))
    return (pipe.point_m + places[:, None, None] * axis + ring[None]).reshape(-1, 3)


def _ellipsoid(point: PointEstimate) -> Float:
    """The 95 % ellipsoid on a golden spiral, and a cross at the estimate."""
    index = np.arange(BALL) + 0.5
    height, turn = 1 - 2 * index / BALL, np.pi * (1 + np.sqrt(5)) * index
    flat = np.sqrt(1 - height**2)
    ball = np.column_stack([flat * np.cos(turn), flat * np.sin(turn), height])
    values, vectors = np.linalg.eigh(point.covariance_m2)
    surface = point.position_m + K3 * (ball * np.sqrt(np.clip(values, 0, None))) @ vectors.T
    arms = np.linspace(-CROSS_M, CROSS_M, 21)
    cross = point.position_m + np.concatenate([np.outer(arms, row) for row in np.eye(3)])
    return np.concatenate([surface, cross])


def _way(result: Result) -> Float:
    """Where the mobile camera was."""
    base = next((pose.matrix for pose in result.poses if pose.name == "b"), None)
    if base is None or not result.trajectory:
        return np.zeros((0, 3))
    o_p = np.array([pose.matrix[:3, 3] for pose in result.trajectory])
    return (o_p - base[:3, 3]) @ base[:3, :3]
