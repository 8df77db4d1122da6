"""Marker corners from the whole printed pattern: the eight corner coordinates that explain the pixels best.

The printed pattern is known once a marker has been read, so the image of a marker is known up to where its corners are,
how much the lens and the motion blur it, and how it is lit. Gauss-Newton finds all of these together. Nothing pulls
corners inwards: the blurred step is part of the model, and the edges inside the pattern help those of the border.
Pixels, not interpolated samples, are compared, so the residuals are the noise and give the covariance.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .edge_errors import edge_errors
from .pattern_model import PatternModel, corner_basis, homography, pattern_model, second_difference
from .pixel_choice import Choice, Pixels, choose_pixels, surroundings
from .pixel_noise import pixel_noise

# NumPy's own annotations widen every sum and product: double and single precision are told apart for the reader
Float = NDArray[Any]
Single = NDArray[Any]

_MAX_PIXELS = 512
"""Pixels per marker; more cost time and give nothing that the model's own error does not swamp."""
_FEW_PIXELS = 240
"""Of them, those that the first steps use."""
_COARSE_REACH_PX = 3.0
_REACH_PX, _REACH_BLURS = 0.7, 2.2
"""Pixels farther than this from every edge of the pattern say little about the corners."""
_BLUR_RANGE_PX = (0.25, 4.0)
_COARSE_BLUR_PX = 0.8
"""Least blur of the first stage: with a sharper model too few of its pixels would feel the edges."""
_START_BLUR_PX = 1.2
_STEPS = 8
"""Most Gauss-Newton steps of each of the two stages."""
_STEP_PX = 1.0
_CAUTIOUS_AFTER, _CAUTION = 3, 0.6
"""From that step on only a part of each is taken, which ends the swinging to and fro that outlying pixels can cause."""
_BLUR_STEP_PX2 = 2.0
_TONE, _LIGHT, _UNKNOWNS = 11, 12, 22
"""Places among the unknowns: eight corner coordinates, three of the blur, the tone, ten of the light."""
_TONE_RANGE = (-0.75, 3.0)
"""More bent than any camera; the same either way."""
_COARSE_PX, _FINE_PX, _WARM_PX = 0.12, 0.012, 0.03
"""Corner steps at which the two stages stop; the last step is taken, so what remains is far smaller. Where blur and
light are known from the last image the corners are there sooner: nothing else moves them any more."""
_UNSETTLED = 0.15
"""What further steps would add to the last one, as a share of it: the most that was measured."""
_COARSE_FORGIVEN_PX, _FORGIVEN_PX = 1.0, 0.15
"""Edges may be that far off, beside the noise, before their pixels lose weight, in either stage."""
_ROUNDING = np.sqrt(1.0 / 12.0)
"""Standard deviation of the rounding to whole grey values."""


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
    structure: Float
    """Shape (m,), share of the covariance that is not the noise of the pixels but what the model does not know of
    print, lens and light: it comes back in the next image from the same place."""
    warm: "Warm"


def fit_patterns(
    image: NDArray[np.uint8],
    corners: Float,
    patterns: list[Float],
    positions: Float | None = None,
    raw: Float | None = None,
    warm: "Warm | None" = None,
) -> PatternFit:
    """Corners of m markers with one pattern size, from near ones.

    Args:
        image: grey, shape (height, width).
        corners: shape (m, 4, 2), within about one cell of the truth, in ideal pixels, order 0..3.
        patterns: m arrays (cells, cells), see `MarkerDictionary.pattern`.
        positions: the ideal pixel of each image pixel, shape (height, width, 2), NaN beyond the lens model; None where
            the lens does not distort.
        raw: the corners in the image, shape (m, 4, 2), needed with `positions`.
        warm: blur, tone and light of the same markers a moment ago. The corners are then taken to be within a pixel or
            so, and the coarse stage is left out.
    """
    cells = len(patterns[0])
    D = np.stack([second_difference(p.tobytes(), len(p)) for p in patterns])
    lines = (np.arange(-1, cells + 2) / cells).astype(np.float32)
    raw = corners if raw is None else raw
    near, settled = corners, _WARM_PX
    if warm is None:
        settled = _FINE_PX
        near, warm = _coarse(image, corners, raw, patterns, positions, D, lines)
        raw = raw + near - corners
    reach = _REACH_PX + _REACH_BLURS * np.sqrt(warm.blur[:, :2].max(1))
    pixels = choose_pixels(image, positions, raw, near, patterns, Choice(reach, _MAX_PIXELS))
    state = _State(near - pixels.origin[:, None], warm.blur, warm.tone, warm.light)
    state, groups = _descend(state, pixels, D, lines, settled)
    order = np.argsort(np.concatenate([index for index, _ in groups]))
    solved = _Settled.together([part for _, part in groups], order)
    size = image.shape[1], image.shape[0]
    return _summary(state, solved, pixels, pixel_noise(image, surroundings(raw, cells, size)))


