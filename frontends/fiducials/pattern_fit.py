"""Marker corners from the whole printed pattern: the eight corner coordinates that explain the pixels best.

The printed pattern is known once a marker has been read, so the image of a marker is known up to where its corners are,
how much the lens and the motion blur it, and how it is lit. Gauss-Newton finds all of these together. Nothing pulls
corners inwards: the blurred step is part of the model, and the edges inside the pattern help those of the border.
Pixels, not interpolated samples, are compared, so the residuals are the noise and give the covariance.

Model, at a pixel p with marker coordinates (a, b) = H^-1 p in the unit square:

    I(p) = (1, a, b) . o + T(a, b) (1, a, b) . g,      T = 1 + sum_kl Phi(k; a) D[k, l] Phi(l; b)

with D the second difference of the pattern (cells outside are white), Phi the normal distribution function across the
edge line k at the blur's width there, and a first-order term for grid lines that are not at right angles in the image.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

Float = NDArray[np.float64]

_UNIT = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
_MAX_PIXELS = 700
"""Pixels per marker; more cost time and give nothing that the model's own error does not swamp."""
_REACH_PX = 3.0
"""Pixels farther than this from every grid line say nothing about the corners."""
_MARGIN_CELLS = 0.9
"""How far outside the border the page is taken to be white."""
_BLUR_RANGE_PX = (0.25, 4.0)
_INV_SQRT_2PI = 1.0 / np.sqrt(2.0 * np.pi)


@dataclass(frozen=True, slots=True)
class PatternFit:
    """Fits of m markers in one image."""

    corners: Float
    """Shape (m, 4, 2), in the coordinates of the pixel positions that were given (ideal pixels)."""
    covariance: Float
    """Shape (m, 8, 8), of (x0, y0, x1, y1, ...)."""
    blur_px: Float
    """Shape (m,)."""
    contrast: Float
    """Shape (m,), white minus black in grey values; negative or small where there is no such marker."""
    residual: Float
    """Shape (m,), rms of the residuals in grey values, robust."""
    correlation: Float
    """Shape (m,), of the pixels with the model."""
    noise_factor: Float
    """Shape (m,), how much residuals that hang together raise the variance over white noise of the same size."""


@dataclass(frozen=True, slots=True)
class _Pixels:
    """Chosen pixels, m markers by n pixels, padded with weight 0."""

    xy: Float
    value: Float
    weight: Float
    block: NDArray[np.int64]
    """Which small block of the image a pixel is in."""


def homography(corners: Float) -> Float:
    """Shape (m, 3, 3): from the unit square (corner order 0..3) to corners of shape (m, 4, 2)."""
    p0, p1, p2, p3 = (corners[:, k] for k in range(4))
    d1, d2, s = p1 - p2, p3 - p2, p0 - p1 + p2 - p3
    det = d1[:, 0] * d2[:, 1] - d2[:, 0] * d1[:, 1]
    g = (s[:, 0] * d2[:, 1] - d2[:, 0] * s[:, 1]) / det
    h = (d1[:, 0] * s[:, 1] - s[:, 0] * d1[:, 1]) / det
    result = np.empty((len(corners), 3, 3))
    result[:, :2, 0] = p1 - p0 + g[:, None] * p1
    result[:, :2, 1] = p3 - p0 + h[:, None] * p3
    result[:, :2, 2] = p0
    result[:, 2, 0], result[:, 2, 1], result[:, 2, 2] = g, h, 1.0
    return result


def _corner_basis(H: Float) -> Float:
    """Shape (m, 8, 8): change of the homography's first eight entries by the eight corner coordinates."""
    m = len(H)
    A = np.zeros((m, 8, 8))
    for k, (a, b) in enumerate(_UNIT):
        q = H @ np.array([a, b, 1.0])
        x = q[:, :2] / q[:, 2:]
        for axis in range(2):
            A[:, 2 * k + axis, 3 * axis : 3 * axis + 3] = np.array([a, b, 1.0]) / q[:, 2:]
            A[:, 2 * k + axis, 6:] = -x[:, axis : axis + 1] * np.array([a, b]) / q[:, 2:]
    return np.linalg.inv(A)


