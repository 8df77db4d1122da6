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

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

# NumPy's own annotations widen every sum and product: double and single precision are told apart for the reader
Float = NDArray[Any]
Single = NDArray[Any]
Window = tuple[int, int, int, int]
Windows = Sequence[Window]

_UNIT = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
_MAX_PIXELS = 420
"""Pixels per marker; more cost time and give nothing that the model's own error does not swamp."""
_FEW_PIXELS = 200
"""Of them, those that the first steps use."""
_COARSE_LATTICE, _LATTICE = 800, 2500
"""Pixels of a marker that are looked at to choose from."""
_COARSE_REACH_PX = 3.0
_REACH_PX, _REACH_BLURS = 0.7, 2.2
"""Pixels farther than this from every edge of the pattern say little about the corners."""
_MARGIN_CELLS = 0.9
"""How far outside the border the page is taken to be white."""
_BLUR_RANGE_PX = (0.25, 4.0)
_COARSE_BLUR_PX = 0.8
"""Least blur of the first stage: with a sharper model too few of its pixels would feel the edges."""
_STEP_PX = 1.0
_CAUTIOUS_AFTER, _CAUTION = 3, 0.6
"""From that step on only a part of each is taken, which ends the swinging to and fro that outlying pixels can cause."""
_BLOCK_PX, _BLOCK_PIXELS = 3, 8
"""Least size of the blocks in which residuals are tested for hanging together, and chosen pixels in each."""
_BLUR_STEP_PX2 = 2.0
_COARSE_PX, _FINE_PX = 0.25, 0.012
"""Corner steps at which the two stages stop; the last step is taken, so what remains is far smaller."""
_COARSE_FORGIVEN_PX, _FORGIVEN_PX = 1.0, 0.15
"""Edges may be that far off, beside the noise, before their pixels lose weight, in either stage."""
_ROUNDING = np.sqrt(1.0 / 12.0)
"""Standard deviation of the rounding to whole grey values."""
_INV_SQRT_2PI = np.float32(1.0 / np.sqrt(2.0 * np.pi))
_TANH_1 = np.float32(np.sqrt(2.0 / np.pi))
_TANH_3 = np.float32(np.sqrt(2.0 / np.pi) * 0.044715)


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
    share: Float
    """Shape (m,), of the weight of the edges, what the robust fit has kept; small where the pattern is covered."""
    last_step_px: Float
    """Shape (m,), what the last step moved a corner by (part of the covariance); large where the fit did not settle."""
    noise_factor: Float
    """Shape (m,), how much residuals that hang together raise the variance over white noise of the same size."""


@dataclass(frozen=True, slots=True)
class _Pixels:
    """Chosen pixels, m markers by n pixels, padded with weight 0; in no order of place."""

    origin: Float
    """Shape (m, 2): near the marker, taken off the positions to keep single precision fine."""
    xy: Single
    value: Single
    weight: Single
    block: NDArray[np.int64]
    """Which small block of the image a pixel is in, from 0 in each marker."""

    def of(self, which: NDArray[np.int64]) -> "_Pixels":
        if len(which) == len(self.value):
            return self
        return _Pixels(self.origin[which], self.xy[which], self.value[which], self.weight[which], self.block[which])


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
    unit = np.column_stack([_UNIT, np.ones(4)])
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


def _second_difference(pattern: Float) -> Float:
    """Of the pattern with the white page round it, for the grid lines from one cell outside to one cell outside."""
    extended = np.pad(pattern, 2, constant_values=1.0)
    return np.diff(np.diff(extended, axis=0), axis=1)


@dataclass(frozen=True, slots=True)
class _Model:
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


def _model(H: Float, xy: Single, blur: Float, D: Single, lines: Single) -> _Model:
    """The blurred pattern. Blurring is diffusion: the derivative by a variance is half the second one by place."""
    a, b, grad_a, grad_b = _marker_coordinates(H, xy)
    blurred_a, blurred_b = _smeared(blur, grad_a), _smeared(blur, grad_b)
    over_a = 1.0 / np.sqrt(np.einsum("mni,mni->mn", grad_a, blurred_a))
    over_b = 1.0 / np.sqrt(np.einsum("mni,mni->mn", grad_b, blurred_b))
    skew = np.einsum("mni,mni->mn", grad_a, blurred_b) * over_a * over_b
    ta, fa, na = _steps(a, lines, over_a)
    tb, fb, nb = _steps(b, lines, over_b)
    nta, ntb = na * ta, nb * tb
    fa_D, na_D, nta_D = fa @ D, na @ D, nta @ D
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
    return _Model(a, b, T, gradient, by_blur, surround)


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