def _coarse(
    image: NDArray[np.uint8],
    corners: Float,
    raw: Float,
    patterns: list[Float],
    positions: Float | None,
    D: Single,
    lines: Single,
) -> tuple[Float, "Warm"]:
    """Corners within a fraction of a pixel, and the first blur and light."""
    m = len(corners)
    pixels = choose_pixels(image, positions, raw, corners, patterns, Choice(np.full(m, _COARSE_REACH_PX), _FEW_PIXELS))
    blur = np.tile([_START_BLUR_PX**2, _START_BLUR_PX**2, 0.0], (m, 1))
    state = _State(corners - pixels.origin[:, None], blur, np.zeros(m), None)
    state, _ = _descend(state, pixels, D, lines, _COARSE_PX, True)
    assert state.light is not None
    return state.corners + pixels.origin[:, None], Warm(state.blur, state.tone, state.light)


@dataclass(frozen=True, slots=True)
class Warm:
    """What a fit found beside the corners, to start the next one from."""

    blur: Float
    """Shape (m, 3)."""
    tone: Float
    """Shape (m,)."""
    light: Float
    """Shape (m, 10)."""

    def of(self, k: int) -> "Warm":
        """One marker's."""
        return Warm(self.blur[k : k + 1], self.tone[k : k + 1], self.light[k : k + 1])

    @staticmethod
    def together(parts: Sequence["Warm"]) -> "Warm":
        """Several markers'."""
        blur, tone, light = (np.concatenate([getattr(p, name) for p in parts]) for name in ("blur", "tone", "light"))
        return Warm(blur, tone, light)


@dataclass(frozen=True, slots=True)
class _State:
    corners: Float
    """Relative to `Pixels.origin`."""
    blur: Float
    """Shape (m, 3): variances along x and y, and covariance, px^2."""
    tone: Float
    """Shape (m,), bend of the response between black and white, see `_solve`."""
    light: Float | None


@dataclass(frozen=True, slots=True)
class _Solved:
    step: Float
    """Change of the eight corner coordinates, the three of the blur and the tone, and ten new light values."""
    inverse: Float
    residual: Single
    """After the step."""
    weight: Single
    columns: Single
    """Jacobian by all unknowns, the corners first, shape (m, k, n)."""
    model: PatternModel
    gain: Single
    """Change of the grey values by the pattern."""


@dataclass(frozen=True, slots=True)
class _Settled:
    """The last step of markers whose corners have come to rest."""

    step: Float
    inverse: Float
    residual: Single
    weight: Single
    columns: Single
    shifts: Single
    """Change of the grey values by a shift of each grid line of constant a, then of b, shape (m, 2, k, n)."""
    place: Single
    """Of the pixels in the marker, from its middle, shape (m, 2, n)."""

    @property
    def jacobian(self) -> Single:
        """By the corners."""
        return self.columns[:, :8]

    @staticmethod
    def of(solved: _Solved, which: NDArray[np.bool_]) -> "_Settled":
        """Some of the markers."""
        shifts = solved.model.by_lines()
        shifts *= solved.gain[:, None, None]
        parts = (solved.step, solved.inverse, solved.residual, solved.weight, solved.columns)
        parts = (*parts, shifts, solved.model.ab - np.float32(0.5))
        return _Settled(*(parts if which.all() else (part[which] for part in parts)))

    @staticmethod
    def together(parts: Sequence["_Settled"], order: NDArray[np.int64]) -> "_Settled":
        """All markers, in their own order."""
        if len(parts) == 1:
            return parts[0]
        names = [field.name for field in fields(_Settled)]
        return _Settled(*(np.concatenate([getattr(part, name) for part in parts])[order] for name in names))