def _marker_coordinates(H: Float, xy: Float) -> tuple[Float, Float, Float, Float]:
    """a, b and their gradients by the pixel (shape (m, n, 2)) of pixel positions (m, n, 2)."""
    inverse = np.linalg.inv(H)
    r = xy @ inverse[:, :, :2].transpose(0, 2, 1) + inverse[:, None, :, 2]
    over = 1.0 / r[..., 2]
    a, b = r[..., 0] * over, r[..., 1] * over
    grad_a = (inverse[:, None, 0, :2] - a[..., None] * inverse[:, None, 2, :2]) * over[..., None]
    grad_b = (inverse[:, None, 1, :2] - b[..., None] * inverse[:, None, 2, :2]) * over[..., None]
    return a, b, grad_a, grad_b


def _second_difference(pattern: Float) -> Float:
    extended = np.pad(pattern, 1, constant_values=1.0)
    return np.diff(np.diff(extended, axis=0), axis=1)


def _reflectance(H: Float, xy: Float, blur: Float, D: Float, lines: Float) -> tuple[Float, Float, Float, Float, Float]:
    """T, its gradient by the pixel (x, y), its derivative by the blur; and (a, b)."""
    a, b, grad_a, grad_b = _marker_coordinates(H, xy)
    length_a, length_b = np.linalg.norm(grad_a, axis=-1), np.linalg.norm(grad_b, axis=-1)
    width_a, width_b = length_a * blur[:, None], length_b * blur[:, None]
    ta = (a[..., None] - lines[:, None, :]) / width_a[..., None]
    tb = (b[..., None] - lines[:, None, :]) / width_b[..., None]
    fa, fb = ndtr(ta), ndtr(tb)
    na, nb = np.exp(-0.5 * ta * ta) * _INV_SQRT_2PI, np.exp(-0.5 * tb * tb) * _INV_SQRT_2PI
    fa_D, na_D = fa @ D, na @ D
    skew = np.sum(grad_a * grad_b, -1) / (length_a * length_b)
    both = np.einsum("mnk,mnk->mn", na_D, nb)
    T = 1.0 + np.einsum("mnk,mnk->mn", fa_D, fb) + skew * both
    by_a = np.einsum("mnk,mnk->mn", na_D, fb) / width_a
    by_b = np.einsum("mnk,mnk->mn", fa_D, nb) / width_b
    gradient = by_a[..., None] * grad_a + by_b[..., None] * grad_b
    by_blur = -(np.einsum("mnk,mnk->mn", (na * ta) @ D, fb) + np.einsum("mnk,mnk->mn", fa_D, nb * tb)) / blur[:, None]
    return T, gradient, by_blur, a, b


