"""Raw pixels to ideal pixels and back, for the lens models that recordings carry.

Ideal pixels are what a pinhole with the same `K` would have seen. The models are OpenCV's and ROS's: `plumb_bob`
(k1 k2 p1 p2 k3), `rational_polynomial` (k1 k2 p1 p2 k3 k4 k5 k6, optionally s1 s2 s3 s4) and `equidistant` (k1 k2 k3
k4; Kannala and Brandt). A lens polynomial is good only as far as it rises: beyond the radius where it turns back a raw
pixel has no ideal one, or a wrong one, so points out there are NaN.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ..factors.camera import CameraModel
from ..factors.errors import SurecutError

Float = NDArray[np.float64]

_WIDEST_RAD = np.deg2rad(89.0)
"""Beyond this angle from the axis an ideal pixel lies so far out that a plane image has no use for it."""
_NEWTON_STEPS = 20
_STEP = 8
_GRID_PX = 5e-4
_SOLVED = 1e-10
"""Largest remainder, in units of the focal length, of an inverse that counts as found."""


@dataclass(frozen=True, slots=True)
class _Lens:
    """A distortion in normalised coordinates, with the radius up to which it can be inverted."""

    fisheye: bool
    numerator: tuple[float, ...]
    """Coefficients of r^2, r^4, ... (of theta^2, theta^4, ... for a fisheye)."""
    denominator: tuple[float, ...]
    tangential: tuple[float, float]
    prism: tuple[float, float, float, float]
    radius_limit: float
    """Largest valid radius of the ideal point, normalised."""
    distorted_limit: float
    """The distorted radius there."""


def undistort(camera: CameraModel, raw_px: Float, covariance_px2: Float | None = None) -> tuple[Float, Float | None]:
    """Ideal pixels of raw ones, with the covariance carried over by the Jacobian.

    Args:
        camera: intrinsics and distortion.
        raw_px: shape (n, 2) (or any (..., 2)), pixels as found in the image.
        covariance_px2: shape (..., 2, 2), of the raw pixels, or None.

    Returns:
        Ideal pixels of the same shape, NaN where the lens model has no inverse, and their covariance (None for None).

    Raises:
        SurecutError: the distortion model is unknown or its coefficients do not fit it.
    """
    raw = np.asarray(raw_px, float)
    flat = raw.reshape(-1, 2)
    lens = _lens(camera.distortion_model, tuple(map(float, camera.D)), camera.name)
    if lens is None:
        return raw.copy(), None if covariance_px2 is None else np.array(covariance_px2, float)
    ideal = _inverse(lens, _normalised(camera, flat))
    result = _pixels(camera, ideal).reshape(raw.shape)
    if covariance_px2 is None:
        return result, None
    scale = camera.K[:2, :2]
    jacobian = scale @ np.linalg.inv(_checked(_forward(lens, ideal)[1])) @ np.linalg.inv(scale)
    covariance = jacobian @ np.asarray(covariance_px2, float).reshape(-1, 2, 2) @ jacobian.transpose(0, 2, 1)
    return result, covariance.reshape(*raw.shape[:-1], 2, 2)


def undistorted_grid(camera: CameraModel) -> Float:
    """The ideal pixel of every pixel of the image, shape (height, width, 2); NaN where there is none.

    Where the lens model holds all over the image it is evaluated at every eighth pixel and interpolated with cubics,
    which is exact to `_GRID_PX`.
    """
    columns, rows = (_nodes(n) for n in (camera.width, camera.height))
    coarse = undistort(camera, np.stack(np.meshgrid(columns, rows), -1))[0]
    if not np.isfinite(coarse).all():
        return _every_pixel(camera)
    across, down = _cubic_weights(camera.width, len(columns)), _cubic_weights(camera.height, len(rows))
    whole = np.stack([down @ coarse[..., k] @ across.T for k in range(2)], -1)
    # halfway between the nodes is where the interpolation is worst
    between = np.stack(np.meshgrid(columns[1:-3] + _STEP // 2, rows[1:-3] + _STEP // 2), -1)
    found = whole[_STEP // 2 :: _STEP, _STEP // 2 :: _STEP][: between.shape[0], : between.shape[1]]
    between = between[: found.shape[0], : found.shape[1]]
    if np.abs(found - undistort(camera, between)[0]).max(initial=0.0) > _GRID_PX:
        return _every_pixel(camera)
    return whole


def _every_pixel(camera: CameraModel) -> Float:
    return undistort(
        camera, np.stack(np.meshgrid(np.arange(float(camera.width)), np.arange(float(camera.height))), -1)
    )[0]


def _nodes(count: int) -> Float:
    """Places of the interpolation's nodes: one step before the image to two after it."""
    return _STEP * np.arange(-1.0, (count - 1) // _STEP + 3)


def _cubic_weights(count: int, nodes: int) -> Float:
    """Cubic Lagrange weights (count, nodes) of the pixels 0 .. count - 1."""
    cell, t = np.divmod(np.arange(count) / _STEP, 1.0)
    weights = np.zeros((count, nodes))
    four = [
        -t * (t - 1) * (t - 2) / 6,
        (t + 1) * (t - 1) * (t - 2) / 2,
        -(t + 1) * t * (t - 2) / 2,
        (t + 1) * t * (t - 1) / 6,
    ]
    for k, value in enumerate(four):
        weights[np.arange(count), cell.astype(int) + k] = value
    return weights


def distort(camera: CameraModel, ideal_px: Float) -> Float:
    """Raw pixels of ideal ones, shape (..., 2); NaN outside the field where the lens model is valid.

    Raises:
        SurecutError: the distortion model is unknown or its coefficients do not fit it.
    """
    ideal = np.asarray(ideal_px, float)
    lens = _lens(camera.distortion_model, tuple(map(float, camera.D)), camera.name)
    if lens is None:
        return ideal.copy()
    points = _normalised(camera, ideal.reshape(-1, 2))
    distorted = _forward(lens, points)[0]
    distorted[np.hypot(points[:, 0], points[:, 1]) >= lens.radius_limit] = np.nan
    return _pixels(camera, distorted).reshape(ideal.shape)


def distortion_jacobian(camera: CameraModel, ideal_px: Float) -> Float:
    """d raw / d ideal in pixels, shape (n, 2, 2), at ideal pixels of shape (n, 2)."""
    points = np.asarray(ideal_px, float).reshape(-1, 2)
    lens = _lens(camera.distortion_model, tuple(map(float, camera.D)), camera.name)
    if lens is None:
        return np.broadcast_to(np.eye(2), (len(points), 2, 2)).copy()
    scale = camera.K[:2, :2]
    return scale @ _forward(lens, _normalised(camera, points))[1] @ np.linalg.inv(scale)


def _normalised(camera: CameraModel, px: Float) -> Float:
    homogeneous = np.column_stack([px, np.ones(len(px))])
    return (homogeneous @ np.linalg.inv(camera.K).T)[:, :2]


def _pixels(camera: CameraModel, points: Float) -> Float:
    return points @ camera.K[:2, :2].T + camera.K[:2, 2]


@lru_cache(maxsize=64)
def _lens(model: str, D: tuple[float, ...], name: str) -> _Lens | None:
    """The lens of a model name and its coefficients; None where there is nothing to undo."""
    if model not in ("none", "", "plumb_bob", "rational_polynomial", "equidistant", "fisheye"):
        known = "none, plumb_bob, rational_polynomial, equidistant"
        raise SurecutError(f"camera {name}: distortion model {model!r} is not known; known are {known}")
    if model in ("none", "") or not any(D):
        if model not in ("equidistant", "fisheye"):
            return None
    fisheye = model in ("equidistant", "fisheye")
    lengths = {"plumb_bob": (4, 5), "rational_polynomial": (4, 5, 8, 12)}.get(model, (4,))
    trimmed = D[:12] if len(D) > 12 and not any(D[12:]) else D
    if model == "plumb_bob" and len(D) > 5 and not any(D[5:]):
        trimmed = D[:5]
    if fisheye and not D:
        trimmed = (0.0,) * 4
    if len(trimmed) not in lengths or not np.isfinite(trimmed).all():
        raise SurecutError(
            f"camera {name}: {model} with {len(D)} coefficients {list(D)}; it takes {lengths[-1]} numbers"
        )
    if fisheye:
        return _with_limits(True, trimmed, (), (0.0, 0.0), (0.0, 0.0, 0.0, 0.0))
    k = (*trimmed, *([0.0] * (12 - len(trimmed))))
    return _with_limits(False, (k[0], k[1], k[4]), (k[5], k[6], k[7]), (k[2], k[3]), (k[8], k[9], k[10], k[11]))


def _with_limits(
    fisheye: bool,
    numerator: tuple[float, ...],
    denominator: tuple[float, ...],
    tangential: tuple[float, float],
    prism: tuple[float, float, float, float],
) -> _Lens:
    lens = _Lens(fisheye, numerator, denominator, tangential, prism, np.inf, np.inf)
    angle = np.linspace(0.0, _WIDEST_RAD, 4000)[1:]
    radius = np.tan(angle)
    distorted = _radial(lens, radius)[0]
    rising = (np.diff(distorted) > 0) & (distorted[1:] > 0)
    last = len(rising) if rising.all() else int(np.argmin(rising))
    return _Lens(fisheye, numerator, denominator, tangential, prism, float(radius[last]), float(distorted[last]))


def _polynomial(coefficients: tuple[float, ...], square: Float) -> tuple[Float, Float]:
    """1 + c0 s + c1 s^2 + ..., and its derivative by s."""
    full = np.array([1.0, *coefficients])
    derivative = full[1:] * np.arange(1, len(full)) if len(full) > 1 else np.zeros(1)
    value, slope = np.zeros_like(square), np.zeros_like(square)
    for coefficient in full[::-1]:
        value = value * square + coefficient
    for coefficient in derivative[::-1]:
        slope = slope * square + coefficient
    return value, slope


def _radial(lens: _Lens, radius: Float) -> tuple[Float, Float]:
    """Distorted radius of an ideal one, and its derivative."""
    if lens.fisheye:
        angle = np.arctan(radius)
        value, slope = _polynomial(lens.numerator, angle**2)
        return angle * value, (value + 2 * angle**2 * slope) / (1 + radius**2)
    top, top_slope = _polynomial(lens.numerator, radius**2)
    bottom, bottom_slope = _polynomial(lens.denominator, radius**2)
    factor = top / bottom
    slope = (top_slope - factor * bottom_slope) / bottom
    return radius * factor, factor + 2 * radius**2 * slope


def _forward(lens: _Lens, points: Float) -> tuple[Float, Float]:
    """Distorted points (n, 2) and the Jacobian (n, 2, 2)."""
    x, y = points[:, 0], points[:, 1]
    square = x**2 + y**2
    radius = np.sqrt(square)
    distorted, slope = _radial(lens, radius)
    safe = np.maximum(radius, 1e-12)
    factor = np.where(radius > 1e-9, distorted / safe, 1.0)
    bend = np.where(radius > 1e-9, (slope - factor) / safe**2, 0.0)
    (p1, p2), (s1, s2, s3, s4) = lens.tangential, lens.prism
    out = np.empty_like(points)
    out[:, 0] = x * factor + 2 * p1 * x * y + p2 * (square + 2 * x**2) + s1 * square + s2 * square**2
    out[:, 1] = y * factor + p1 * (square + 2 * y**2) + 2 * p2 * x * y + s3 * square + s4 * square**2
    jacobian = np.empty((len(points), 2, 2))
    jacobian[:, 0, 0] = factor + bend * x**2 + 2 * p1 * y + 6 * p2 * x + 2 * x * (s1 + 2 * s2 * square)
    jacobian[:, 0, 1] = bend * x * y + 2 * p1 * x + 2 * p2 * y + 2 * y * (s1 + 2 * s2 * square)
    jacobian[:, 1, 0] = bend * x * y + 2 * p1 * x + 2 * p2 * y + 2 * x * (s3 + 2 * s4 * square)
    jacobian[:, 1, 1] = factor + bend * y**2 + 6 * p1 * y + 2 * p2 * x + 2 * y * (s3 + 2 * s4 * square)
    return out, jacobian


def _checked(jacobian: Float) -> Float:
    """Jacobians with the singular ones replaced by NaN, so that their inverse is NaN and no error."""
    determinant = jacobian[:, 0, 0] * jacobian[:, 1, 1] - jacobian[:, 0, 1] * jacobian[:, 1, 0]
    return np.where((np.abs(determinant) > 1e-12)[:, None, None], jacobian, np.nan)


def _solved_by(jacobian: Float, right: Float) -> Float:
    """2x2 systems (n, 2, 2) and (n, 2), written out: a hundred times faster than a general solver on a whole image."""
    (a, b), (c, d) = (jacobian[:, 0, 0], jacobian[:, 0, 1]), (jacobian[:, 1, 0], jacobian[:, 1, 1])
    over = 1.0 / (a * d - b * c)
    return np.stack([(d * right[:, 0] - b * right[:, 1]) * over, (a * right[:, 1] - c * right[:, 0]) * over], -1)


def _inverse(lens: _Lens, distorted: Float) -> Float:
    """Ideal points of distorted ones: a start from the radial curve, then Newton on both coordinates."""
    radius = np.hypot(distorted[:, 0], distorted[:, 1])
    grid = np.tan(np.linspace(0.0, np.arctan(lens.radius_limit), 2000))
    curve = _radial(lens, grid)[0]
    start = np.interp(radius, curve, grid)
    ratio = np.divide(start, radius, out=np.ones_like(radius), where=radius > 1e-9)
    points = distorted * ratio[:, None]
    points[~np.isfinite(distorted).all(1)] = 0.0
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(_NEWTON_STEPS):
            value, jacobian = _forward(lens, points)
            step = _solved_by(_checked(jacobian), distorted - value)
            points = points + np.nan_to_num(step)
            if not np.nanmax(np.abs(step), initial=0.0) > _SOLVED / 10:
                break
        remainder = np.abs(_forward(lens, points)[0] - distorted).max(1)
    inside = np.hypot(points[:, 0], points[:, 1]) < lens.radius_limit
    points[~((remainder < _SOLVED) & inside & (radius < lens.distorted_limit * 1.2))] = np.nan
    return points
