"""Cylinder hypotheses from pairs of points with normals, and the parameters that the least squares moves."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]

_HYPOTHESES = 600
_NORMAL_AGREEMENT = np.cos(np.deg2rad(25.0))


@dataclass(frozen=True, slots=True)
class Axis:
    """A cylinder by its axis point in the middle of its points, direction, two directions across, and radius."""

    point: Float
    direction: Float
    across: Float
    """(2, 3), unit, perpendicular to the direction and to each other; the first points away from the viewer's ray."""
    radius: float

    @classmethod
    def of(cls, point: Float, direction: Float, radius: float, middle: Float) -> "Axis":
        direction = direction / np.sqrt(direction @ direction)
        point = point + ((middle - point) @ direction) * direction
        towards = point - (point @ direction) * direction
        if towards @ towards < 1e-12:
            towards = _cross(direction, np.eye(3)[np.argmin(np.abs(direction))])
        first = towards / np.sqrt(towards @ towards)
        return cls(point, direction, np.array([first, _cross(direction, first)]), float(radius))

    def residuals(self, points: Float) -> tuple[Float, Float]:
        """Distance from the surface (n,), and derivatives by (two shifts, two tilts, radius) (n, 5)."""
        offset = points - self.point
        along = offset @ self.direction
        flat = offset @ self.across.T
        distance = np.maximum(np.sqrt(np.einsum("ni,ni->n", flat, flat)), 1e-9)
        jacobian = np.empty((len(points), 5))
        np.divide(flat, -distance[:, None], out=jacobian[:, :2])
        np.multiply(jacobian[:, :2], along[:, None], out=jacobian[:, 2:4])
        jacobian[:, 4] = -1.0
        return distance - self.radius, jacobian

    def coordinates(self, points: Float) -> tuple[Float, Float]:
        """Place along the axis and angle round it, the angle measured from the middle of the points."""
        offset = points - self.point
        flat = offset @ self.across.T
        mean = np.arctan2(*flat.mean(axis=0)[::-1])
        angle = np.arctan2(flat[:, 1], flat[:, 0]) - mean
        return offset @ self.direction, np.mod(angle + np.pi, 2 * np.pi) - np.pi

    def moved(self, change: Float) -> "Axis | None":
        point = self.point + change[:2] @ self.across
        direction = self.direction + np.clip(change[2:4], -0.3, 0.3) @ self.across
        radius = self.radius + float(change[4])
        return Axis.of(point, direction, radius, self.point) if np.isfinite(radius) and radius > 0 else None

    def angle_to(self, other: "Axis") -> float:
        return float(np.arccos(min(abs(float(self.direction @ other.direction)), 1.0)))

    def ends_to_parameters(self, start: float, end: float) -> Float:
        """Derivative of (two shifts, two tilts, radius) by (point_a, point_b, radius), shape (5, 7)."""
        length = end - start
        matrix = np.zeros((5, 7))
        matrix[2:4, 0:3], matrix[2:4, 3:6] = -self.across / length, self.across / length
        matrix[0:2, 0:3], matrix[0:2, 3:6] = self.across * end / length, -self.across * start / length
        matrix[4, 6] = 1.0
        return matrix


def _cross(a: Float, b: Float) -> Float:
    """Of two vectors; NumPy's takes forty times as long for a single one."""
    (ax, ay, az), (bx, by, bz) = a.tolist(), b.tolist()
    return np.array([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])


def candidates(
    points: Float,
    normals: Float,
    sigma: Float,
    seed: int,
    seed_axis: tuple[Float, Float] | None,
    radius_prior: tuple[float, float] | None,
    limits: tuple[float, float],
    count: int = 3,
) -> list[Axis]:
    """The best supported cylinders through pairs of points, best first.

    Two surface points with normals fix a cylinder: the axis is across both normals and meets both (Schnabel, Wahl,
    Klein 2007).
    """
    rng = np.random.default_rng(seed)
    first, second = rng.integers(0, len(points), (2, _HYPOTHESES))
    if seed_axis is None:
        direction = np.cross(normals[first], normals[second])
        length = np.linalg.norm(direction, axis=1)
        keep = length > 0.15
        direction = direction[keep] / length[keep, None]
    else:
        keep = np.ones(_HYPOTHESES, bool)
        direction = seed_axis[1] / np.linalg.norm(seed_axis[1]) + rng.normal(0, 0.05, (_HYPOTHESES, 3))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    point, radius, keep = _through(points, normals, first[keep], second[keep], direction, limits)
    direction, point, radius = direction[keep], point[keep], radius[keep]
    if radius_prior is not None:
        near = np.abs(radius - radius_prior[0]) < 4 * radius_prior[1] + 0.25 * radius_prior[0]
        direction, point, radius = direction[near], point[near], radius[near]
    if len(radius) == 0:
        return []
    score = _support(points, normals, sigma, point, direction, radius)
    return _distinct(points, point, direction, radius, score, count)


def _through(
    points: Float, normals: Float, first: NDArray[np.int64], second: NDArray[np.int64], direction: Float,
    limits: tuple[float, float],
) -> tuple[Float, Float, NDArray[np.bool_]]:  # fmt: skip
    """Axis points and radii by the two normals' nearest points in the plane across the direction."""
    n1, n2 = (n - (n * direction).sum(axis=1, keepdims=True) * direction for n in (normals[first], normals[second]))
    way = points[second] - points[first]
    way = way - (way * direction).sum(axis=1, keepdims=True) * direction
    a, b, c = (n1 * n1).sum(axis=1), (n1 * n2).sum(axis=1), (n2 * n2).sum(axis=1)
    d, e = (n1 * way).sum(axis=1), (n2 * way).sum(axis=1)
    determinant = a * c - b * b
    with np.errstate(divide="ignore", invalid="ignore"):
        s, t = (c * d - b * e) / determinant, (b * d - a * e) / determinant
        centre = 0.5 * (points[first] + s[:, None] * n1 + points[second] + t[:, None] * n2)
        r1, r2 = np.abs(s) * np.sqrt(a), np.abs(t) * np.sqrt(c)
    radius = 0.5 * (r1 + r2)
    good = np.isfinite(radius) & (radius > limits[0]) & (radius < limits[1]) & (np.sign(s) == np.sign(-t) * np.sign(-b))
    good[good] &= np.abs(r1[good] - r2[good]) < 0.5 * radius[good]
    return centre, radius, good


def _support(points: Float, normals: Float, sigma: Float, point: Float, direction: Float, radius: Float) -> Float:
    chosen = slice(0, 400)
    points, normals, gate = points[chosen], normals[chosen], 3.0 * np.maximum(sigma[chosen], 1e-4)
    offset = points[None] - point[:, None]
    flat = offset - (offset @ direction[:, :, None]) * direction[:, None]
    distance = np.maximum(np.linalg.norm(flat, axis=2), 1e-9)
    agree = np.abs(np.einsum("hni,ni->hn", flat, normals)) > _NORMAL_AGREEMENT * distance
    residual = (distance - radius[:, None]) / gate
    return (np.maximum(1 - residual**2, 0) * agree).sum(axis=1)


def _distinct(points: Float, point: Float, direction: Float, radius: Float, score: Float, count: int) -> list[Axis]:
    chosen: list[Axis] = []
    middle = np.median(points, axis=0)
    for i in np.argsort(-score):
        axis = Axis.of(point[i], direction[i], float(radius[i]), middle)
        if all(axis.angle_to(other) > 0.15 or abs(axis.radius - other.radius) > 0.2 * other.radius for other in chosen):
            chosen.append(axis)
        if len(chosen) == count:
            break
    return chosen
