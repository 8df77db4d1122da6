"""The cell as geometry: rectangles, a pipe, landmarks on them, and the mobile camera's way. World: x ahead, z up.

The machine stands at the origin and looks along x. The mobile camera starts between machine and panel, looks back at
the board, and goes round the panel on one side until it sees the pipe.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from .measurement_level_scenario import Motion, Scenario
from .measurement_level_truth import Float, matrix

Bool = NDArray[np.bool_]

FRAME_RATE_HZ = 15.0
"""Keyframes are chosen among this many."""


@dataclass(frozen=True, slots=True)
class Rectangles:
    """Flat surfaces: corner + s * edge_u + t * edge_v, s and t in 0..1; seen from the side of the normal."""

    corner: Float
    """Shape (n, 3)."""
    edge_u: Float
    edge_v: Float
    normal: Float
    """Shape (n, 3), unit."""


@dataclass(frozen=True, slots=True)
class Cylinder:
    """The pipe."""

    base: Float
    axis: Float
    """Unit, shape (3,)."""
    length_m: float
    radius_m: float


@dataclass(frozen=True, slots=True)
class Scene:
    """Everything that stands in the cell, in world coordinates."""

    surfaces: Rectangles
    pipe: Cylinder
    landmarks: Float
    """Shape (n, 3)."""
    landmark_normals: Float
    """Shape (n, 3)."""
    w_T_b: Float
    side: float
    """+1 or -1: the side on which the mobile camera goes round."""


def build_scene(scenario: Scenario, radius_m: float, rng: np.random.Generator) -> Scene:
    """A room with machine front, panel, crates and the pipe at a random place."""
    side = float(rng.choice([-1.0, 1.0]))
    pipe_xy = np.array([rng.uniform(*scenario.pipe.distance_m), rng.uniform(*scenario.pipe.offset_m)])
    tilt = rng.normal(0.0, 0.03, 2)
    axis = np.array([tilt[0], tilt[1], 1.0])
    pipe = Cylinder(np.array([*pipe_xy, 0.2]), axis / np.linalg.norm(axis), 2.2, radius_m)
    rectangles = [*_room(), *_box([-0.6, -0.6, 0.1], [-0.03, 0.6, 1.7])]
    if scenario.panel:
        rectangles += _box([1.45, pipe_xy[1] - 0.45, 0.0], [1.48, pipe_xy[1] + 0.45, 1.9])
    for _ in range(4):
        corner = np.array([rng.uniform(2.4, 3.8), rng.uniform(-1.9, 1.5), 0.0])
        rectangles += _box(corner, corner + rng.uniform(0.3, 0.7, 3))
    surfaces = _stack(rectangles)
    landmarks, normals = _landmarks(surfaces, pipe, rng)
    pitch = rng.uniform(0.1, 0.2)
    w_R_b = np.array([[0.0, -np.sin(pitch), np.cos(pitch)], [-1.0, 0.0, 0.0], [0.0, -np.cos(pitch), -np.sin(pitch)]])
    w_T_b = np.eye(4)
    w_T_b[:3, :3] = w_R_b
    w_T_b[:3, 3] = [0.0, 0.0, 1.35]
    return Scene(surfaces, pipe, landmarks, normals, w_T_b, side)


def mobile_path(scene: Scene, board: Float, motion: Motion, rng: np.random.Generator) -> tuple[Float, Float, Float]:
    """The way of the mobile camera.

    Args:
        scene: the cell.
        board: the board's centre, shape (3,).
        motion: duration, keyframes, style.
        rng: the run's generator.

    Returns:
        Keyframes: times in s, shape (n,); `w_T_m`, shape (n, 4, 4); times of the three places, shape (3,).
    """
    share, end = motion.board_share, motion.duration_s
    pipe = scene.pipe.base + 1.0 * scene.pipe.axis
    turn = rng.uniform(-0.1, 0.1, (8, 3))
    near, far = motion.board_distance_m
    start = board + rng.uniform([near, -0.25, -0.1], [far, 0.25, 0.15])
    places = [pipe + _around(angle, scene.side, rng.uniform(0.9, 1.3)) for angle in (-0.7, 0.0, 0.7)]
    way = np.array(
        [
            start,
            start + rng.uniform([-0.15, -0.3, -0.15], [0.0, 0.3, 0.15]),
            start + np.array([0.05, 0.35 * scene.side, rng.uniform(-0.1, 0.1)]),
            np.array([1.25, 1.15 * scene.side + pipe[1] * 0.5, 1.35]) + turn[3],
            *places,
        ]
    )
    between = np.array([1.0, 2.0 * scene.side, 1.2])
    looks = np.array([board, board, board, 0.5 * (between + pipe), pipe, pipe, pipe]) + 0.5 * turn[:7]
    times = end * np.array([0.0, 0.5 * share, share, share + 0.3 * (1 - share), 0.0, 0.0, 0.0])
    stops = end * (share + (1 - share) * np.array([0.5, 0.72, 0.9]))
    times[4:] = stops
    if motion.returns:
        way, looks = np.vstack([way, way[3], start]), np.vstack([looks, looks[3], board])
        times = np.r_[0.7 * times, 0.85 * end, end]
        stops = 0.7 * stops
    else:
        way, looks, times = np.vstack([way, way[-1]]), np.vstack([looks, looks[-1]]), np.r_[times, end]
    stamps_s = np.arange(0.0, end, 1.0 / FRAME_RATE_HZ)
    positions, targets = CubicSpline(times, way)(stamps_s), CubicSpline(times, looks)(stamps_s)
    roll = 0.05 * np.sin(2 * np.pi * (stamps_s / 3.0 + rng.uniform()))
    if motion.style == "sharp":
        targets = targets + _jerks(stamps_s, rng)
        roll = roll + 0.2 * np.sin(2 * np.pi * stamps_s / 1.3)
    w_T_m = _look_at(positions, targets, roll)
    chosen = _keyframes(stamps_s, w_T_m, stops, motion)
    return stamps_s[chosen], w_T_m[chosen], stops


def _keyframes(stamps_s: Float, w_T_m: Float, stops: Float, motion: Motion) -> list[int]:
    """Frames at which a front end would make keyframes; the places are among them."""
    places = {int(np.abs(stamps_s - stop).argmin()) for stop in stops}
    chosen = [0]
    for i in range(1, len(stamps_s)):
        last = chosen[-1]
        cosine = 0.5 * (np.trace(w_T_m[last, :3, :3].T @ w_T_m[i, :3, :3]) - 1.0)
        turned = np.arccos(np.clip(cosine, -1.0, 1.0)) >= motion.keyframe_turn_rad
        moved = np.linalg.norm(w_T_m[i, :3, 3] - w_T_m[last, :3, 3]) >= motion.keyframe_way_m
        if turned or moved or stamps_s[i] - stamps_s[last] >= motion.keyframe_time_s or i in places:
            chosen.append(i)
    return chosen


def occluded(eyes: Float, points: Float, surfaces: Rectangles, pipe: Cylinder | None = None) -> Bool:
    """Whether something stands between eyes and points. Both shape (n, 3); answer shape (n,)."""
    rays = points - eyes
    distances = _rectangle_hits(eyes, rays, surfaces)
    if pipe is not None:
        distances = np.c_[distances, _cylinder_hit(eyes, rays, pipe)]
    return np.asarray(((distances > 1e-6) & (distances < 1.0 - 1e-3)).any(axis=1))


def cast(eye: Float, rays: Float, scene: Scene) -> tuple[Float, Float, Bool]:
    """First surface along rays: distance in ray lengths (inf: none), normals (n, 3), and whether it is the pipe."""
    eyes = np.broadcast_to(eye, rays.shape)
    hits = _rectangle_hits(eyes, rays, scene.surfaces)
    hits = np.where(hits > 1e-6, hits, np.inf)
    first = hits.argmin(axis=1)
    distance = hits.min(axis=1)
    normals = scene.surfaces.normal[first]
    pipe_distance = _cylinder_hit(eyes, rays, scene.pipe)
    on_pipe = (pipe_distance > 1e-6) & (pipe_distance < distance)
    distance = np.where(on_pipe, pipe_distance, distance)
    finite = np.where(np.isfinite(distance), distance, 0.0)
    radial = eyes + finite[:, None] * rays - scene.pipe.base
    radial = radial - (radial @ scene.pipe.axis)[:, None] * scene.pipe.axis
    normals = np.where(on_pipe[:, None], radial / scene.pipe.radius_m, normals)
    return distance, normals, on_pipe


def _rectangle_hits(eyes: Float, rays: Float, surfaces: Rectangles) -> Float:
    """Ray parameters of the hits with m rectangles, inf where missed; shape (n, m). Both sides stop a ray."""
    towards = (surfaces.corner * surfaces.normal).sum(1) - eyes @ surfaces.normal.T
    with np.errstate(divide="ignore", invalid="ignore"):
        t = towards / (rays @ surfaces.normal.T)
        inside = np.isfinite(t)
        for edge in (surfaces.edge_u, surfaces.edge_v):
            square = (edge**2).sum(1)
            start = (eyes @ edge.T - (surfaces.corner * edge).sum(1)) / square
            s = start + t * (rays @ edge.T / square)
            inside &= (s >= 0.0) & (s <= 1.0)
    return np.where(inside, t, np.inf)


def _cylinder_hit(eyes: Float, rays: Float, pipe: Cylinder) -> Float:
    """Ray parameter of the first hit with the pipe's mantle, inf where it is missed."""
    across = rays - (rays @ pipe.axis)[:, None] * pipe.axis
    offset = eyes - pipe.base
    offset = offset - (offset @ pipe.axis)[:, None] * pipe.axis
    a, b = (across**2).sum(1), (across * offset).sum(1)
    c = (offset**2).sum(1) - pipe.radius_m**2
    root = b**2 - a * c
    with np.errstate(divide="ignore", invalid="ignore"):
        t = (-b - np.sqrt(np.maximum(root, 0.0))) / a
        height = (eyes + t[:, None] * rays - pipe.base) @ pipe.axis
    return np.where((root > 0) & (height >= 0) & (height <= pipe.length_m), t, np.inf)


