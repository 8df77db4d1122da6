"""Landmarks of the mobile camera on surfaces of the depth cloud: which patch, or why none."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from ...factors.measurements import CloudFrame

Float = NDArray[np.float64]
Int = NDArray[np.int64]
Bool = NDArray[np.bool_]

_NEIGHBOURS = 32


@dataclass(frozen=True, slots=True)
class AssociationConfig:
    """When a landmark counts as a point of a surface."""

    gate_sigma: float = 3.0
    depth_sigma_m: float = 0.03
    """Offset and scale of the depth camera before they are estimated: added along the ray to the gate, not to sigma."""
    smallest_radius_m: float = 0.04
    largest_radius_m: float = 0.15
    fewest_samples: int = 5
    planarity_sigma: float = 2.5
    """Patches whose samples scatter more than this many of their own sigmas about the plane are no plane."""
    normal_spread_rad: float = np.deg2rad(15.0)
    """Root mean square angle between the samples' normals and the patch's."""


@dataclass(frozen=True, slots=True)
class SurfaceMatches:
    """Landmarks on surface patches: residual n . (b_p - c), in {b}."""

    landmark: Int
    """Shape (m,), index into the landmarks."""
    point_m: Float
    """Shape (m, 3), point of the plane as measured (depth offset and scale not applied)."""
    normal: Float
    """Shape (m, 3), unit, towards the camera."""
    sigma_m: Float
    """Shape (m,), of the plane's offset at the landmark's foot, noise only."""
    bias_m: Float
    """Shape (m,), part that neighbouring patches share (quantisation); add it in quadrature, it does not average."""
    reasons: tuple[str, ...]
    """For each landmark: empty, or why it was refused."""
    values: Float
    """Shape (n,), the number that decided a refusal (metres, rad or a count), 0 for matches."""


def associate(
    landmarks_b: Float, landmark_sigma_m: Float | float, cloud: CloudFrame, config: AssociationConfig | None = None
) -> SurfaceMatches:
    """Finds the surface patch that each landmark lies on.

    Args:
        landmarks_b: Shape (n, 3), landmarks in {b} by the present estimate, metres.
        landmark_sigma_m: Shape (n,) or one number: standard deviation of each, pose of {b} included.
        cloud: Surface samples in {b}.
        config: Gates.

    Returns:
        The matches, and for each refused landmark the reason: `no surface near`, `few samples`, `thin strip`,
        `not planar`, `edge`, `depth step`, `off the surface`, `beside the surface`.
    """
    config = config or AssociationConfig()
    count = len(landmarks_b)
    sigma = np.broadcast_to(np.asarray(landmark_sigma_m, float), (count,))
    if count == 0 or len(cloud.points_m) < config.fewest_samples:
        none = np.zeros((0, 3))
        reasons = ("no surface near",) * count
        return SurfaceMatches(np.zeros(0, int), none, none, np.zeros(0), np.zeros(0), reasons, np.zeros(count))
    near = _Neighbourhood.find(landmarks_b, sigma, cloud, config)
    plane = _planes(near, cloud)
    checks = _checks(landmarks_b, sigma, near, plane, cloud, config)
    return _matches(landmarks_b, plane, checks)


@dataclass(frozen=True, slots=True)
class _Neighbourhood:
    index: Int
    """(n, k), samples near each landmark; the cloud's length where there is none."""
    inside: Bool
    """(n, k)"""
    radius: Float
    """(n,)"""
    nearest: Float
    """(n,), distance to the nearest sample."""
    spacing: Float
    """(n,), distance between samples there."""

    @classmethod
    def find(cls, landmarks: Float, sigma: Float, cloud: CloudFrame, config: AssociationConfig) -> "_Neighbourhood":
        tree = KDTree(cloud.points_m)
        neighbours = min(_NEIGHBOURS, len(cloud.points_m))
        found = tree.query(landmarks, k=neighbours, distance_upper_bound=1.5 * config.largest_radius_m)
        distance, index = np.asarray(found[0]), np.asarray(found[1], np.int64)
        spacing = np.full(len(landmarks), config.largest_radius_m)
        some = index[:, 0] < len(cloud.points_m)
        spacing[some] = np.asarray(tree.query(cloud.points_m[index[some, 0]], k=2)[0])[:, 1]
        radius = np.clip(np.maximum(2.5 * spacing, 2.0 * sigma), config.smallest_radius_m, config.largest_radius_m)
        # The foot on the surface is what counts, so the landmark's own distance from it does not use up the radius.
        reach = np.hypot(radius, np.where(np.isfinite(distance[:, 0]), distance[:, 0], 0.0))
        return cls(index, distance <= reach[:, None], radius, distance[:, 0], spacing)


@dataclass(frozen=True, slots=True)
class _Planes:
    centre: Float
    normal: Float
    count: Float
    rms: Float
    """(n,), scatter of the samples in units of their own sigmas."""
    narrow: Float
    """(n,), standard deviation of the samples along the patch's shorter side, metres."""
    angle: Float
    """(n,), root mean square angle of the samples' normals to the plane's, rad."""
    sigma: Float
    bias: Float
    scatter: Float
    """(n, 3, 3), weighted scatter about the centre, metres^2, per sample."""
    weight: Float
    """(n,), sum of the weights, 1/metres^2."""