@dataclass(frozen=True, slots=True)
class _Choice:
    """Which pixels of a marker are looked at."""

    reach_px: Float
    """Distance from an edge of the pattern, shape (m,)."""
    lattice: int
    """Pixels that are looked at to choose from."""
    most: int


def _choose_pixels(
    image: NDArray[np.uint8],
    positions: Float | None,
    windows: Windows,
    corners: Float,
    patterns: list[Float],
    choice: _Choice,
) -> _Pixels:
    """Pixels near the edges of each marker's pattern, spread evenly.

    `positions` holds the ideal pixel of each image pixel, shape (height, width, 2); None where they are the same.
    """
    width = image.shape[1]
    origin = corners.mean(1)
    H = homography(corners)
    chosen = [
        _near_edges(H[k], patterns[k], width, positions, windows[k], choice, choice.reach_px[k])
        for k in range(len(corners))
    ]
    n = max((len(c) for c in chosen), default=0)
    m = len(corners)
    xy, value, weight = np.zeros((m, n, 2), np.float32), np.zeros((m, n), np.float32), np.zeros((m, n), np.float32)
    block = np.zeros((m, n), np.int64)
    for k, index in enumerate(chosen):
        rows, columns = np.divmod(index, width)
        count = len(index)
        here = np.column_stack([columns, rows]) if positions is None else positions[rows, columns]
        xy[k, :count], value[k, :count], weight[k, :count] = here - origin[k], image[rows, columns], 1.0
        if count:
            x0, y0, x1, y1 = windows[k]
            size = max(_BLOCK_PX, int(np.sqrt((x1 - x0) * (y1 - y0) * _BLOCK_PIXELS / count)))
            across = (columns - x0) // size
            block[k, :count] = (rows - y0) // size * ((x1 - x0) // size + 1) + across
    return _Pixels(origin, xy, value, weight, block)


