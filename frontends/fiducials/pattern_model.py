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


def _marker_coordinates(H: Float, xy: Single) -> tuple[Single, Single]:
    """(a, b) of pixel positions, shapes (m, 2, n), and their gradients by the pixel, shape (m, 2, 2, n)."""
    inverse = np.linalg.inv(H).astype(np.float32)
    r = inverse[:, :, :2] @ xy
    r += inverse[:, :, 2:]
    over = 1.0 / r[:, 2:]
    ab = r[:, :2] * over
    gradient = inverse[:, :2, :2, None] - ab[:, :, None] * inverse[:, None, 2, :2, None]
    gradient *= over[:, None]
    return ab, gradient


@lru_cache(maxsize=4096)
def second_difference(pattern: bytes, cells: int) -> Single:
    """Of the pattern with the white page round it, for the grid lines from one cell outside to one cell outside."""
    extended = np.pad(np.frombuffer(pattern).reshape(cells, cells), 2, constant_values=1.0)
    return np.diff(np.diff(extended, axis=0), axis=1).astype(np.float32)


@dataclass(frozen=True, slots=True)
class PatternModel:
    """The reflectance at m by n pixels and its derivatives. Pixels come last, so that sums run along memory."""

    ab: Single
    """Place in the marker, shape (m, 2, n)."""
    T: Single
    gradient: Single
    """By the pixel, shape (m, 2, n)."""
    by_blur: Single
    """By the blur's variances xx, yy and covariance xy in the image, shape (m, 3, n)."""
    surround: Single
    """How much of what each pixel sees lies more than a cell outside: left, right, below, above; shape (m, 4, n)."""
    steps: Single
    """Blurred steps at the grid lines, shape (m, 2, k, n)."""
    slopes: Single
    """Their slopes, likewise."""
    across: Single
    """Of those by a shift of one pixel; shape (m, 2, n)."""
    D: Single

    def by_lines(self) -> Single:
        """By a shift of each grid line across itself, in pixels: of those of constant a, then of b; (m, 2, k, n)."""
        crossed = np.empty_like(self.steps)
        np.matmul(self.D, self.steps[:, 1], out=crossed[:, 0])
        np.matmul(self.D.transpose(0, 2, 1), self.steps[:, 0], out=crossed[:, 1])
        crossed *= self.slopes
        crossed *= self.across[:, :, None]
        return crossed


def pattern_model(H: Float, xy: Single, blur: Float, D: Single, lines: Single) -> PatternModel:
    """The blurred pattern at pixels xy, shape (m, 2, n).

    Blurring is diffusion: the derivative by a variance is half the second one by place.
    """
    ab, grad = _marker_coordinates(H, xy)
    blurred = blur[:, [[0, 2], [2, 1]]].astype(np.float32)[:, None] @ grad
    over = 1.0 / np.sqrt(np.einsum("maxn,maxn->man", grad, blurred))
    skew = np.einsum("mxn,mxn->mn", grad[:, 0], blurred[:, 1]) * over[:, 0] * over[:, 1]
    F = _steps(ab, lines, over)
    # sums over all grid lines of either axis, weighed by the pattern: p[i][j] of the i-th derivatives across a, j-th b
    left = D.transpose(0, 2, 1)[:, None] @ F[:, 0]
    p = np.einsum("mikn,mjkn->ijmn", left, F[:, 1])
    T = p[0, 0] + skew * (p[1, 1] + (0.5 * skew) * p[2, 2])
    T += 1.0
    by_a = (p[1, 0] - skew * p[2, 1]) * over[:, 0]
    by_b = (p[0, 1] - skew * p[1, 2]) * over[:, 1]
    gradient = by_a[:, None] * grad[:, 0] + by_b[:, None] * grad[:, 1]
    by_blur = _by_blur(grad, -p[2, 0] * over[:, 0] ** 2, -p[0, 2] * over[:, 1] ** 2, p[1, 1] * over[:, 0] * over[:, 1])
    surround = F[:, :, 0, [0, -1]].reshape(len(H), 4, -1)
    surround[:, ::2] = 1.0 - surround[:, ::2]
    across = -over * np.sqrt(np.einsum("maxn,maxn->man", grad, grad))
    return PatternModel(ab, T, gradient, by_blur, surround, F[:, :, 0], F[:, :, 1], across, D)


def _by_blur(grad: Single, aa: Single, bb: Single, ab: Single) -> Single:
    """By the variances in the image, from the second derivatives in the marker; shape (m, 3, n)."""
    x_a, y_a, x_b, y_b = grad[:, 0, 0], grad[:, 0, 1], grad[:, 1, 0], grad[:, 1, 1]
    ax, ay, bx, by = aa * x_a, aa * y_a, bb * x_b, bb * y_b
    result = np.empty((len(grad), 3, grad.shape[-1]), np.float32)
    result[:, 0] = 0.5 * (ax * x_a + bx * x_b) + ab * x_a * x_b
    result[:, 1] = 0.5 * (ay * y_a + by * y_b) + ab * y_a * y_b
    result[:, 2] = ax * y_a + bx * y_b + ab * (x_a * y_b + x_b * y_a)
    return result


def _steps(place: Single, lines: Single, over_width: Single) -> Single:
    """The blurred step at each grid line, its slope s, and t s with t the distance in blurs.

    The normal distribution function by a hyperbolic tangent: odd as it must be, wrong by 3e-4 at most, four times as
    fast.

    Args:
        place: shape (m, 2, n).
        lines: shape (k,).
        over_width: shape (m, 2, n).

    Returns:
        Shape (m, 2, 3, k, n).
    """
    m, _, n = place.shape
    t = place[:, :, None] - lines[:, None]
    t *= over_width[:, :, None]
    np.clip(t, -6.0, 6.0, out=t)
    square = t * t
    result = np.empty((m, 2, 3, len(lines), n), np.float32)
    bent = _TANH_3 * square
    bent += _TANH_1
    bent *= t
    np.tanh(bent, out=bent)
    bent *= 0.5
    np.add(bent, 0.5, out=result[:, :, 0])
    square *= -0.5
    np.exp(square, out=square)
    square *= _INV_SQRT_2PI
    result[:, :, 1] = square
    np.multiply(t, square, out=result[:, :, 2])
    return result
