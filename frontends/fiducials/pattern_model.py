"""The image of a printed pattern, blurred, and its derivatives.

Model, at a pixel p with marker coordinates (a, b) = H^-1 p in the unit square:

    I(p) = (1, a, b) . o + T(a, b) (1, a, b) . g,      T = 1 + sum_kl Phi(k; a) D[k, l] Phi(l; b)

with D the second difference of the pattern (cells outside are white), Phi the normal distribution function across the
edge line k at the blur's width there, and a first-order term for grid lines that are not at right angles in the image.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

# NumPy's own annotations widen every sum and product: double and single precision are told apart for the reader
Float = NDArray[Any]
Single = NDArray[Any]

UNIT = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
_INV_SQRT_2PI = np.float32(1.0 / np.sqrt(2.0 * np.pi))
_TANH_1 = np.float32(np.sqrt(2.0 / np.pi))
_TANH_3 = np.float32(np.sqrt(2.0 / np.pi) * 0.044715)


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


def corner_basis(H: Float) -> Float:
    """Shape (m, 8, 8): change of the homography's first eight entries by the eight corner coordinates."""
    unit = np.column_stack([UNIT, np.ones(4)])
    q = unit @ H.transpose(0, 2, 1)
    x = q[..., :2] / q[..., 2:]
    row = unit / q[..., 2:]
    A = np.zeros((len(H), 4, 2, 8))
    A[:, :, 0, 0:3] = row
    A[:, :, 1, 3:6] = row
    A[:, :, :, 6:] = -x[..., None] * row[:, :, None, :2]
    return np.linalg.inv(A.reshape(-1, 8, 8))


def _marker_coordinates(H: Float, xy: Single) -> tuple[Single, Single, Single, Single]:
    """a, b and their gradients by the pixel (shape (m, n, 2)) of pixel positions (m, n, 2)."""
    inverse = np.linalg.inv(H).astype(np.float32)
    r = xy @ inverse[:, :, :2].transpose(0, 2, 1) + inverse[:, None, :, 2]
    over = 1.0 / r[..., 2]
    a, b = r[..., 0] * over, r[..., 1] * over
    grad_a = (inverse[:, None, 0, :2] - a[..., None] * inverse[:, None, 2, :2]) * over[..., None]
    grad_b = (inverse[:, None, 1, :2] - b[..., None] * inverse[:, None, 2, :2]) * over[..., None]
    return a, b, grad_a, grad_b


@lru_cache(maxsize=4096)
def second_difference(pattern: bytes, cells: int) -> Single:
    """Of the pattern with the white page round it, for the grid lines from one cell outside to one cell outside."""
    extended = np.pad(np.frombuffer(pattern).reshape(cells, cells), 2, constant_values=1.0)
    return np.diff(np.diff(extended, axis=0), axis=1).astype(np.float32)


@dataclass(frozen=True, slots=True)
class PatternModel:
    """The reflectance at m by n pixels and its derivatives."""

    a: Single
    b: Single
    T: Single
    gradient: Single
    """By the pixel, shape (m, n, 2)."""
    by_blur: Single
    """By the blur's variances xx, yy and covariance xy in the image, shape (m, n, 3)."""
    surround: Single
    """How much of what each pixel sees lies more than a cell outside: left, right, below, above; shape (m, n, 4)."""
    slopes: tuple[Single, Single]
    """Across the grid lines of constant a, and of b, what the pattern changes by there; shapes (m, n, k)."""
    crossed: tuple[Single, Single]
    """What the other coordinate's lines make of each of them; shapes (m, n, k)."""
    across: tuple[Single, Single]
    """By a shift of one pixel; shapes (m, n)."""

    def by_lines(self) -> tuple[Single, Single]:
        """By a shift of each grid line across itself, in pixels: of those of constant a, then of b; (m, n, k) each."""
        of_a, of_b = (s * c * x[..., None] for s, c, x in zip(self.slopes, self.crossed, self.across, strict=True))
        return of_a, of_b