def _choose_pixels(
    image: NDArray[np.uint8], positions: Float | None, corners: Float, cells: NDArray[np.int64]
) -> _Pixels:
    """Pixels near the grid lines of each marker, at most `_MAX_PIXELS`, spread evenly.

    `positions` holds the ideal pixel of each image pixel, shape (height, width, 2); None where they are the same, in
    which case corners are image pixels.
    """
    height, width = image.shape
    H = homography(corners)
    chosen = []
    for k in range(len(corners)):
        chosen.append(_near_lines(corners[k], H[k], int(cells[k]), width, height, positions))
    n = max((len(c) for c in chosen), default=0)
    m = len(corners)
    xy, value, weight = np.zeros((m, n, 2)), np.zeros((m, n)), np.zeros((m, n))
    block = np.zeros((m, n), np.int64)
    for k, index in enumerate(chosen):
        rows, columns = np.divmod(index, width)
        count = len(index)
        here = np.column_stack([columns, rows]) if positions is None else positions[rows, columns]
        xy[k, :count], value[k, :count], weight[k, :count] = here, image[rows, columns], 1.0
        xy[k, count:] = corners[k].mean(0)
        block[k, :count] = (rows // 3) * width + columns // 3
    return _Pixels(xy, value, weight, block)


def _near_lines(
    corners: Float, H: Float, cells: int, width: int, height: int, positions: Float | None
) -> NDArray[np.int64]:
    """Flat indices of the pixels of one marker."""
    side = max(np.linalg.norm(corners[2] - corners[0]), np.linalg.norm(corners[3] - corners[1]))
    grow = side / cells + 2.0
    low, high = corners.min(0) - grow, corners.max(0) + grow
    x0, y0 = max(int(low[0]), 0), max(int(low[1]), 0)
    x1, y1 = min(int(high[0]) + 1, width), min(int(high[1]) + 1, height)
    if positions is not None:
        x0, y0, x1, y1 = _raw_window(positions, low, high)
    if x1 - x0 < 4 or y1 - y0 < 4:
        return np.zeros(0, np.int64)
    # Large markers: a lattice of every other diagonal is dense enough to choose from.
    step = max(1, int(np.sqrt((x1 - x0) * (y1 - y0) / 6000.0)))
    rows, columns = np.mgrid[y0:y1, x0:x1]
    keep = (rows + 3 * columns) % (step * step) == 0 if step > 1 else np.ones_like(rows, bool)
    index = (rows * width + columns)[keep]
    rows, columns = np.divmod(index, width)
    xy = np.column_stack([columns, rows]).astype(float) if positions is None else positions[rows, columns]
    inverse = np.linalg.inv(H)
    r = xy @ inverse[:, :2].T + inverse[:, 2]
    ab = r[:, :2] / r[:, 2:] * cells
    margin = _MARGIN_CELLS
    inside = (r[:, 2] > 0) & (ab > -margin).all(1) & (ab < cells + margin).all(1)
    cell_px = side / (np.sqrt(2.0) * cells)
    to_line = np.abs(ab - np.rint(ab)).min(1) * cell_px
    index = index[inside & (to_line < _REACH_PX)]
    if len(index) > _MAX_PIXELS:
        scatter = (index * 2654435761) % 4294967296
        index = index[np.argpartition(scatter, _MAX_PIXELS)[:_MAX_PIXELS]]
    return index


def _raw_window(positions: Float, low: Float, high: Float) -> tuple[int, int, int, int]:
    with np.errstate(invalid="ignore"):
        inside = ((positions > low) & (positions < high)).all(-1)
    rows, columns = np.flatnonzero(inside.any(1)), np.flatnonzero(inside.any(0))
    if not len(rows):
        return 0, 0, 0, 0
    return int(columns[0]), int(rows[0]), int(columns[-1]) + 1, int(rows[-1]) + 1


def fit_patterns(
    image: NDArray[np.uint8],
    corners: Float,
    patterns: list[Float],
    positions: Float | None = None,
    steps: int = 5,
    blur_px: float = 1.2,
) -> PatternFit:
    """Corners of m markers with one pattern size, from near ones.

    Args:
        image: grey, shape (height, width).
        corners: shape (m, 4, 2), within about one cell of the truth, in ideal pixels, order 0..3.
        patterns: m arrays (cells, cells), see `MarkerDictionary.pattern`.
        positions: the ideal pixel of each image pixel, shape (height, width, 2), NaN beyond the lens model; None where
            the lens does not distort.
        steps: Gauss-Newton steps.
        blur_px: blur to start from.
    """
    m = len(corners)
    cells = np.array([len(p) for p in patterns])
    D = np.stack([_second_difference(p) for p in patterns])
    lines = np.arange(cells[0] + 1) / cells[0] * np.ones((m, 1))
    pixels = _choose_pixels(image, positions, corners, cells)
    blur = np.full(m, blur_px)
    state = _State(corners.copy(), blur, pixels.weight)
    limit = np.linalg.norm(corners[:, 2] - corners[:, 0], axis=1) / (np.sqrt(2.0) * cells)
    solved = None
    for step in range(steps):
        solved = _solve(state, pixels, D, lines)
        move = solved.step[:, :8].reshape(m, 4, 2)
        largest = np.abs(move).max((1, 2))
        shrink = np.minimum(1.0, limit / np.maximum(largest, 1e-9))
        weight = pixels.weight if step < 1 else pixels.weight * _softened(solved.residual, solved.scale)
        state = _State(
            state.corners + move * shrink[:, None, None],
            np.clip(state.blur + np.clip(solved.step[:, 8], -0.5, 0.5), *_BLUR_RANGE_PX),
            weight,
        )
        if step > 1 and largest.max() < 0.003:
            break
    assert solved is not None
    return _summary(state, solved, pixels)


@dataclass(frozen=True, slots=True)
class _State:
    corners: Float
    blur: Float
    weight: Float


@dataclass(frozen=True, slots=True)
class _Solved:
    step: Float
    inverse: Float
    residual: Float
    scale: Float
    jacobian: Float
    light: Float
    correlation: Float


def _solve(state: _State, pixels: _Pixels, D: Float, lines: Float) -> _Solved:
    """One Gauss-Newton step: light first (linear), then everything together."""
    H = homography(state.corners)
    T, gradient, by_blur, a, b = _reflectance(H, pixels.xy, state.blur, D, lines)
    ones = np.ones_like(T)
    light_columns = np.stack([ones, T, a - 0.5, b - 0.5, T * (a - 0.5), T * (b - 0.5)], -1)
    light = _least_squares(light_columns, pixels.value, state.weight)[0]
    residual = pixels.value - np.einsum("mnk,mk->mn", light_columns, light)
    gain = light[:, 1, None] + light[:, 4, None] * (a - 0.5) + light[:, 5, None] * (b - 0.5)
    basis = _corner_basis(H)
    q = a * H[:, None, 2, 0] + b * H[:, None, 2, 1] + H[:, None, 2, 2]
    gx, gy = -gain * gradient[..., 0] / q, -gain * gradient[..., 1] / q
    along = -(gx * pixels.xy[..., 0] + gy * pixels.xy[..., 1])
    by_H = np.stack([gx * a, gx * b, gx, gy * a, gy * b, gy, along * a, along * b], -1)
    by_corners = by_H @ basis
    columns = np.concatenate([by_corners, (gain * by_blur)[..., None], light_columns], -1)
    step, inverse = _least_squares(columns, residual, state.weight)
    after = residual - np.einsum("mnk,mk->mn", columns, step)
    scale = _robust_scale(after, pixels.weight)
    correlation = _correlation(pixels.value, residual, state.weight)
    return _Solved(step, inverse, after, scale, by_corners, light, correlation)


def _least_squares(columns: Float, value: Float, weight: Float) -> tuple[Float, Float]:
    """Weighted solutions (m, k) and the inverse normal matrices (m, k, k), with columns scaled to be safe."""
    norm = np.sqrt(np.einsum("mnk,mn->mk", columns**2, weight)) + 1e-9
    scaled = columns / norm[:, None, :]
    weighted = scaled * weight[..., None]
    normal = weighted.transpose(0, 2, 1) @ scaled
    normal += 1e-9 * np.eye(normal.shape[-1])
    inverse = np.linalg.inv(normal)
    right = np.einsum("mnk,mn->mk", weighted, value)
    solution = np.einsum("mkl,ml->mk", inverse, right) / norm
    return solution, inverse / (norm[:, :, None] * norm[:, None, :])


def _robust_scale(residual: Float, weight: Float) -> Float:
    """Standard deviation by the median of the absolute residuals, shape (m,)."""
    masked = np.where(weight > 0, np.abs(residual), np.nan)
    with np.errstate(all="ignore"):
        return 1.4826 * np.nan_to_num(np.nanmedian(masked, axis=1)) + 0.3


def _softened(residual: Float, scale: Float) -> Float:
    """Tukey-like weights: whole up to 2.5 sigma, nothing beyond 6."""
    t = np.abs(residual) / scale[:, None]
    return np.clip((6.0 - t) / 3.5, 0.0, 1.0)


def _correlation(value: Float, residual: Float, weight: Float) -> Float:
    total = np.maximum(weight.sum(1), 1e-9)
    mean = (value * weight).sum(1) / total
    spread = ((value - mean[:, None]) ** 2 * weight).sum(1)
    left = (residual**2 * weight).sum(1)
    return np.sqrt(np.clip(1.0 - left / np.maximum(spread, 1e-9), 0.0, 1.0))


def _summary(state: _State, solved: _Solved, pixels: _Pixels) -> PatternFit:
    weight = state.weight
    freedom = np.maximum(weight.sum(1) - 15.0, 1.0)
    variance = (solved.residual**2 * weight).sum(1) / freedom
    factor = _hang_together(solved, pixels, weight)
    covariance = solved.inverse[:, :8, :8] * (variance * factor)[:, None, None]
    return PatternFit(
        state.corners,
        covariance,
        state.blur,
        solved.light[:, 1],
        np.sqrt(variance),
        solved.correlation,
        factor,
    )


def _hang_together(solved: _Solved, pixels: _Pixels, weight: Float) -> Float:
    """Variance of the sums of residuals over small blocks against that of independent ones, at least 1."""
    factors = np.ones(len(weight))
    for k in range(len(weight)):
        used = weight[k] > 0
        if used.sum() < 30:
            continue
        score = solved.residual[k, used][:, None] * weight[k, used][:, None] * solved.jacobian[k, used]
        _, place = np.unique(pixels.block[k, used], return_inverse=True)
        sums = np.zeros((place.max() + 1, 8))
        np.add.at(sums, place, score)
        factors[k] = max(1.0, float((sums**2).sum() / max((score**2).sum(), 1e-12)))
    return factors