def _landmarks(surfaces: Rectangles, pipe: Cylinder, rng: np.random.Generator) -> tuple[Float, Float]:
    """Random points on all surfaces, by area, and some on the pipe."""
    areas = np.linalg.norm(np.cross(surfaces.edge_u, surfaces.edge_v), axis=1)
    choice = rng.choice(len(areas), size=3000, p=areas / areas.sum())
    s, t = rng.uniform(0.0, 1.0, (2, len(choice), 1))
    points = surfaces.corner[choice] + s * surfaces.edge_u[choice] + t * surfaces.edge_v[choice]
    heights, angles = rng.uniform(0.0, pipe.length_m, (60, 1)), rng.uniform(0.0, 2 * np.pi, (60, 1))
    first = np.cross(pipe.axis, [1.0, 0.0, 0.0])
    first = first / np.linalg.norm(first)
    radial = np.cos(angles) * first + np.sin(angles) * np.cross(pipe.axis, first)
    on_pipe = pipe.base + heights * pipe.axis + pipe.radius_m * radial
    return np.vstack([points, on_pipe]), np.vstack([surfaces.normal[choice], radial])


def _room() -> list[Float]:
    low, high = np.array([-1.2, -2.6, 0.0]), np.array([4.5, 2.6, 2.8])
    return [_inward(face) for face in _box(low, high)]


