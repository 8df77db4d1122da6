"""Clouds without image structure: normals from neighbours, and surface samples for `PointCloud2` input."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from ...factors.measurements import CloudFrame
from .noise import DepthModel, depth_noise

Float = NDArray[np.float64]
Int = NDArray[np.int64]


def cloud_from_points(
    stamp_ns: int, points_m: Float, model: DepthModel, samples: int = 4000, grazing_rad: float = np.deg2rad(75.0)
) -> CloudFrame:
    """Surface samples of an unorganised cloud in the depth camera's optical frame.

    Args:
        stamp_ns: Time of the cloud.
        points_m: Shape (n, 3), metres; rows with NaN are left out.
        model: The depth camera, for its noise.
        samples: At most so many samples.
        grazing_rad: Surfaces seen flatter than this give no sample.
    """
    noise = depth_noise(model)
    points = points_m[np.isfinite(points_m).all(axis=1)]
    points = points[(points[:, 2] > noise.minimum_m) & (points[:, 2] < noise.maximum_m)]
    if len(points) < 10:
        none = np.zeros(0)
        return CloudFrame(stamp_ns, np.zeros((0, 3)), np.zeros((0, 3)), none, none, none)
    chosen = spread_evenly(points, samples)
    count = int(np.clip(0.5 * len(points) / max(len(chosen), 1), 12, 60))
    centre, normals, rms = local_planes(points, points[chosen], count)
    ray = centre / np.linalg.norm(centre, axis=1, keepdims=True)
    normals = normals * np.where((normals * ray).sum(axis=1) > 0, -1.0, 1.0)[:, None]
    cosine = np.abs((normals * ray).sum(axis=1))
    pixel = noise.axial(centre[:, 2], np.arccos(np.minimum(cosine, 1.0))) * cosine
    bias = noise.step(centre[:, 2]) * cosine / np.sqrt(12.0)
    keep = (cosine > np.cos(grazing_rad)) & (rms < 4.0 * np.hypot(pixel, bias))
    # Neighbouring pixels of a depth camera are matched over common windows: a quarter of them counts as independent.
    sigma = np.hypot(np.maximum(pixel, rms) / np.sqrt(count / 4.0), bias)
    return CloudFrame(stamp_ns, centre[keep], normals[keep], sigma[keep], rms[keep], bias[keep])


def spread_evenly(points: Float, count: int) -> Int:
    """Indices of at most `count` points, one per voxel, with the voxel size that brings it to about that number."""
    if len(points) <= count:
        return np.arange(len(points))
    low, high = 1e-4, float(np.ptp(points, axis=0).max()) + 1e-3
    best = np.arange(0, len(points), int(np.ceil(len(points) / count)))
    for _ in range(12):
        size = float(np.sqrt(low * high))
        cells = np.floor((points - points.min(axis=0)) / size).astype(np.int64)
        key = (cells[:, 0] * 2097152 + cells[:, 1]) * 2097152 + cells[:, 2]
        _, first = np.unique(key, return_index=True)
        if len(first) > count:
            low = size
        else:
            high, best = size, np.sort(first)
            if len(first) > 0.85 * count:
                break
    return best


def local_planes(points: Float, at: Float, neighbours: int) -> tuple[Float, Float, Float]:
    """Planes through the nearest neighbours of some places.

    Args:
        points: Shape (n, 3), the cloud.
        at: Shape (m, 3), the places.
        neighbours: Number of points for each plane.

    Returns:
        Centroids (m, 3), unit normals of either sign (m, 3), root mean square distance from the plane (m,).
    """
    neighbours = min(neighbours, len(points))
    _, index = KDTree(points).query(at, k=neighbours)
    near = points[np.reshape(index, (len(at), neighbours))]
    centre = near.mean(axis=1)
    offset = near - centre[:, None]
    scatter = offset.transpose(0, 2, 1) @ offset / max(neighbours - 3, 1)
    values, vectors = np.linalg.eigh(scatter)
    return centre, vectors[:, :, 0], np.sqrt(np.maximum(values[:, 0], 0.0))