def _descend(
    state: _State, pixels: Pixels, D: Single, lines: Single, settled_px: float, coarse: bool = False
) -> tuple[_State, list[tuple[NDArray[np.int64], _Settled]]]:
    """Gauss-Newton on each marker until none of its corners still moves by more than the stage asks for.

    Returns:
        The state, and the last steps, as groups of markers that came to rest together (empty where `coarse`).
    """
    m = len(pixels.value)
    corners, blur, tone = state.corners.copy(), state.blur.copy(), state.tone.copy()
    light = np.zeros((m, 10)) if state.light is None else state.light.copy()
    forgiven = _COARSE_FORGIVEN_PX if coarse else _FORGIVEN_PX
    active, settled = np.arange(m), []
    for count in range(_STEPS):
        lit = None if count == 0 and state.light is None else light[active]
        now = _State(corners[active], blur[active], tone[active], lit)
        one = _solve(now, pixels.of(active), D[active], lines, forgiven, coarse)
        largest = np.abs(one.step[:, :8]).max(1)
        shrink = np.minimum(1.0 if count < _CAUTIOUS_AFTER else _CAUTION, _STEP_PX / np.maximum(largest, 1e-9))
        corners[active] += (one.step[:, :8] * shrink[:, None]).reshape(-1, 4, 2)
        blur[active] = _bounded(blur[active], one.step[:, 8:11], _COARSE_BLUR_PX if coarse else _BLUR_RANGE_PX[0])
        tone[active] = np.clip(tone[active] + one.step[:, _TONE], *_TONE_RANGE)
        light[active] = one.step[:, _LIGHT:]
        rests = (largest <= settled_px) | (count == _STEPS - 1) | ~np.isfinite(largest)
        if rests.any() and not coarse:
            settled.append((active[rests], _Settled.of(one, rests)))
        active = active[~rests]
        if not len(active):
            break
    return _State(corners, blur, tone, light), settled


def _solve(state: _State, pixels: Pixels, D: Single, lines: Single, forgiven_px: float, tone_fixed: bool) -> _Solved:
    """One Gauss-Newton step of corners, blur and tone, with new light, outlying pixels softened.

    The camera's response bends what lies between black and white, T -> (1 + tone) T / (1 + tone T): a gamma of 2.2
    does so by about 1. That shifts every edge towards the black side, as spread ink shifts it towards the white one,
    and makes the marker smaller; edges inside the pattern, which look both ways, tell it from the marker's size.

    The very first step (no light yet) finds the light beforehand and softens nothing: everything is off then.
    """
    H = homography(state.corners)
    model = pattern_model(H, pixels.xy, state.blur, D, lines)
    tone = state.tone.astype(np.float32)[:, None]
    over = 1.0 / (1.0 + tone * model.T)
    response = (1.0 + tone) * model.T * over
    u, v = model.ab[:, 0] - np.float32(0.5), model.ab[:, 1] - np.float32(0.5)
    columns = np.empty((len(H), _UNKNOWNS, u.shape[1]), np.float32)
    for k, column in enumerate((1.0, response, u, v, response * u, response * v)):
        columns[:, _LIGHT + k] = column
    columns[:, _LIGHT + 6 :] = model.surround
    light, weight = state.light, pixels.weight
    if light is None:
        light = _least_squares(columns[:, _LIGHT:], pixels.value, weight)[0]
    residual = pixels.value - _times(columns[:, _LIGHT:], light)
    part = light.astype(np.float32)[:, :, None]
    gain = part[:, 1] + part[:, 4] * u + part[:, 5] * v
    over *= over
    columns[:, _TONE] = 0.0 if tone_fixed else gain * model.T * (1.0 - model.T) * over
    gain = gain * (1.0 + tone) * over
    columns[:, :8] = _by_corners(H, model, pixels.xy, gain)
    np.multiply(gain[:, None], model.by_blur, out=columns[:, 8:_TONE])
    if state.light is not None:
        slope = gain * np.sqrt(np.einsum("mxn,mxn->mn", model.gradient, model.gradient))
        weight = weight * _softened(residual, _robust_scale(residual, weight), forgiven_px * slope)
    step, inverse = _least_squares(columns, residual, weight)
    after = residual - _times(columns, step)
    step[:, _LIGHT:] += light
    return _Solved(step, inverse, after, weight, columns, model, gain)


