"""Registration of two clouds: point to plane, robust, with a covariance that grows where the geometry holds nothing.

Poses' tangent is GTSAM's: rotation first, in the moved cloud's own frame, a_T_b * Exp(xi).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from ...factors.measurements import CloudFrame
from ..covariance import larger
from .noise import SMOOTH_SHARE

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class RegistrationConfig:
    """Search radii and when a registration is believed."""

    reaches_m: tuple[float, ...] = (0.20, 0.10, 0.06)
    """Largest distance of partners, from coarse to fine."""
    iterations: int = 12
    """For each."""
    normal_agreement_rad: float = np.deg2rad(35.0)
    smooth_share: float = SMOOTH_SHARE
    weakest_sigma_m: float = 1.0
    """Directions that the geometry leaves free get this sigma (and in rad): no information, finite numbers."""


@dataclass(frozen=True, slots=True)
class Registration:
    """Pose of cloud b in cloud a."""

    a_T_b: Float
    """Shape (4, 4)."""
    covariance: Float
    """Shape (6, 6), of xi in a_T_b * Exp(xi): rotation first, in b's frame (GTSAM)."""
    overlap: float
    """Part of b's samples that found a partner."""
    rms_m: float
    """Robust scatter of the partners' distances along the normals."""
    effective_pairs: float
    weakest: Float
    """Shape (6,), the direction of xi that is held worst."""
    converged: bool


class SurfaceMap:
    """Surface samples to register against; a keyframe's or several keyframes'."""

    def __init__(self, points: Float, normals: Float, sigma: Float, bias: Float) -> None:
        self.points, self.normals, self.sigma, self.bias = points, normals, sigma, bias
        self.tree = KDTree(points)

    @classmethod
    def of(cls, cloud: CloudFrame) -> "SurfaceMap":
        return cls(cloud.points_m, cloud.normals, cloud.sigma_m, cloud.bias_m)

    def joined(self, cloud: CloudFrame, map_T_cloud: Float, voxel_m: float) -> "SurfaceMap":
        """This map with a cloud's samples added where it has none within `voxel_m` of a like normal."""
        points = cloud.points_m @ map_T_cloud[:3, :3].T + map_T_cloud[:3, 3]
        normals = cloud.normals @ map_T_cloud[:3, :3].T
        distance, index = (np.asarray(a) for a in self.tree.query(points, distance_upper_bound=voxel_m))
        known = np.isfinite(distance)
        known[known] = (normals[known] * self.normals[index[known]]).sum(axis=1) > 0.8
        new = ~known
        return SurfaceMap(
            np.vstack((self.points, points[new])),
            np.vstack((self.normals, normals[new])),
            np.concatenate((self.sigma, cloud.sigma_m[new])),
            np.concatenate((self.bias, cloud.bias_m[new])),
        )


def register(
    cloud_a: CloudFrame | SurfaceMap, cloud_b: CloudFrame, guess: Float, config: RegistrationConfig | None = None
) -> Registration:
    """Registers cloud b to cloud a by point-to-plane distances with a Cauchy-like kernel.

    Args:
        cloud_a: Samples or map that stays.
        cloud_b: Samples that move.
        guess: Shape (4, 4), a_T_b to within the first search radius.
        config: Search radii.
    """
    config = config or RegistrationConfig()
    target = cloud_a if isinstance(cloud_a, SurfaceMap) else SurfaceMap.of(cloud_a)
    pose = np.array(guess, float)
    pairs, converged = None, False
    for reach in config.reaches_m:
        for _ in range(config.iterations):
            pairs = _Pairs.find(target, cloud_b, pose, reach, config.normal_agreement_rad)
            if pairs is None:
                return _lost(pose, config)
            step = pairs.step()
            pose = pose @ exponential(step)
            converged = bool(np.abs(step[:3]).max() < 2e-5 and np.abs(step[3:]).max() < 2e-5)
            if converged or (reach > config.reaches_m[-1] and np.abs(step).max() < 2e-3):
                break
    pairs = _Pairs.find(target, cloud_b, pose, config.reaches_m[-1], config.normal_agreement_rad)
    return _lost(pose, config) if pairs is None else _summary(pose, pairs, len(cloud_b.points_m), converged, config)


def small_motion(reference: SurfaceMap, cloud: CloudFrame, reach_m: float = 0.08) -> Float | None:
    """First guess of a small motion of the camera since `reference` was taken: one step of the registration.

    Cheap, and good to tell still from moving; directions that the geometry leaves free come out as no motion.

    Returns:
        Tangent (6,), rotation first, or None where fewer than half of the samples have a partner.
    """
    pairs = _Pairs.find(reference, cloud, np.eye(4), reach_m, np.deg2rad(35.0))
    if pairs is None or len(pairs.residual) < 0.5 * len(cloud.points_m):
        return None
    normal = pairs.jacobian.T @ (pairs.weight[:, None] * pairs.jacobian)
    values, vectors = np.linalg.eigh(normal)
    held = values > 1e-3 * values[-1]
    gradient = -pairs.jacobian.T @ (pairs.weight * pairs.residual)
    return vectors[:, held] @ ((vectors[:, held].T @ gradient) / values[held])