def pattern_model(H: Float, xy: Single, blur: Float, D: Single, lines: Single) -> PatternModel:
    """The blurred pattern. Blurring is diffusion: the derivative by a variance is half the second one by place."""
    a, b, grad_a, grad_b = _marker_coordinates(H, xy)
    blurred_a, blurred_b = _smeared(blur, grad_a), _smeared(blur, grad_b)
    over_a = 1.0 / np.sqrt(np.einsum("mni,mni->mn", grad_a, blurred_a))
    over_b = 1.0 / np.sqrt(np.einsum("mni,mni->mn", grad_b, blurred_b))
    skew = np.einsum("mni,mni->mn", grad_a, blurred_b) * over_a * over_b
    ta, fa, na = _steps(a, lines, over_a)
    tb, fb, nb = _steps(b, lines, over_b)
    nta, ntb = na * ta, nb * tb
    fa_D, na_D, nta_D, fb_D = fa @ D, na @ D, nta @ D, fb @ D.transpose(0, 2, 1)
    both = _dot(na_D, nb)
    T = 1.0 + _dot(fa_D, fb) + skew * both + (0.5 * skew * skew) * _dot(nta_D, ntb)
    by_a = (_dot(na_D, fb) - skew * _dot(nta_D, nb)) * over_a
    by_b = (_dot(fa_D, nb) - skew * _dot(na_D, ntb)) * over_b
    gradient = by_a[..., None] * grad_a + by_b[..., None] * grad_b
    aa, bb, ab = -_dot(nta_D, fb) * over_a**2, -_dot(fa_D, ntb) * over_b**2, both * over_a * over_b
    x_a, y_a, x_b, y_b = grad_a[..., 0], grad_a[..., 1], grad_b[..., 0], grad_b[..., 1]
    by_blur = np.empty((*T.shape, 3), np.float32)
    by_blur[..., 0] = 0.5 * (aa * x_a**2 + bb * x_b**2) + ab * x_a * x_b
    by_blur[..., 1] = 0.5 * (aa * y_a**2 + bb * y_b**2) + ab * y_a * y_b
    by_blur[..., 2] = aa * x_a * y_a + bb * x_b * y_b + ab * (x_a * y_b + x_b * y_a)
    surround = np.stack([1.0 - fa[..., 0], fa[..., -1], 1.0 - fb[..., 0], fb[..., -1]], -1)
    across = -over_a * _length(grad_a), -over_b * _length(grad_b)
    return PatternModel(a, b, T, gradient, by_blur, surround, (na, nb), (fb_D, fa_D), across)


def _length(vectors: Single) -> Single:
    return np.sqrt(np.einsum("mni,mni->mn", vectors, vectors))


def _smeared(blur: Float, gradient: Single) -> Single:
    """The blur's covariance (xx, yy, xy) times gradients."""
    xx, yy, xy = (blur[:, k, None].astype(np.float32) for k in range(3))
    x, y = gradient[..., 0], gradient[..., 1]
    return np.stack([xx * x + xy * y, xy * x + yy * y], -1)


def _dot(left: Single, right: Single) -> Single:
    return np.einsum("mnk,mnk->mn", left, right)


def _steps(place: Single, lines: Single, over_width: Single) -> tuple[Single, Single, Single]:
    """Distance to each grid line in blurs, the blurred step there and its slope, shape (m, n, k).

    The normal distribution function by a hyperbolic tangent: odd as it must be, wrong by 3e-4 at most, four times as
    fast.
    """
    t = (place[..., None] - lines) * over_width[..., None]
    t = np.clip(t, -6.0, 6.0)
    square = t * t
    step = 0.5 + 0.5 * np.tanh(t * (_TANH_1 + _TANH_3 * square))
    return t, step, _INV_SQRT_2PI * np.exp(-0.5 * square)