def _inward(face: Float) -> Float:
    return face[[0, 2, 1]]


def _box(low: Float | list[float], high: Float | list[float]) -> list[Float]:
    """Six faces as (corner, edge_u, edge_v), normals outwards."""
    low, high = np.asarray(low, dtype=float), np.asarray(high, dtype=float)
    edges = np.diag(high - low)
    faces = []
    for k in range(3):
        u, v = edges[(k + 1) % 3], edges[(k + 2) % 3]
        faces.append(np.array([low, v, u]))
        faces.append(np.array([low + edges[k], u, v]))
    return faces


def _stack(faces: list[Float]) -> Rectangles:
    data = np.array(faces)
    normals = np.cross(data[:, 1], data[:, 2])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return Rectangles(data[:, 0], data[:, 1], data[:, 2], normals)


def _around(angle: float, side: float, distance_m: float) -> Float:
    return distance_m * np.array([np.sin(angle), side * np.cos(angle), 0.0]) + [0.0, 0.0, 0.15]


def _jerks(stamps_s: Float, rng: np.random.Generator) -> Float:
    """Sudden turns of the view by some tenths of a metre at the target, three to five of them."""
    targets = np.zeros((len(stamps_s), 3))
    for moment in rng.uniform(0.1, 0.9, rng.integers(3, 6)) * stamps_s[-1]:
        targets += np.exp(-(((stamps_s - moment) / 0.4) ** 2))[:, None] * rng.normal(0.0, 0.35, 3)
    return targets


def _look_at(positions: Float, targets: Float, roll_rad: Float) -> Float:
    """Camera poses (x right, y down, z towards the target), shape (n, 4, 4)."""
    z = targets - positions
    z /= np.linalg.norm(z, axis=1, keepdims=True)
    x = np.cross(z, [0.0, 0.0, 1.0])
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    poses = np.tile(np.eye(4), (len(z), 1, 1))
    poses[:, :3, :3] = np.stack([x, np.cross(z, x), z], axis=2)
    poses[:, :3, 3] = positions
    return poses @ np.array([matrix(np.array([0.0, 0.0, angle]), np.zeros(3)) for angle in roll_rad])
