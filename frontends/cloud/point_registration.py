"""Points of a map laid on a depth camera's surfaces: where the camera stands, how sure, and whether it can be true."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from ...factors.cloud import depth_moves
from ...factors.measurements import CloudFrame
from .registration import exponential

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]

REACHES_M = (0.4, 0.2, 0.1, 0.06)
"""Largest distances of partners, from coarse to fine."""
ITERATIONS = 12
FEWEST_PAIRS = 15
LOOSE_M, LOOSE_RAD = 3.0, 3.0
"""Directions that the pairs leave free keep the guess: so wide a prior informs of nothing."""
SAME_SIDE_COSINE = 0.1
VIEW_RAD = np.deg2rad(1.5)
"""Samples so near to a point's direction tell what the depth camera sees there; coarser cameras have wider spacing."""
VIEW_SAMPLES = 4
CLEAR_M = 0.12
"""A point so far before a surface, beyond its own noise, stands where the depth camera sees through."""
FEWEST_SEEN_SHARE = 0.6


@dataclass(frozen=True, slots=True)
class MapPoints:
    """Points of {o} with what is known of each."""

    points_m: Float
    """Shape (n, 3)."""
    sigma_m: Float
    """Shape (n,)."""
    seen_from_m: Float
    """Shape (n, 3), a place of the camera that saw it, in {o}."""


@dataclass(frozen=True, slots=True)
class PointRegistration:
    """`o_T_b` of the depth camera by points on surfaces."""

    o_T_b: Float
    """Shape (4, 4)."""
    covariance: Float
    """Shape (6, 6), of xi in o_T_b * Exp(xi), rotation first; wide along what the surfaces leave free."""
    pairs: int
    on_surface: int
    """Points that lie where the depth camera sees a surface."""
    contradictions: int
    """Points in the free space before what it sees."""

    @property
    def plausible(self) -> bool:
        """Do most of the points that the depth camera must see lie on what it sees?"""
        seen = self.on_surface + self.contradictions
        return self.on_surface >= FEWEST_PAIRS and self.on_surface > FEWEST_SEEN_SHARE * seen


def register_points(
    points: MapPoints, cloud: CloudFrame, guess: Float, depth_sigmas: Float, reaches_m: tuple[float, ...] = REACHES_M
) -> PointRegistration | None:
    """Point-to-plane registration of sparse points, with the depth offset and scale as further unknowns.

    Args:
        guess: shape (4, 4), `o_T_b` to within the first reach.
        depth_sigmas: shape (2,), prior sigmas of offset [m] and scale.

    Returns:
        None where too few points find a surface.
    """
    tree, pose, states = KDTree(cloud.points_m), np.array(guess, float), np.zeros(2)
    prior = np.concatenate([np.full(3, LOOSE_RAD), np.full(3, LOOSE_M), depth_sigmas]) ** -2.0
    pairs = None
    for reach in reaches_m:
        for _ in range(ITERATIONS):
            pairs = _Pairs.find(points, cloud, tree, pose, states, reach)
            if pairs is None:
                return None
            normal = pairs.jacobian.T @ (pairs.weight[:, None] * pairs.jacobian) + np.diag(prior)
            gradient = pairs.jacobian.T @ (pairs.weight * pairs.residual)
            gradient[6:] += prior[6:] * states
            step = np.asarray(np.linalg.solve(normal, -gradient), np.float64)
            pose, states = pose @ exponential(step[:6]), states + step[6:]
            if np.abs(step).max() < 1e-5:
                break
    pairs = _Pairs.find(points, cloud, tree, pose, states, reaches_m[-1])
    if pairs is None:
        return None
    normal = pairs.jacobian.T @ (pairs.weight[:, None] * pairs.jacobian) + np.diag(prior)
    on, before = _visibility(points, cloud, pose)
    covariance = np.asarray(np.linalg.inv(normal)[:6, :6], np.float64)
    return PointRegistration(pose, covariance, len(pairs.residual), on, before)


@dataclass(frozen=True, slots=True)
class _Pairs:
    residual: Float
    jacobian: Float
    """(n, 8), by (pose, depth offset, depth scale)."""
    weight: Float
    """(n,), 1/m^2, robust."""

    @classmethod
    def find(
        cls, points: MapPoints, cloud: CloudFrame, tree: KDTree, pose: Float, states: Float, reach: float
    ) -> "_Pairs | None":
        b_p = (points.points_m - pose[:3, 3]) @ pose[:3, :3]
        b_eye = (points.seen_from_m - pose[:3, 3]) @ pose[:3, :3]
        distance, index = (np.asarray(a) for a in tree.query(b_p, distance_upper_bound=reach))
        found = np.flatnonzero(np.isfinite(distance))
        if len(found) < FEWEST_PAIRS:
            return None
        partner = index[found]
        normal, place = cloud.normals[partner], cloud.points_m[partner]
        towards = b_eye[found] - place
        seen = (normal * towards).sum(axis=1) > SAME_SIDE_COSINE * np.linalg.norm(towards, axis=1)
        found, normal, place, partner = found[seen], normal[seen], place[seen], partner[seen]
        if len(found) < FEWEST_PAIRS:
            return None
        moves = np.einsum("ni,nik->nk", normal, depth_moves(place)[:, :, :2])
        residual = ((b_p[found] - place) * normal).sum(axis=1) - moves @ states
        by_turn = np.asarray(np.cross(normal, b_p[found]), np.float64)
        sigma = np.hypot(points.sigma_m[found], cloud.sigma_m[partner])
        scale = max(1.4826 * float(np.median(np.abs(residual) / sigma)), 1.0)
        weight = 1 / ((scale * sigma) ** 2 * (1 + (residual / (2.4 * scale * sigma)) ** 2) ** 2)
        return cls(residual, np.hstack((by_turn, -normal, -moves)), weight)


def _visibility(points: MapPoints, cloud: CloudFrame, pose: Float) -> tuple[int, int]:
    """Points on what the depth camera sees in their direction, and points before it; hidden ones count as neither."""
    b_p = (points.points_m - pose[:3, 3]) @ pose[:3, :3]
    known = b_p[:, 2] > 0.3
    b_p, sigma = b_p[known], points.sigma_m[known]
    if len(cloud.points_m) <= VIEW_SAMPLES:
        return 0, 0
    samples = cloud.points_m[:, :2] / cloud.points_m[:, 2:]
    directions = KDTree(samples)
    apart = np.asarray(directions.query(samples, k=VIEW_SAMPLES + 1)[0])[:, -1]
    reach = max(float(VIEW_RAD), 1.5 * float(np.median(apart)))
    distance, index = directions.query(b_p[:, :2] / b_p[:, 2:], k=VIEW_SAMPLES, distance_upper_bound=reach)
    hit = np.isfinite(np.asarray(distance)[:, -1])
    rows = np.asarray(index)[hit]
    depth = cloud.points_m[rows, 2]
    z, noise = b_p[hit, 2], sigma[hit]
    limit = CLEAR_M + 3.0 * noise
    on = (np.abs(z[:, None] - depth) < limit[:, None]).any(axis=1)
    before = (z < depth.min(axis=1) - limit) & ~on
    return int(on.sum()), int(before.sum())
