"""Sub-pixel fit of an occluding edge: the grey values across it, as a camera sees the limb of a cylinder.

Outside, the background is a level and a slope per stretch of the edge. Inside, a shaded cylinder changes towards its
limb like the square root of the distance from it, which drags an ordinary step edge inwards; so the model has that
term. Both are blurred by the same Gaussian. Grey values are used where the pixels are, nothing is interpolated.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from ..covariance import larger

Float = NDArray[np.float64]

_STRETCH_PX = 5.0
_ITERATIONS = 16
_LOG_BLUR_RANGE = (float(np.log(0.4)), float(np.log(1.2)))
"""A pixel alone blurs by 0.3 px. Edges softer than 1.2 px are shading or out of focus."""
_USUAL_LOG_BLUR = float(np.log(0.6))
_FARTHEST_PX = 2.6
"""The fit may move the line so far: shading inside can be steeper than the edge that a seed is taken for."""
_KINKS_PX = (0.0, 1.8, 3.2)
"""Depths at which the shading may change its slope."""
_TERMS = 3 + len(_KINKS_PX)
_TREND_PX = 40.0
_WIDE, _NARROW = (4.5, 5.0), (3.0, 2.5)
"""How far outside and inside the edge a fit looks, px."""
_SHADING_RANGE = 80.0
"""Prior sigma of a shading term, grey values over half the pipe's width."""


@dataclass(frozen=True, slots=True)
class EdgeFit:
    """A fitted edge."""

    line: Float
    """(3,), unit normal, positive outside."""
    foot_px: Float
    """(2,), the point of the line that the covariance refers to."""
    covariance: Float
    """(2, 2), of (offset px, direction rad) about the foot."""
    extent: tuple[float, float]
    """Supported part of the line along (-l1, l0) from the foot, px."""
    blur_px: float
    contrast: float
    """Median change of the grey value from 1 px outside to 1 px inside."""
    sharpness: float
    """Part of the change, from outside to well inside, that happens within 1 px of the edge: 1 for a step, 0.5 for a
    lit limb before black, 0.25 where shading sets in at a kink."""
    supported: int
    """Number of stretches that agree with the line."""
    stretches: int


@dataclass(frozen=True, slots=True)
class _State:
    offset: float
    turn: float
    log_blur: float
    shading: Float
    """Coefficients of `_shading`, grey values at full depth."""

    def moved(self, step: Float) -> "_State":
        log_blur = float(np.clip(self.log_blur + np.clip(step[2], -0.3, 0.3), *_LOG_BLUR_RANGE))
        offset = self.offset + float(np.clip(step[0], -0.7, 0.7))
        return _State(offset, self.turn + float(np.clip(step[1], -0.03, 0.03)), log_blur, self.shading + step[3:])

    def deviation(self) -> Float:
        """From the priors' means."""
        return np.concatenate(((0.0, 0.0, self.log_blur - _USUAL_LOG_BLUR), self.shading))


@dataclass(frozen=True, slots=True)
class _Pixels:
    """Pixels by stretch, padded: shape (stretches, n) each."""

    grey: Float
    depth: Float
    """Distance from the first guess of the edge, px, positive inside the pipe."""
    along: Float
    weight: Float
    """0 for padding."""
    half_width: float
    noise: float
    evenness: float
    """White noise over how much the pipe's own grey value varies from stretch to stretch."""


@dataclass(frozen=True, slots=True)
class _Linear:
    """The model at a state, each stretch's own levels projected out."""

    jacobian: Float
    """(stretches, n, 3 + shading terms): offset, turn, log blur, shading."""
    residual: Float
    """(stretches, n)"""
    shift: Float
    """(stretches,), where each alone would put the edge, px from the line."""
    shift_sigma: Float
    squares: Float
    """(stretches,), sum of squared residuals."""
    variance: Float


def _limb_table() -> tuple[Float, Float]:
    """sqrt(max(x, 0)) blurred by a Gaussian of sigma 1, tabulated."""
    x = np.linspace(-6.0, 24.0, 1201)
    fine = np.linspace(-6, 6, 2401)
    kernel = np.exp(-0.5 * fine**2)
    return x, (np.sqrt(np.maximum(x[:, None] - fine[None, :], 0)) @ kernel) / kernel.sum()


_LIMB_X, _LIMB_Y = _limb_table()
_LIMB_SLOPE = np.gradient(_LIMB_Y, _LIMB_X)


