"""The mapped surroundings in {b}: a compact map for the result, and what is next to a point that is not its pipe."""

from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from ..factors import keys
from ..factors.cloud import corrected, depth_moves, depth_states
from .engine import Engine
from .linear import LinearSystem
from .points_in_base import point_blocks, present_base
from .result import NearestSurface, PipeEstimate, PointEstimate, SurfaceMap

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]

WELL_SEEN = 3
"""Keyframes from which on a landmark counts as a place where something is."""
VOXEL_M = 0.02
MOST_POINTS = 20_000
"""320 kB; larger maps get larger voxels."""
OWN_SIGMA = 3.0
"""Nearer to the pipe's mantle than this many sigmas a mapped point may be the pipe itself."""
NEIGHBOUR_M = 0.05
"""A mapped point with no other so near is no surface."""
ONE_SIDED95 = 1.645
CANDIDATES = 12


@dataclass(frozen=True, slots=True)
class Surroundings:
    """Mapped points in {b}: landmarks first, then the Kinect's surface."""

    points_m: Float
    """Shape (n, 3)."""
    sigma_m: Float
    """Shape (n,), each point's own, as if all poses were known."""
    landmarks: tuple[int, ...]
    """Keys of the first points."""
    measured_m: Float
    """Shape (m, 3): the Kinect's points before the depth states act on them."""


def surroundings(engine: Engine, values: gtsam.Values, system: LinearSystem) -> Surroundings | None:
    """The map of a solved run; None where {b} is not known."""
    base = engine.base
    if not values.exists(base):
        return None
    o_T_b = values.atPose3(base)
    counts = engine.odometry.observations
    names = [keys.landmark(t) for t, count in sorted(counts.items()) if count >= WELL_SEEN]
    names = [key for key in names if key in system.columns]
    o_p = np.array([values.atPoint3(key) for key in names]).reshape(-1, 3)
    b_p = (o_p - o_T_b.translation()) @ o_T_b.rotation().matrix()
    sigma = _own_sigmas(system, names)
    measured, cloud = np.zeros((0, 3)), engine.surfaces.cloud
    if cloud is not None and values.exists(keys.DEPTH):
        measured = cloud.points_m
        b_p = np.vstack([b_p, corrected(measured, *depth_states(values))])
        sigma = np.concatenate([sigma, cloud.sigma_m])
    return Surroundings(b_p, sigma, tuple(names), measured)


def _own_sigmas(system: LinearSystem, names: list[int]) -> Float:
    """Largest sigma of each landmark with everything else held, from its block of the information matrix."""
    if not names:
        return np.zeros(0)
    diagonals = [system.information.diagonal(k) for k in range(3)]
    first = np.array([system.columns[key].start for key in names])
    blocks = np.zeros((len(names), 3, 3))
    for k in range(3):
        for i in range(3 - k):
            blocks[:, i, i + k] = blocks[:, i + k, i] = diagonals[k][first + i]
    return 1.0 / np.sqrt(np.clip(np.linalg.eigvalsh(blocks)[:, 0], 1e-12, None))


def compact_map(found: Surroundings | None) -> SurfaceMap | None:
    """One point per voxel and source: the surest."""
    if found is None or len(found.points_m) == 0:
        return None
    is_landmark = np.arange(len(found.points_m)) < len(found.landmarks)
    good = np.isfinite(found.points_m).all(1) & np.isfinite(found.sigma_m)
    voxel, kept = VOXEL_M, np.zeros(0, int)
    while True:
        cells = np.column_stack([~is_landmark, np.floor(found.points_m / voxel)])
        order = np.lexsort((np.arange(len(cells)), found.sigma_m))
        order = order[good[order]]
        _, first = np.unique(cells[order], axis=0, return_index=True)
        kept = np.sort(order[first])
        if len(kept) <= MOST_POINTS:
            break
        voxel *= 1.5
    rows = np.column_stack([found.points_m[kept], found.sigma_m[kept]]).astype("<f4")
    return SurfaceMap("b", rows.tobytes(), int(is_landmark[kept].sum()))


