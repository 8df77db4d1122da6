"""A cylinder from points: RANSAC for a start, robust least squares, and a covariance that neighbours cannot shrink."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ...factors.measurements import Rejection
from ..cloud.points import local_planes, spread_evenly
from ..covariance import larger
from .consensus import Axis, candidates

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]


_SAMPLE, _THIN = 800, 700
"""Points with normals for the hypotheses, and points that choose among these."""
_SETTLED = 1e-5
"""m and rad: a thirtieth of the surest cylinder's sigmas."""


@dataclass(frozen=True, slots=True)
class CylinderConfig:
    """What counts as a cylinder."""

    points: int = 4000
    """More points than this are thinned out."""
    smallest_radius_m: float = 0.008
    largest_radius_m: float = 0.4
    fewest_inliers: int = 60
    inlier_share: float = 0.25
    """Least part of the points that must lie on it."""
    gate_sigma: float = 3.0
    split_radius_share: float = 0.12
    """Radii of the halves may differ by this part, beyond their sigmas."""
    split_axis_rad: float = np.deg2rad(6.0)
    """Axes of repeated fits may differ by so much, beyond their sigmas."""
    check_halves: bool = True
    """Do halves of the points show the same cylinder? Not asked where a further fit follows that asks."""
    seed: int = 0


@dataclass(frozen=True, slots=True)
class CylinderFit:
    """A cylinder in the frame of its points, with what supports it."""

    point_a_m: Float
    """Shape (3,), the axis where the points begin."""
    point_b_m: Float
    """Shape (3,), where they end."""
    radius_m: float
    information: Float
    """Shape (7, 7), of (point_a, point_b, radius); zero along slides of the points on the axis."""
    covariance: Float
    """Shape (5, 5), of (two shifts at the middle, two tilts, radius), m and rad, in the plane across the axis."""
    inliers: Bool
    """Shape (n,), of the points given."""
    rms_m: float
    effective_points: float
    """Number of independent points that would give this covariance."""
    arc_rad: float
    """Part of the circumference that the points cover."""

    @property
    def axis(self) -> Float:
        """Unit, from a to b."""
        way = self.point_b_m - self.point_a_m
        return way / np.linalg.norm(way)