def _near_edges(
    H: Float, pattern: Float, width: int, positions: Float | None, window: Window, choice: _Choice, reach_px: float
) -> NDArray[np.int64]:
    """Flat indices of the pixels of one marker, in no order of place."""
    x0, y0, x1, y1 = window
    if x1 - x0 < 4 or y1 - y0 < 4:
        return np.zeros(0, np.int64)
    # every so manieth pixel: on a large marker enough to choose from; the odd step runs along no edge for long
    step = max(1, (x1 - x0) * (y1 - y0) // choice.lattice)
    step += (x1 - x0) % step == 0 and step > 1
    rows, columns = np.divmod(np.arange(0, (x1 - x0) * (y1 - y0), step), x1 - x0)
    rows, columns = rows + y0, columns + x0
    xy = np.column_stack([columns, rows]).astype(float) if positions is None else positions[rows, columns]
    inverse = np.linalg.inv(H)
    r = xy @ inverse[:, :2].T + inverse[:, 2]
    cells = len(pattern)
    a, b = r[:, 0] / r[:, 2] * cells, r[:, 1] / r[:, 2] * cells
    off = np.maximum(np.abs(a - cells / 2), np.abs(b - cells / 2))
    inside = (r[:, 2] > 0) & (off < cells / 2 + _MARGIN_CELLS)
    a, b = a[inside], b[inside]
    corners = (H @ np.column_stack([_UNIT, np.ones(4)]).T).T
    corners = corners[:, :2] / corners[:, 2:]
    u = float(np.linalg.norm(corners[1] - corners[0] + corners[2] - corners[3])) / 2
    v = float(np.linalg.norm(corners[3] - corners[0] + corners[2] - corners[1])) / 2
    in_x, in_y = _edges(pattern)
    near = _edge_within(a, b, in_x, reach_px * cells / u) | _edge_within(b, a, in_y, reach_px * cells / v)
    index = (rows * width + columns)[inside][near]
    scatter = (index * 2654435761) % 4294967296
    if len(index) <= choice.most:
        return index
    return index[np.argpartition(scatter, choice.most)[: choice.most]]


def _edge_within(across: Float, along: Float, edges: NDArray[np.bool_], reach_cells: float) -> NDArray[np.bool_]:
    """Whether the grid line nearest in `across` is an edge of the pattern there, and within reach."""
    line = np.rint(across).astype(np.intp)
    cell = np.floor(along).astype(np.intp) + 1
    return edges[line, cell] & (np.abs(across - line) < reach_cells)


def _edges(pattern: Float) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which pieces of the grid lines part black from white: [line in x, cell in y] and [line in y, cell in x].

    Lines and cells count from one cell outside the border on the cells' side; a line outside (index -1) is no edge.
    """
    n = len(pattern)
    extended = np.ones((n + 2, n + 2))
    extended[1:-1, 1:-1] = pattern
    across, along = np.zeros((n + 3, n + 2), bool), np.zeros((n + 3, n + 2), bool)
    across[: n + 1] = np.diff(extended, axis=0) != 0
    along[: n + 1] = np.diff(extended.T, axis=0) != 0
    return across, along


def surroundings(corners: Float, cells: int, size: tuple[int, int]) -> Window:
    """x0, y0, x1, y1 (exclusive) round a marker and a little more than a cell, within an image (width, height)."""
    diagonal = max(np.linalg.norm(corners[2] - corners[0]), np.linalg.norm(corners[3] - corners[1]))
    grow = diagonal / cells + 2.0
    low, high = np.nan_to_num(corners.min(0) - grow), np.nan_to_num(corners.max(0) + grow)
    x0, y0 = max(int(low[0]), 0), max(int(low[1]), 0)
    return x0, y0, min(int(high[0]) + 2, size[0]), min(int(high[1]) + 2, size[1])


def fit_patterns(
    image: NDArray[np.uint8],
    corners: Float,
    patterns: list[Float],
    positions: Float | None = None,
    windows: Windows | None = None,
    steps: int = 8,
    blur_px: float = 1.2,
) -> PatternFit:
    """Corners of m markers with one pattern size, from near ones.

    Args:
        image: grey, shape (height, width).
        corners: shape (m, 4, 2), within about one cell of the truth, in ideal pixels, order 0..3.
        patterns: m arrays (cells, cells), see `MarkerDictionary.pattern`.
        positions: the ideal pixel of each image pixel, shape (height, width, 2), NaN beyond the lens model; None where
            the lens does not distort.
        windows: x0, y0, x1, y1 of each marker with its surroundings in the raw image, needed with `positions`.
        steps: most Gauss-Newton steps of each of the two stages.
        blur_px: blur to start from.
    """
    cells = np.array([len(p) for p in patterns])
    D = np.stack([_second_difference(p) for p in patterns]).astype(np.float32)
    lines = (np.arange(-1, cells[0] + 2) / cells[0]).astype(np.float32)
    size = image.shape[1], image.shape[0]
    around = [surroundings(c, len(p), size) for c, p in zip(corners, patterns, strict=True)]
    windows = around if windows is None else windows
    m = len(corners)
    few = _Choice(np.full(m, _COARSE_REACH_PX), _COARSE_LATTICE, _FEW_PIXELS)
    pixels = _choose_pixels(image, positions, windows, corners, patterns, few)
    blur = np.tile([blur_px**2, blur_px**2, 0.0], (m, 1))
    state, _ = _descend(_State(corners - pixels.origin[:, None], blur, None), pixels, D, lines, steps, True)
    coarse = state.corners + pixels.origin[:, None]
    reach = _REACH_PX + _REACH_BLURS * np.sqrt(state.blur[:, :2].max(1))
    pixels = _choose_pixels(image, positions, windows, coarse, patterns, _Choice(reach, _LATTICE, _MAX_PIXELS))
    state = _State(coarse - pixels.origin[:, None], state.blur, state.light)
    state, solved = _descend(state, pixels, D, lines, steps, False)
    return _summary(state, solved, pixels)


@dataclass(frozen=True, slots=True)
class _State:
    corners: Float
    """Relative to `_Pixels.origin`."""
    blur: Float
    """Shape (m, 3): variances along x and y, and covariance, px^2."""
    light: Float | None


@dataclass(frozen=True, slots=True)
class _Solved:
    step: Float
    """Change of the eight corner coordinates and the three of the blur, and ten new light values, shape (m, 21)."""
    inverse: Float
    residual: Single
    """After the step."""
    weight: Single
    jacobian: Single


def _descend(
    state: _State, pixels: _Pixels, D: Single, lines: Single, steps: int, coarse: bool
) -> tuple[_State, _Solved]:
    """Gauss-Newton on each marker until none of its corners still moves by more than the stage asks for."""
    m, n = pixels.value.shape
    corners, blur = state.corners.copy(), state.blur.copy()
    light = np.zeros((m, 10)) if state.light is None else state.light.copy()
    solved = _Solved(
        np.zeros((m, 21)),
        np.zeros((m, 21, 21)),
        np.zeros((m, n), np.float32),
        np.zeros((m, n), np.float32),
        np.zeros((m, n, 8), np.float32),
    )
    forgiven = _COARSE_FORGIVEN_PX if coarse else _FORGIVEN_PX
    active = np.arange(m)
    for count in range(steps):
        lit = None if count == 0 and state.light is None else light[active]
        one = _solve(_State(corners[active], blur[active], lit), pixels.of(active), D[active], lines, forgiven)
        largest = np.abs(one.step[:, :8]).max(1)
        shrink = np.minimum(1.0 if count < _CAUTIOUS_AFTER else _CAUTION, _STEP_PX / np.maximum(largest, 1e-9))
        corners[active] += (one.step[:, :8] * shrink[:, None]).reshape(-1, 4, 2)
        blur[active] = _bounded(blur[active], one.step[:, 8:11], _COARSE_BLUR_PX if coarse else _BLUR_RANGE_PX[0])
        light[active] = one.step[:, 11:]
        for name in ("step", "inverse", "residual", "weight", "jacobian"):
            getattr(solved, name)[active] = getattr(one, name)
        active = active[largest > (_COARSE_PX if coarse else _FINE_PX)]
        if not len(active):
            break
    return _State(corners, blur, light), solved


def _solve(state: _State, pixels: _Pixels, D: Single, lines: Single, forgiven_px: float) -> _Solved:
    """One Gauss-Newton step of corners and blur, with new light, outlying pixels softened.

    The very first step (no light yet) finds the light beforehand and softens nothing: everything is off then.
    """
    H = homography(state.corners)
    model = _model(H, pixels.xy, state.blur, D, lines)
    columns = np.empty((*model.T.shape, 21), np.float32)
    u, v = model.a - 0.5, model.b - 0.5
    for k, column in enumerate((1.0, model.T, u, v, model.T * u, model.T * v)):
        columns[..., 11 + k] = column
    columns[..., 17:] = model.surround
    light, weight = state.light, pixels.weight
    if light is None:
        light = _least_squares(columns[..., 11:], pixels.value, weight)[0]
    residual = pixels.value - _times(columns[..., 11:], light)
    gain = _times(np.stack([np.ones_like(u), u, v], -1), light[:, [1, 4, 5]])
    columns[..., :8] = _by_corners(H, model, pixels.xy, gain)
    columns[..., 8:11] = gain[..., None] * model.by_blur
    if state.light is not None:
        slope = gain * np.sqrt(np.einsum("mni,mni->mn", model.gradient, model.gradient))
        weight = weight * _softened(residual, _robust_scale(residual, weight), forgiven_px * slope)
    step, inverse = _least_squares(columns, residual, weight)
    after = residual - _times(columns, step)
    step[:, 11:] += light
    return _Solved(step, inverse, after, weight, columns[..., :8])


def _by_corners(H: Float, model: _Model, xy: Single, gain: Single) -> Single:
    """Derivative of the grey value by the eight corner coordinates: the pattern moves, the pixel stays."""
    h = H.astype(np.float32)
    over_q = -gain / (model.a * h[:, None, 2, 0] + model.b * h[:, None, 2, 1] + h[:, None, 2, 2])
    gx, gy = over_q * model.gradient[..., 0], over_q * model.gradient[..., 1]
    along = -(gx * xy[..., 0] + gy * xy[..., 1])
    a, b = model.a, model.b
    by_H = np.stack([gx * a, gx * b, gx, gy * a, gy * b, gy, along * a, along * b], -1)
    return by_H @ _corner_basis(H).astype(np.float32)


def _bounded(blur: Float, step: Float, least_px: float) -> Float:
    """The blur after a step, its widths kept within what lenses and hands do."""
    new = blur + np.clip(step, -_BLUR_STEP_PX2, _BLUR_STEP_PX2)
    matrix = new[:, [[0, 2], [2, 1]]]
    values, vectors = np.linalg.eigh(matrix)
    values = np.clip(values, least_px**2, _BLUR_RANGE_PX[1] ** 2)
    matrix = (vectors * values[:, None, :]) @ vectors.transpose(0, 2, 1)
    return np.stack([matrix[:, 0, 0], matrix[:, 1, 1], matrix[:, 0, 1]], -1)


def _times(columns: Single, factors: Float) -> Single:
    return (columns @ factors.astype(np.float32)[..., None])[..., 0]


def _least_squares(columns: Single, value: Single, weight: Single) -> tuple[Float, Float]:
    """Weighted solutions (m, k) and the inverse normal matrices (m, k, k), with columns scaled to be safe."""
    weighted = (columns * weight[..., None]).transpose(0, 2, 1)
    normal = (weighted @ columns).astype(float)
    right = (weighted @ value[..., None]).astype(float)
    norm = np.sqrt(np.einsum("mkk->mk", normal)) + 1e-6
    outer = norm[:, :, None] * norm[:, None, :]
    inverse = np.linalg.inv(normal / outer + 1e-7 * np.eye(normal.shape[-1])) / outer
    return (inverse @ right)[..., 0], inverse


def _robust_scale(residual: Single, weight: Single) -> Float:
    """Standard deviation by the median of the absolute residuals, shape (m,)."""
    count = weight.sum(1).astype(int)
    ordered = np.sort(np.where(weight > 0, np.abs(residual), np.float32(1e6)), axis=1)
    middle = np.clip(count // 2, 0, ordered.shape[1] - 1)
    median = np.take_along_axis(ordered, middle[:, None], 1)[:, 0]
    return 1.4826 * np.where(count > 0, median, 0.0) + _ROUNDING


def _softened(residual: Single, scale: Float, forgiven: Single) -> Single:
    """Tukey-like weights: whole up to 2.5 sigma, nothing beyond 6, an edge that is a little off forgiven."""
    allowed = forgiven**2 + (scale.astype(np.float32) ** 2)[:, None]
    return np.clip((6.0 - np.abs(residual) / np.sqrt(allowed)) / 3.5, 0.0, 1.0)


def _correlation(value: Single, residual: Single, weight: Single) -> Float:
    total = np.maximum(weight.sum(1), 1e-9)
    mean = (value * weight).sum(1) / total
    spread = ((value - mean[:, None]) ** 2 * weight).sum(1)
    left = (residual**2 * weight).sum(1)
    return np.sqrt(np.clip(1.0 - left / np.maximum(spread, 1e-9), 0.0, 1.0)).astype(float)


def _summary(state: _State, solved: _Solved, pixels: _Pixels) -> PatternFit:
    weight, light = solved.weight, solved.step[:, 11:]
    freedom = np.maximum(weight.sum(1) - 21.0, 1.0)
    variance = np.maximum((solved.residual**2 * weight).sum(1) / freedom, _ROUNDING**2)
    factor = _hang_together(solved, pixels, weight)
    last_step = np.abs(solved.step[:, :8]).max(1)
    covariance = solved.inverse[:, :8, :8] * (variance * factor)[:, None, None]
    covariance += (last_step**2)[:, None, None] * np.eye(8)
    return PatternFit(
        state.corners + pixels.origin[:, None],
        covariance,
        np.sqrt(state.blur[:, :2].mean(1)),
        light[:, 1],
        np.sqrt(variance),
        _correlation(pixels.value, solved.residual, weight),
        _share(solved, pixels),
        last_step,
        factor,
    )


def _share(solved: _Solved, pixels: _Pixels) -> Float:
    strength = np.einsum("mnk,mnk->mn", solved.jacobian, solved.jacobian)
    whole = (strength * pixels.weight).sum(1)
    return ((strength * solved.weight).sum(1) / np.maximum(whole, 1e-9)).astype(float)


def _hang_together(solved: _Solved, pixels: _Pixels, weight: Single) -> Float:
    """Variance of the sums of residuals over small blocks against that of independent ones, shape (m,).

    1 where it is no larger than chance makes it.
    """
    m = len(weight)
    blocks = int(pixels.block.max(initial=0)) + 1
    place = (pixels.block + blocks * np.arange(m)[:, None]).ravel()
    score = ((solved.residual * weight)[..., None] * solved.jacobian).astype(float)
    apart = (score**2).sum((1, 2))
    together, used = np.zeros(m), np.zeros(m)
    for k in range(8):
        sums = np.bincount(place, score[..., k].ravel(), minlength=m * blocks).reshape(m, blocks) ** 2
        together += sums.sum(1)
        used = np.maximum(used, sums.sum(1) ** 2 / np.maximum((sums**2).sum(1), 1e-12))
    factor = together / np.maximum(apart, 1e-12)
    return np.where(factor > 1.0 + 2.0 * np.sqrt(2.0 / np.maximum(used, 1.0)), factor, 1.0)
