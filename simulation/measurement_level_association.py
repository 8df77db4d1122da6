"""Landmarks on the drawn Kinect samples: the samples are points of exact planes with exact normals, so the nearest
sample of an undivided neighbourhood is the landmark's plane.

Every sample serves one landmark only: two residuals that share a sample's noise would not be independent.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from ..estimator.surfaces import PlaneMatch
from ..factors.measurements import CloudFrame

Float = NDArray[np.float64]

NEIGHBOURS = 6
REACH_M = 0.4
SAME_NORMAL = 0.98
GATE_SIGMA = 4.0


def nearest_plane(
    landmarks_m: Float, sigma_m: Float, cloud: CloudFrame
) -> tuple[list[PlaneMatch], list[tuple[int, str, float, float]]]:
    """Matches and refusals, as `estimator.surfaces.Associator` asks for.

    Args:
        landmarks_m: shape (n, 3), in {b}, as the Kinect would measure them.
        sigma_m: shape (n,).
        cloud: the Kinect's samples.
    """
    matches: list[PlaneMatch] = []
    refusals: list[tuple[int, str, float, float]] = []
    if len(cloud.points_m) < NEIGHBOURS:
        return matches, refusals
    distances, rows = cKDTree(cloud.points_m).query(landmarks_m, k=NEIGHBOURS)
    used: set[int] = set()
    for index in np.argsort(distances[:, 0]):
        near = rows[index]
        normal = cloud.normals[near[0]]
        agreement = float((cloud.normals[near] @ normal).min())
        if distances[index, -1] > REACH_M or agreement < SAME_NORMAL or int(near[0]) in used:
            continue
        offsets_m = np.abs((cloud.points_m[near] - cloud.points_m[near[0]]) @ normal)
        if offsets_m.max() > 5.0 * cloud.sigma_m[near].max():
            continue
        off_m = abs(float(normal @ (landmarks_m[index] - cloud.points_m[near[0]])))
        limit_m = GATE_SIGMA * float(np.hypot(sigma_m[index], cloud.sigma_m[near[0]]))
        if off_m > limit_m:
            refusals.append((int(index), "off the surface by m", off_m, limit_m))
            continue
        used.add(int(near[0]))
        matches.append(PlaneMatch(int(index), cloud.points_m[near[0]], normal, float(cloud.sigma_m[near[0]])))
    return matches, refusals