def fit_edge(
    grey: Float, px: Float, line: Float, foot_px: Float, span: tuple[float, float], half_width_px: float, noise: float
) -> EdgeFit | None:
    """Fits an occluding edge near `line`.

    Args:
        grey: Shape (n,), grey values of the pixels around the edge.
        px: Shape (n, 2), their ideal pixels.
        line: Shape (3,), where the edge is to 2 px, positive outside.
        foot_px: Shape (2,), a point of that line; the result's covariance refers to the fitted edge beside it.
        span: Part of the line to use, px from the foot along (-l1, l0).
        half_width_px: Half the pipe's width in the image.
        noise: White noise of the image, grey values.

    Returns:
        None where the grey values do not hold such an edge.
    """
    fits = []
    for window in (_WIDE, _NARROW):
        pixels = _gather(grey, px, line, foot_px, span, half_width_px, noise, window)
        state = None if pixels is None else _converged(pixels)
        if pixels is None or state is None:
            return None
        fits.append((pixels, state))
    (pixels, state), (_, other) = fits
    # What the two windows do not agree on is the model's error, not noise.
    spread = np.diag([(state.offset - other.offset) ** 2, (state.turn - other.turn) ** 2])
    return _result(line, foot_px, pixels, state, spread)


def _converged(pixels: _Pixels) -> _State | None:
    """Levenberg-Marquardt in three stages (see `_prior`); None where the edge runs away."""
    state = _State(0.0, 0.0, _USUAL_LOG_BLUR, np.zeros(_TERMS))
    linear, weights, damping = _linearise(pixels, state), np.ones(len(pixels.grey)), 1e-3
    for iteration in range(_ITERATIONS):
        prior = _prior(iteration // 4)
        normal, scores = _normal(linear, weights, prior)
        gradient = scores.sum(axis=0) - prior * state.deviation()
        step = np.linalg.solve(normal + damping * np.diag(np.diag(normal)), gradient)
        trial = state.moved(step)
        if abs(trial.offset) > _FARTHEST_PX or abs(trial.turn) > 0.12:
            return None
        proposal = _linearise(pixels, trial)
        scale = weights / linear.variance
        gain = float(scale @ (linear.squares - proposal.squares))
        gain += float(prior @ (state.deviation() ** 2 - trial.deviation() ** 2))
        if gain < 0:
            damping *= 10.0
            continue
        state, linear, damping = trial, proposal, max(damping / 5.0, 1e-4)
        weights = _weights(linear)
        if weights.sum() < 1.5:
            return None
        if iteration > 8 and abs(step[0]) < 5e-3 and abs(step[1]) < 2e-4:
            break
    return state


def _gather(
    grey: Float,
    px: Float,
    line: Float,
    foot_px: Float,
    span: tuple[float, float],
    half_width_px: float,
    noise: float,
    window: tuple[float, float],
) -> _Pixels | None:
    outside, deepest = window
    inside = float(np.clip(0.8 * half_width_px, 2.0, deepest)) + 0.5
    depth = -(px @ line[:2] + line[2])
    along = (px - foot_px) @ np.array([-line[1], line[0]])
    keep = (depth > -outside) & (depth < inside) & (along >= span[0]) & (along < span[1]) & np.isfinite(grey + depth)
    grey, depth, along = grey[keep], depth[keep], along[keep]
    number = max(1, round((span[1] - span[0]) / _STRETCH_PX))
    stretch = np.minimum(((along - span[0]) / (span[1] - span[0]) * number).astype(int), number - 1)
    count = np.bincount(stretch, minlength=number)
    full = count >= 0.6 * _STRETCH_PX * (inside + outside)
    if full.sum() < 2:
        return None
    order = np.argsort(stretch, kind="stable")
    place = np.arange(len(order)) - np.repeat(np.cumsum(count) - count, count)
    table = np.zeros((4, number, count.max()))
    for i, values in enumerate((grey, depth, along, np.ones(len(grey)))):
        table[i, stretch[order], place] = values[order]
    table = table[:, full]
    noise = max(noise, 0.3)
    values, depths, places, weight = table
    evenness = noise / _stains(values, depths, places, weight, inside)
    return _Pixels(values, depths, places, weight, half_width_px, noise, evenness)


def _stains(grey: Float, depth: Float, along: Float, weight: Float, inside: float) -> float:
    """How much the pipe's grey value varies along it beyond a trend, well inside the edge; at least half a level."""
    deep = weight * (depth > min(2.2, inside - 1.5))
    count = deep.sum(axis=1)
    seen = count > 3
    if seen.sum() < 4:
        return 20.0
    level, place = ((deep * a).sum(axis=1)[seen] / count[seen] for a in (grey, along))
    left = level - np.polyval(np.polyfit(place, level, 1), place)
    return max(1.4826 * float(np.median(np.abs(left))), 0.5)


def _linearise(pixels: _Pixels, state: _State) -> _Linear:
    blur = np.exp(state.log_blur)
    tau = pixels.depth + state.offset - state.turn * pixels.along
    x = tau / blur
    step = ndtr(x)
    bell = np.exp(-0.5 * x**2) / np.sqrt(2 * np.pi)
    shading, by_depth, by_width = _shading(tau, pixels.along, blur, pixels.half_width)
    ramp = -tau * (1 - step) + blur * bell
    basis = np.stack((1 - step, ramp, step), axis=2) * pixels.weight[..., None]
    # The pipe's grey value goes on along it, to within its own stains: one row more holds each stretch's deviation.
    basis = np.concatenate((basis, np.broadcast_to([0.0, 0.0, pixels.evenness], (len(basis), 1, 3))), axis=1)
    turned = basis.transpose(0, 2, 1)
    solver = np.linalg.inv(turned @ basis + 1e-9 * np.eye(3)) @ turned
    wanted = np.pad((pixels.grey - shading @ state.shading) * pixels.weight, ((0, 0), (0, 1)))
    level = (solver @ wanted[..., None])[..., 0]
    residual = wanted - (basis @ level[..., None])[..., 0]
    jump = (level[:, 2] - level[:, 0])[:, None]
    slope = level[:, 1][:, None]
    by_tau = jump * bell / blur - slope * (1 - step) + by_depth @ state.shading
    by_blur = -jump * bell * x + slope * bell * blur + by_width @ state.shading
    jacobian = np.concatenate((np.stack((by_tau, -by_tau * pixels.along, by_blur), axis=2), shading), axis=2)
    jacobian = np.pad(jacobian * pixels.weight[..., None], ((0, 0), (0, 1), (0, 0)))
    jacobian = jacobian - basis @ (solver @ jacobian)
    freedom = np.maximum(pixels.weight.sum(axis=1) - 4, 1)
    squares = (residual**2).sum(axis=1)
    variance = np.maximum(squares / freedom, pixels.noise**2)
    strength = np.maximum((jacobian[..., 0] ** 2).sum(axis=1), 1e-9)
    shift = (jacobian[..., 0] * residual).sum(axis=1) / strength
    return _Linear(jacobian, residual, shift, np.sqrt(variance / strength), squares, variance)


def _shading(tau: Float, along: Float, blur: float, half_width: float) -> tuple[Float, Float, Float]:
    """What the shading inside may look like, blurred: terms, derivatives by depth and by log blur, (..., terms) each.

    The root term is the face that turns away from the viewer at the limb; a slope, and kinks where the pipe's own
    shadow or a highlight begins, stand for the rest.
    """
    scale = np.sqrt(blur * (2 - np.clip(tau / half_width, 0, 1)) / half_width)
    x = tau / blur
    here = along / _TREND_PX
    bell = np.exp(-0.5 * x**2) / np.sqrt(2 * np.pi)
    inside = [(ndtr(x), bell / blur, -bell * x)]
    inside.append(tuple(value * here for value in inside[0]))
    root = scale * np.interp(x, _LIMB_X, _LIMB_Y)
    root_slope = scale * np.interp(x, _LIMB_X, _LIMB_SLOPE) / blur
    terms, by_depth, by_width = (list(values) for values in zip(*inside, strict=True))
    terms.append(root)
    by_depth.append(root_slope)
    by_width.append(0.5 * root - root_slope * tau)
    for start in _KINKS_PX:
        y = (tau - start) / blur
        bell = np.exp(-0.5 * y**2) / np.sqrt(2 * np.pi)
        terms.append(((tau - start) * ndtr(y) + blur * bell) / half_width)
        by_depth.append(ndtr(y) / half_width)
        by_width.append(blur * bell / half_width)
    return np.stack(terms, axis=-1), np.stack(by_depth, axis=-1), np.stack(by_width, axis=-1)


def _weights(linear: _Linear) -> Float:
    """Tukey weights of the stretches by where each alone would put the edge."""
    shift, sigma = linear.shift, linear.shift_sigma
    order = np.argsort(shift)
    information = np.cumsum(1 / sigma[order] ** 2)
    middle = shift[order][np.searchsorted(information, 0.5 * information[-1])]
    typical = 1.4826 * np.median(np.abs(shift - middle)) if len(shift) > 3 else 0.0
    scale = np.sqrt(sigma**2 + np.clip(typical, 0.08, 0.5) ** 2)
    ratio = (shift - middle) / (4.0 * scale)
    return np.where(np.abs(ratio) < 1, (1 - ratio**2) ** 2, 0.0)


def _normal(linear: _Linear, weights: Float, prior: Float) -> tuple[Float, Float]:
    scaled = weights / linear.variance
    turned = linear.jacobian.transpose(0, 2, 1)
    scores = scaled[:, None] * (turned @ linear.residual[..., None])[..., 0]
    return (scaled[:, None, None] * (turned @ linear.jacobian)).sum(axis=0) + np.diag(prior), scores


def _prior(stage: int) -> Float:
    """Information of the weak priors; early stages hold blur and kinks, so that the step is found before its finish."""
    shading = np.full(_TERMS, _SHADING_RANGE**-2.0)
    shading[0] = 1e-6
    if stage < 2:
        shading[3:] = 1e6
    return np.concatenate(((1e-9, 1e-9, 1.0 if stage >= 1 else 1e6), shading))


def _covariance(linear: _Linear, weights: Float) -> Float:
    """Of (offset, turn): texture behind the pipe correlates the residuals of one stretch, so each stretch counts as one
    observation (cluster-robust sandwich), and no less than what independent pixels would give."""
    normal, scores = _normal(linear, weights, _prior(2))
    inverse = np.linalg.inv(normal)
    effective = weights.sum() ** 2 / (weights**2).sum()
    sandwich = inverse @ (scores.T @ scores) @ inverse * effective / max(effective - 2.0, 0.5)
    return larger(np.asarray(inverse[:2, :2], np.float64), sandwich[:2, :2])


def _result(line: Float, foot_px: Float, pixels: _Pixels, state: _State, spread: Float) -> EdgeFit | None:
    linear = _linearise(pixels, state)
    weights = _weights(linear)
    good = (linear.shift_sigma < 0.5) & (weights > 0.1)
    if good.sum() < 2:
        return None
    cosine, sine = np.cos(state.turn), np.sin(state.turn)
    normal = np.array([line[0] * cosine - line[1] * sine, line[0] * sine + line[1] * cosine])
    foot = foot_px + (state.offset - foot_px @ line[:2] - line[2]) * line[:2]
    inside = pixels.weight > 0
    start = np.where(inside, pixels.along, np.inf).min(axis=1)[good].min()
    end = np.where(inside, pixels.along, -np.inf).max(axis=1)[good].max()
    contrast, sharpness = _sharpness(pixels, state, good)
    return EdgeFit(
        line=np.array([normal[0], normal[1], -normal @ foot]),
        foot_px=foot,
        covariance=_covariance(linear, weights) + spread,
        extent=(float(start), float(end)),
        blur_px=float(np.exp(state.log_blur)),
        contrast=contrast,
        sharpness=sharpness,
        supported=int(good.sum()),
        stretches=len(weights),
    )


def _sharpness(pixels: _Pixels, state: _State, good: NDArray[np.bool_]) -> tuple[float, float]:
    depth = (pixels.depth + state.offset - state.turn * pixels.along)[good]
    grey, weight = pixels.grey[good], pixels.weight[good]
    deepest = float(np.clip(0.8 * pixels.half_width, 2.2, 4.0))
    means = []
    for middle in (-1.0, 1.0, deepest):
        near = weight * (np.abs(depth - middle) < 0.6)
        count = near.sum(axis=1)
        means.append(np.where(count > 0, (grey * near).sum(axis=1) / np.maximum(count, 1), np.nan))
    changes = [np.abs(means[i + 1] - means[i]) for i in (0, 1)]
    changes = [c[np.isfinite(c)] for c in changes]
    if not all(len(c) for c in changes):
        return 0.0, 0.0
    edge, beyond = (float(np.median(c)) for c in changes)
    return edge, edge / max(edge + beyond, 1e-9)