def map_rows(stored: SurfaceMap) -> NDArray[np.float32]:
    """(x, y, z, sigma) of a stored map, shape (n, 4), metres."""
    return np.frombuffer(stored.points, "<f4").reshape(-1, 4)


def nearest_surface(
    found: Surroundings, point: PointEstimate, pipe: PipeEstimate, key: int, values: gtsam.Values, system: LinearSystem
) -> NearestSurface | None:
    """The mapped point that comes nearest to what a blade through the pipe sweeps, the pipe itself left out.

    Of several the one with the least distance after 1.645 sigma: which is nearest is not sure either.

    Args:
        pipe: the point's own.
        key: of the point in the graph.
    """
    ray = found.points_m - point.position_m
    distance = np.linalg.norm(ray, axis=1)
    along = (found.points_m - pipe.point_m) @ pipe.axis
    across = found.points_m - pipe.point_m - np.outer(along, pipe.axis)
    off = np.linalg.norm(across, axis=1)
    spread = np.hypot(found.sigma_m, _mantle_sigma(pipe, across, off, along))
    other = (off - pipe.radius_m > OWN_SIGMA * spread) & np.isfinite(distance) & (distance > 0)
    other &= _in_company(found.points_m, other)
    if not other.any():
        return None
    # The blade's disc reaches furthest across the axis.
    lean = (ray @ pipe.axis) / np.where(distance > 0, distance, 1.0)
    gap = distance - pipe.radius_m * np.sqrt(np.clip(1 - lean**2, 0, 1)) - ONE_SIDED95 * found.sigma_m
    rows = np.flatnonzero(other)
    rows = rows[np.argsort(gap[rows], kind="stable")][:CANDIDATES]
    best, least = None, np.inf
    for row in rows:
        unit = ray[row] / distance[row]
        sigma = _distance_sigma(found, int(row), unit, point, key, values, system)
        reach = gap[row] + ONE_SIDED95 * (found.sigma_m[row] - sigma)
        if reach < least:
            what = "landmark of the mobile camera" if row < len(found.landmarks) else "surface seen by the Kinect"
            best, least = NearestSurface(what, float(distance[row]), sigma, unit), reach
    return best


def _mantle_sigma(pipe: PipeEstimate, across: Float, off: Float, along: Float) -> Float:
    """Sigma of the distance from the pipe's mantle at each place along it, from axis, direction and radius jointly."""
    out = across / np.where(off > 0, off, 1.0)[:, None]
    J = np.column_stack([out, along[:, None] * out, np.ones(len(out))])
    return np.sqrt(np.clip(np.einsum("ni,ij,nj->n", J, pipe.covariance, J), 0.0, None))


def _in_company(points: Float, other: Bool) -> Bool:
    """Whether another such point is near."""
    company = np.zeros(len(points), bool)
    rows = np.flatnonzero(other)
    if len(rows) > 1:
        apart, _ = KDTree(points[rows]).query(points[rows], k=2)
        company[rows] = apart[:, 1] < NEIGHBOUR_M
    return company


def _distance_sigma(
    found: Surroundings,
    row: int,
    unit: Float,
    point: PointEstimate,
    key: int,
    values: gtsam.Values,
    system: LinearSystem,
) -> float:
    """Sigma of the distance from the joint of the point and what is next to it."""
    if row < len(found.landmarks):
        base = values.atPose3(present_base(values))
        o_unit = base.rotation().matrix() @ unit
        blocks = [(found.landmarks[row], o_unit[None]), (key, -o_unit[None])]
        return float(np.sqrt(system.covariance(blocks)[0, 0]))
    measured = found.measured_m[row - len(found.landmarks)]
    _, of_point = point_blocks(values, present_base(values), key)
    depth = unit[None] @ depth_moves(measured[None])[0]
    blocks = [(k, -unit[None] @ J) for k, J in of_point]
    blocks += [(keys.DEPTH, depth[:, :2]), (keys.DEPTH_RAYS, depth[:, 2:])]
    return float(np.sqrt(system.covariance(blocks)[0, 0] + found.sigma_m[row] ** 2))