def _planes(near: _Neighbourhood, cloud: CloudFrame) -> _Planes:
    pad = np.minimum(near.index, len(cloud.points_m) - 1)
    weight = near.inside / cloud.sigma_m[pad] ** 2
    total = np.maximum(weight.sum(axis=1), 1e-12)
    points, normals = cloud.points_m[pad], cloud.normals[pad]
    centre = (weight[..., None] * points).sum(axis=1) / total[:, None]
    offset = points - centre[:, None]
    scatter = np.einsum("nk,nki,nkj->nij", weight, offset, offset) / total[:, None, None]
    values, vectors = np.linalg.eigh(scatter)
    normal = vectors[:, :, 0]
    mean_normal = (weight[..., None] * normals).sum(axis=1)
    normal = normal * np.where((normal * mean_normal).sum(axis=1) < 0, -1.0, 1.0)[:, None]
    count = near.inside.sum(axis=1).astype(float)
    distance = np.einsum("nki,ni->nk", offset, normal)
    rms = np.sqrt((weight * distance**2).sum(axis=1) / np.maximum(count - 3, 1))
    cosine = np.clip(np.einsum("nki,ni->nk", normals, normal), -1, 1)
    angle = np.sqrt((near.inside * np.arccos(cosine) ** 2).sum(axis=1) / np.maximum(count, 1))
    noise2 = np.maximum(cloud.sigma_m[pad] ** 2 - cloud.bias_m[pad] ** 2, 1e-12)
    sigma = np.sqrt((weight**2 * noise2).sum(axis=1)) / total * np.maximum(rms, 1.0)
    bias = (weight * cloud.bias_m[pad]).sum(axis=1) / total
    return _Planes(centre, normal, count, rms, np.sqrt(np.maximum(values[:, 1], 0)), angle, sigma, bias, scatter, total)


def _checks(
    landmarks: Float, sigma: Float, near: _Neighbourhood, plane: _Planes, cloud: CloudFrame, config: AssociationConfig
) -> list[tuple[str, Bool, Float]]:
    """Refusals in order of importance: name, who, the number that decided."""
    height = np.einsum("ni,ni->n", landmarks - plane.centre, plane.normal)
    lateral = np.linalg.norm(landmarks - plane.centre - height[:, None] * plane.normal, axis=1)
    ray = landmarks / np.maximum(np.linalg.norm(landmarks, axis=1, keepdims=True), 1e-9)
    facing = np.abs((ray * plane.normal).sum(axis=1))
    gate = config.gate_sigma * np.sqrt(sigma**2 + plane.sigma**2 + plane.bias**2 + (config.depth_sigma_m * facing) ** 2)
    step = _depth_step(landmarks, sigma, near, plane, cloud)
    return [
        ("no surface near", ~near.inside[:, 0], near.nearest),
        ("few samples", plane.count < config.fewest_samples, plane.count),
        ("thin strip", plane.narrow < 0.5 * near.spacing, plane.narrow),
        ("not planar", plane.rms > config.planarity_sigma, plane.rms),
        ("edge", plane.angle > config.normal_spread_rad, plane.angle),
        ("depth step", step > gate, step),
        ("off the surface", np.abs(height) > gate, height),
        ("beside the surface", lateral > 0.75 * near.radius, lateral),
    ]


def _depth_step(landmarks: Float, sigma: Float, near: _Neighbourhood, plane: _Planes, cloud: CloudFrame) -> Float:
    """How far other surfaces that the landmark's ray might meet lie from the plane, metres.

    The samples are looked up by viewing direction within two sigmas (and two spacings) of the landmark's.
    """
    depth = np.maximum(landmarks[:, 2], 0.1)
    directions = cloud.points_m[:, :2] / cloud.points_m[:, 2:]
    neighbours = min(_NEIGHBOURS, len(directions))
    distance, index = KDTree(directions).query(landmarks[:, :2] / depth[:, None], k=neighbours)
    reach = (2.0 * sigma + 2.0 * near.spacing) / depth
    points = cloud.points_m[index]
    away = np.abs(np.einsum("nki,ni->nk", points - plane.centre[:, None], plane.normal))
    return np.where(distance <= reach[:, None], away, 0.0).max(axis=1)


def _matches(landmarks: Float, plane: _Planes, checks: list[tuple[str, Bool, Float]]) -> SurfaceMatches:
    reasons = np.full(len(landmarks), "", dtype=object)
    values = np.zeros(len(landmarks))
    for name, refused, value in reversed(checks):
        reasons[refused] = name
        values[refused] = value[refused]
    keep = np.nonzero(reasons == "")[0]
    return SurfaceMatches(
        landmark=keep,
        point_m=plane.centre[keep],
        normal=plane.normal[keep],
        sigma_m=_offset_sigma(landmarks[keep], plane, keep),
        bias_m=plane.bias[keep],
        reasons=tuple(str(reason) for reason in reasons),
        values=values,
    )


def _offset_sigma(landmarks: Float, plane: _Planes, keep: Int) -> Float:
    """Sigma of the plane at the landmark's foot: that of its centre, and its tilt times the way from the centre."""
    centre, normal = plane.centre[keep], plane.normal[keep]
    away = landmarks - centre
    away = away - (away * normal).sum(axis=1, keepdims=True) * normal
    lean = np.linalg.pinv(plane.scatter[keep], rcond=1e-2, hermitian=True)
    tilt = np.einsum("ni,nij,nj->n", away, lean, away)
    return plane.sigma[keep] * np.sqrt(1.0 + tilt)