def _by_corners(H: Float, model: PatternModel, xy: Single, gain: Single) -> Single:
    """Derivative of the grey value by the eight corner coordinates: the pattern moves, the pixel stays."""
    h = H.astype(np.float32)
    over_q = -gain / ((h[:, None, 2, :2] @ model.ab)[:, 0] + h[:, 2, 2, None])
    by_H = np.empty((len(H), 8, xy.shape[-1]), np.float32)
    np.multiply(over_q[:, None], model.gradient, out=by_H[:, 2:6:3])
    along = -np.einsum("mxn,mxn->mn", by_H[:, 2:6:3], xy)
    np.multiply(by_H[:, 2:3], model.ab, out=by_H[:, :2])
    np.multiply(by_H[:, 5:6], model.ab, out=by_H[:, 3:5])
    np.multiply(along[:, None], model.ab, out=by_H[:, 6:])
    return corner_basis(H).astype(np.float32).transpose(0, 2, 1) @ by_H


def _bounded(blur: Float, step: Float, least_px: float) -> Float:
    """The blur after a step, its widths kept within what lenses and hands do."""
    new = blur + np.clip(step, -_BLUR_STEP_PX2, _BLUR_STEP_PX2)
    middle, half = (new[:, 0] + new[:, 1]) / 2, (new[:, 0] - new[:, 1]) / 2
    radius = np.hypot(half, new[:, 2])
    high, low = (np.clip(middle + sign * radius, least_px**2, _BLUR_RANGE_PX[1] ** 2) for sign in (1, -1))
    shrink = (high - low) / np.maximum(2.0 * radius, 1e-12)
    middle, half = (high + low) / 2, half * shrink
    return np.stack([middle + half, middle - half, new[:, 2] * shrink], -1)


def _times(columns: Single, factors: Float) -> Single:
    return (factors.astype(np.float32)[:, None] @ columns)[:, 0]


def _least_squares(columns: Single, value: Single, weight: Single) -> tuple[Float, Float]:
    """Weighted solutions (m, k) and the inverse normal matrices (m, k, k), with columns scaled to be safe."""
    weighted = columns * weight[:, None]
    normal = (weighted @ columns.transpose(0, 2, 1)).astype(float)
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


def _summary(state: _State, solved: _Settled, pixels: Pixels, noise: Float) -> PatternFit:
    weight, light = solved.weight, solved.step[:, _LIGHT:]
    freedom = np.maximum(weight.sum(1) - _UNKNOWNS, 1.0)
    variance = np.maximum((solved.residual**2 * weight).sum(1) / freedom, _ROUNDING**2)
    edges = edge_errors(solved.columns, solved.inverse, solved.residual, weight, solved.shifts, solved.place)
    last_step = np.abs(solved.step[:, :8]).max(1)
    by_noise = solved.inverse[:, :8, :8] * edges.noise_variance[:, None, None]
    covariance = by_noise + edges.variance_px2[:, None, None] * edges.spread
    covariance += ((_UNSETTLED * last_step) ** 2)[:, None, None] * np.eye(8)
    return PatternFit(
        state.corners + pixels.origin[:, None],
        covariance,
        np.sqrt(state.blur[:, :2].mean(1)),
        light[:, 1],
        np.sqrt(variance),
        _correlation(pixels.value, solved.residual, weight),
        _share(solved, pixels),
        last_step,
        _structure(solved, covariance, np.minimum(noise**2 + _ROUNDING**2, edges.noise_variance)),
        Warm(state.blur, state.tone, light),
    )


def _structure(solved: _Settled, covariance: Float, noise: Float) -> Float:
    """Share of the covariances that is not the noise of the pixels (a variance, shape (m,))."""
    by_noise = noise * np.einsum("mkk->m", solved.inverse[:, :8, :8])
    return np.clip(1.0 - by_noise / np.einsum("mkk->m", covariance), 0.0, 1.0)


def _share(solved: _Settled, pixels: Pixels) -> Float:
    strength = np.einsum("mkn,mkn->mn", solved.jacobian, solved.jacobian)
    whole = (strength * pixels.weight).sum(1)
    return ((strength * solved.weight).sum(1) / np.maximum(whole, 1e-9)).astype(float)