def fit_cylinder(
    points: Float,
    sigma: Float,
    seed_axis: tuple[Float, Float] | None = None,
    radius_prior_m: tuple[float, float] | None = None,
    config: CylinderConfig | None = None,
    stamp_ns: int = 0,
    start: Axis | None = None,
) -> CylinderFit | Rejection:
    """Fits a cylinder to points of its surface, seen from outside or inside, among others.

    Args:
        points: Shape (n, 3), metres.
        sigma: Shape (n,), standard deviation of each across the surface.
        seed_axis: A point of the axis and its direction, where known roughly.
        radius_prior_m: Radius and its standard deviation, where the nominal diameter is known.
        config: Limits.
        stamp_ns: Time, for a rejection's record.
        start: The cylinder to within a few sigma, where it is known: no other one is looked for.

    Returns:
        The fit, or a rejection: too few points, no consensus, or halves and repetitions that disagree (bowls, cones,
        boxes and lids all hold points that some cylinder passes through).
    """
    config = config or CylinderConfig()
    if len(points) < config.fewest_inliers:
        return _refuse(stamp_ns, "points", len(points), config.fewest_inliers)
    kept = spread_evenly(points, config.points) if len(points) > config.points else np.arange(len(points))
    used, noise = points[kept], sigma[kept]
    sample = np.random.default_rng(config.seed).permutation(len(used))[:_SAMPLE]
    if start is None:
        _, normals, _ = local_planes(used, used[sample], int(np.clip(len(used) // 60, 12, 40)))
        starts = candidates(used[sample], normals, noise[sample], config.seed, seed_axis, radius_prior_m,
                            (config.smallest_radius_m, config.largest_radius_m))  # fmt: skip
        thin = sample[:_THIN]
        fits = [_Fit.robust(used[thin], noise[thin], s, radius_prior_m, config) for s in starts]
        chosen = max((f for f in fits if f is not None), key=lambda f: f.score, default=None)
        start = None if chosen is None else chosen.axis
    best = None if start is None else _Fit.robust(used, noise, start, radius_prior_m, config)
    if best is None:
        return _refuse(stamp_ns, "inlying share of the points", 0.0, config.inlier_share)
    share = float(best.inlier.mean())
    if share < config.inlier_share or best.inlier.sum() < config.fewest_inliers:
        return _refuse(stamp_ns, "inlying share of the points", share, config.inlier_share)
    inside = np.nonzero(best.inlier)[0]
    inside = inside[:: max(1, len(inside) // (2 * _THIN))]
    split = _halves(used[inside], noise[inside], best, config, radius_prior_m) if config.check_halves else 1.0
    if isinstance(split, tuple):
        return _refuse(stamp_ns, *split)
    best = replace(best, covariance=best.covariance * split, independent=best.independent / split)
    return _report(points, sigma, used, best, config)


@dataclass(frozen=True, slots=True)
class _Fit:
    axis: Axis
    inlier: Bool
    covariance: Float
    score: float
    rms: float
    independent: float

    @classmethod
    def robust(
        cls, points: Float, sigma: Float, start: Axis, prior: tuple[float, float] | None, config: CylinderConfig
    ) -> "_Fit | None":
        axis = start
        scatter = sigma.copy()
        inlier = np.ones(len(points), bool)
        for step in range(12):
            residual, jacobian = axis.residuals(points)
            gate = config.gate_sigma * scatter * max(1.0, 3.0 - step)
            inlier = np.abs(residual) < gate
            if inlier.sum() < max(20, config.fewest_inliers // 2):
                return None
            weight = np.where(inlier, (1 - np.minimum(np.abs(residual) / gate, 1) ** 2) ** 2, 0.0) / scatter**2
            normal = jacobian.T @ (weight[:, None] * jacobian)
            gradient = -jacobian.T @ (weight * residual)
            if prior is not None:
                normal[4, 4] += 1 / prior[1] ** 2
                gradient[4] += (prior[0] - axis.radius) / prior[1] ** 2
            change = np.linalg.solve(normal + 1e-12 * np.trace(normal) * np.eye(5), gradient)
            axis = axis.moved(change)
            if axis is None or not config.smallest_radius_m < axis.radius < config.largest_radius_m:
                return None
            # The scatter about the surface decides when it is larger than the sensor's own sigma.
            middle = 1.4826 * float(np.median(np.abs(residual[inlier]) / sigma[inlier]))
            scatter = sigma * float(np.clip(middle, 0.5, 1.6))
            if step > 3 and np.abs(change).max() < _SETTLED:
                break
        covariance, independent = _covariance(points, axis, inlier, scatter, prior)
        residual, _ = axis.residuals(points)
        rms = float(np.sqrt(np.mean(residual[inlier] ** 2)))
        score = float(np.maximum(1 - (residual / (config.gate_sigma * sigma)) ** 2, 0).sum())
        return cls(axis, inlier, covariance, score, rms, independent)


def _covariance(
    points: Float, axis: Axis, inlier: Bool, scatter: Float, prior: tuple[float, float] | None
) -> tuple[Float, float]:
    """Cluster-robust covariance: patches of the surface are the observations, not points.

    Stereo and structured light match windows, so residuals of neighbours move together. The patches are made larger
    until the covariance grows no more; it never falls below that of independent points.
    """
    inside = points[inlier]
    residual, jacobian = axis.residuals(inside)
    weighted = jacobian / scatter[inlier, None] ** 2
    normal = jacobian.T @ weighted
    if prior is not None:
        normal[4, 4] += 1 / prior[1] ** 2
    inverse = np.linalg.inv(normal + 1e-12 * np.trace(normal) * np.eye(5))
    along, angle = axis.coordinates(inside)
    best = inverse
    for cells in (16, 10, 6):
        patch = _bins(along, cells) * cells + _bins(angle, cells)
        scores = np.zeros((cells * cells, 5))
        np.add.at(scores, patch, weighted * residual[:, None])
        filled = len(np.unique(patch))
        if filled < 8:
            break
        sandwich = inverse @ (scores.T @ scores) @ inverse * filled / max(filled - 5, 1)
        best = larger(best, sandwich)
    ratio = np.trace(np.linalg.solve(best, inverse)) / 5
    return best, float(inlier.sum() * ratio)


def _bins(values: Float, count: int) -> NDArray[np.int64]:
    low, high = float(values.min()), float(values.max())
    return np.minimum(((values - low) / max(high - low, 1e-9) * count).astype(int), count - 1)


def _halves(
    inside: Float, noise: Float, best: _Fit, config: CylinderConfig, prior: tuple[float, float] | None
) -> float | tuple[str, float, float]:
    """How far halves of the inliers disagree: factor for the covariance, or why this is no cylinder (what, how much,
    limit). A surface that is no cylinder, and errors that all neighbours share, show here and nowhere else."""
    along, angle = best.axis.coordinates(inside)
    factor = 1.0
    for name, half in (("along the axis", along > np.median(along)), ("round it", angle > np.median(angle))):
        one, two = (_Fit.robust(inside[part], noise[part], best.axis, prior, config) for part in (half, ~half))
        if one is None or two is None:
            return f"halves {name} with a cylinder of their own", float((one or two) is not None), 2.0
        spread = float(np.sqrt(one.covariance[4, 4] + two.covariance[4, 4]))
        difference = abs(one.axis.radius - two.axis.radius)
        limit = config.split_radius_share * best.axis.radius + 2.0 * spread
        if difference > limit or spread > 0.5 * best.axis.radius:
            return f"radii of the halves {name}, difference in m", max(difference, spread), limit
        turn = one.axis.angle_to(two.axis)
        lean = float(np.sqrt(np.trace(one.covariance[2:4, 2:4]) + np.trace(two.covariance[2:4, 2:4])))
        limit = config.split_axis_rad + 2.0 * lean
        if turn > limit or lean > np.deg2rad(30.0):
            return f"axes of the halves {name}, difference in rad", max(turn, lean), limit
        factor = max(factor, (difference / spread) ** 2, 0.5 * (turn / lean) ** 2)
    return factor


def _report(points: Float, sigma: Float, used: Float, best: _Fit, config: CylinderConfig) -> CylinderFit:
    residual, _ = best.axis.residuals(points)
    scale = max(best.rms, 1e-6) / float(np.median(sigma))
    inliers = np.abs(residual) < config.gate_sigma * sigma * max(scale, 0.5)
    along, angle = best.axis.coordinates(used[best.inlier])
    ends = np.quantile(along, (0.02, 0.98))
    to_middle = best.axis.ends_to_parameters(float(ends[0]), float(ends[1]))
    information = to_middle.T @ np.linalg.inv(best.covariance) @ to_middle
    return CylinderFit(
        point_a_m=best.axis.point + ends[0] * best.axis.direction,
        point_b_m=best.axis.point + ends[1] * best.axis.direction,
        radius_m=best.axis.radius,
        information=0.5 * (information + information.T),
        covariance=best.covariance,
        inliers=inliers,
        rms_m=best.rms,
        effective_points=best.independent,
        arc_rad=float(np.ptp(np.quantile(angle, (0.02, 0.98)))),
    )


def _refuse(stamp_ns: int, reason: str, value: float, limit: float) -> Rejection:
    return Rejection(stamp_ns, "cylinder", "points", f"no cylinder: {reason}", float(value), float(limit))