@dataclass(frozen=True, slots=True)
class _Pairs:
    residual: Float
    jacobian: Float
    """(n, 6)"""
    weight: Float
    """(n,), 1/m^2, robust."""
    rms: float
    place: Float
    """(n, 3), where in a."""
    bias: Float
    seen: Float
    """(n, 3), where in b."""

    @classmethod
    def find(
        cls, target: SurfaceMap, cloud: CloudFrame, pose: Float, reach: float, agreement: float
    ) -> "_Pairs | None":
        rotation = pose[:3, :3]
        points = cloud.points_m @ rotation.T + pose[:3, 3]
        normals = cloud.normals @ rotation.T
        distance, index = (np.asarray(a) for a in target.tree.query(points, distance_upper_bound=reach))
        found = np.nonzero(np.isfinite(distance))[0]
        partner = index[found]
        alike = (normals[found] * target.normals[partner]).sum(axis=1) > np.cos(agreement)
        found, partner = found[alike], partner[alike]
        if len(found) < 30:
            return None
        normal = target.normals[partner] + normals[found]
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        residual = ((points[found] - target.points[partner]) * normal).sum(axis=1)
        local = normal @ rotation
        jacobian = np.hstack((np.asarray(np.cross(cloud.points_m[found], local), np.float64), local))
        sigma = np.hypot(cloud.sigma_m[found], target.sigma[partner])
        scale = max(1.4826 * float(np.median(np.abs(residual) / sigma)), 0.5)
        ratio = residual / (2.4 * scale * sigma)
        weight = 1 / ((scale * sigma) ** 2 * (1 + ratio**2) ** 2)
        rms = 1.4826 * float(np.median(np.abs(residual)))
        bias = np.hypot(cloud.bias_m[found], target.bias[partner])
        return cls(residual, jacobian, weight, rms, points[found], bias, cloud.points_m[found])

    def step(self) -> Float:
        normal = self.jacobian.T @ (self.weight[:, None] * self.jacobian)
        damping = 1e-6 * np.diag(normal).max() * np.eye(6)
        return np.linalg.solve(normal + damping, -self.jacobian.T @ (self.weight * self.residual))


def _summary(pose: Float, pairs: _Pairs, count: int, converged: bool, config: RegistrationConfig) -> Registration:
    normal = pairs.jacobian.T @ (pairs.weight[:, None] * pairs.jacobian)
    prior = np.eye(6) / config.weakest_sigma_m**2
    inverse = np.asarray(np.linalg.inv(normal + prior), np.float64)
    # Depth errors are common to a surface: each stretch of 0.25 m of the scene with a like normal is one observation.
    facing = np.argmax(np.abs(pairs.jacobian[:, 3:]), axis=1)
    cells = np.column_stack((np.floor(pairs.place / 0.25).astype(int), facing))
    _, patch = np.unique(cells, axis=0, return_inverse=True)
    number = int(patch.max()) + 1
    scores = np.zeros((number, 6))
    np.add.at(scores, patch.ravel(), (pairs.weight * pairs.residual)[:, None] * pairs.jacobian)
    sandwich = inverse @ (scores.T @ scores) @ inverse * number / max(number - 6, 1)
    common = np.zeros((number, 6))
    np.add.at(common, patch.ravel(), (pairs.weight * pairs.bias)[:, None] * pairs.jacobian)
    bias = inverse @ (common.T @ common) @ inverse
    covariance = larger(inverse, sandwich + bias + _smooth(pairs, inverse, config.smooth_share))
    values, vectors = np.linalg.eigh(covariance)
    effective = len(pairs.residual) * 6 / max(float(np.trace(np.linalg.solve(inverse, covariance))), 6.0)
    return Registration(
        a_T_b=pose,
        covariance=covariance,
        overlap=len(pairs.residual) / max(count, 1),
        rms_m=pairs.rms,
        effective_pairs=effective,
        weakest=vectors[:, int(np.argmax(values))],
        converged=converged,
    )


def _smooth(pairs: _Pairs, inverse: Float, share: float) -> Float:
    """Covariance from depth errors that parts of the image share, in both clouds: 15 degrees of view move together."""
    depth = pairs.seen[:, 2:]
    cells = np.floor(pairs.seen[:, :2] / depth / np.tan(np.deg2rad(15.0))).astype(int)
    _, part = np.unique(cells, axis=0, return_inverse=True)
    along_ray = (pairs.jacobian[:, 3:] * pairs.seen).sum(axis=1)
    scores = np.zeros((int(part.max()) + 1, 6))
    np.add.at(scores, part.ravel(), (pairs.weight * along_ray * share * np.sqrt(2.0))[:, None] * pairs.jacobian)
    return inverse @ (scores.T @ scores) @ inverse


def _lost(pose: Float, config: RegistrationConfig) -> Registration:
    free = np.eye(6) * config.weakest_sigma_m**2
    return Registration(pose, free, 0.0, float("inf"), 0.0, np.eye(6)[0], False)


def exponential(xi: Float) -> Float:
    """SE(3) exponential, rotation first."""
    angle = float(np.linalg.norm(xi[:3]))
    out = np.eye(4)
    out[:3, :3] = Rotation.from_rotvec(xi[:3]).as_matrix()
    hat = np.array([[0, -xi[2], xi[1]], [xi[2], 0, -xi[0]], [-xi[1], xi[0], 0]])
    if angle < 1e-6:
        left = np.eye(3) + 0.5 * hat
    else:
        left = np.eye(3) + (1 - np.cos(angle)) / angle**2 * hat + (angle - np.sin(angle)) / angle**3 * hat @ hat
    out[:3, 3] = left @ xi[3:]
    return out
