"""What a camera sees across the occluding edges of cylinders: grey values as a function of where each edge is.

Outside, the background is a level and a slope per stretch of the edge. Inside, a shaded cylinder changes towards its
limb like the square root of the distance from it, which drags an ordinary step edge inwards; so the model has that
term. Both are blurred by the same Gaussian. Grey values are used where the pixels are, nothing is interpolated.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import gamma, ndtr, pbdv

Float = NDArray[np.float64]

_LOG_BLUR_RANGE = (float(np.log(0.4)), float(np.log(1.2)))
"""A pixel alone blurs by 0.3 px. Edges softer than 1.2 px are shading or out of focus."""
_USUAL_LOG_BLUR = float(np.log(0.6))
_KINKS_PX = (0.0, 1.8, 3.2)
"""Depths at which the shading may change its slope."""
SHADING_TERMS = 3 + len(_KINKS_PX)
_TREND_PX = 40.0
_BLOCK = 96
"""Stretches that are worked on together: so many fit into a processor's cache."""


@dataclass(frozen=True, slots=True)
class EdgeStates:
    """What is fitted, of all edges together, shape (edges,) each."""

    offset: Float
    turn: Float
    log_blur: Float
    shading: Float
    """(edges, terms), coefficients of `_shading`, grey values at full depth."""

    @classmethod
    def start(cls, edges: int) -> "EdgeStates":
        zero = np.zeros(edges)
        return cls(zero, zero, zero + _USUAL_LOG_BLUR, np.zeros((edges, SHADING_TERMS)))

    def moved(self, step: NDArray[np.floating]) -> "EdgeStates":
        log_blur = np.clip(self.log_blur + np.clip(step[:, 2], -0.3, 0.3), *_LOG_BLUR_RANGE)
        offset = self.offset + np.clip(step[:, 0], -0.7, 0.7)
        return EdgeStates(offset, self.turn + np.clip(step[:, 1], -0.03, 0.03), log_blur, self.shading + step[:, 3:])

    def only(self, edges: NDArray[np.bool_]) -> "EdgeStates":
        return EdgeStates(self.offset[edges], self.turn[edges], self.log_blur[edges], self.shading[edges])

    def where(self, taken: NDArray[np.bool_], other: "EdgeStates") -> "EdgeStates":
        """This state for the edges that are taken, the other's for the rest."""
        return EdgeStates(
            np.where(taken, self.offset, other.offset),
            np.where(taken, self.turn, other.turn),
            np.where(taken, self.log_blur, other.log_blur),
            np.where(taken[:, None], self.shading, other.shading),
        )

    def deviation(self) -> Float:
        """From the priors' means, (edges, parameters)."""
        zero = np.zeros((len(self.offset), 2))
        return np.column_stack((zero, self.log_blur - _USUAL_LOG_BLUR, self.shading))


@dataclass(frozen=True, slots=True)
class EdgePixels:
    """Pixels by stretch, padded: shape (stretches, n) each. The stretches of an edge follow each other."""

    grey: Float
    depth: Float
    """Distance from the first guess of the edge, px, positive inside the pipe."""
    along: Float
    weight: Float
    """0 for padding."""
    half_width: Float
    """(stretches,), half the pipe's width."""
    evenness: Float
    """(stretches,), white noise over how much the pipe's own grey value varies from stretch to stretch."""
    edge: NDArray[np.int64]
    """(stretches,), which edge a stretch belongs to."""
    noise: float

    @property
    def starts(self) -> NDArray[np.int64]:
        """First stretch of each edge."""
        return np.concatenate(([0], np.flatnonzero(self.edge[1:] != self.edge[:-1]) + 1))

    def summed(self, values: Float) -> Float:
        """Per edge, (stretches, ...) to (edges, ...)."""
        return np.add.reduceat(values, self.starts, axis=0)

    def rows(self, start: int, stop: int) -> "EdgePixels":
        """Some stretches, with the numbers of the edges as they are."""
        part = slice(start, stop)
        grey, depth, along, weight = (t[part] for t in (self.grey, self.depth, self.along, self.weight))
        half_width, evenness = self.half_width[part], self.evenness[part]
        return EdgePixels(grey, depth, along, weight, half_width, evenness, self.edge[part], self.noise)

    def only(self, edges: NDArray[np.bool_]) -> "EdgePixels":
        """The pixels of some edges, (edges,), which are numbered anew."""
        keep = edges[self.edge]
        grey, depth, along, weight = (t[keep] for t in (self.grey, self.depth, self.along, self.weight))
        number = (np.cumsum(edges) - 1)[self.edge[keep]]
        return EdgePixels(grey, depth, along, weight, self.half_width[keep], self.evenness[keep], number, self.noise)


@dataclass(frozen=True, slots=True)
class EdgeModel:
    """Normal equations of every stretch at a state, its own levels projected out: k = 3 + shading terms."""

    normal: Float
    """(stretches, k, k), J^T J by offset, turn, log blur, shading."""
    score: Float
    """(stretches, k), J^T r."""
    shift: Float
    """(stretches,), where each alone would put the edge, px from the line."""
    shift_sigma: Float
    squares: Float
    """(stretches,), sum of squared residuals."""
    variance: Float

    def renewed(self, pixels: EdgePixels, state: EdgeStates, edges: NDArray[np.bool_]) -> "EdgeModel":
        """The model at another state for some edges; the others' stays."""
        if edges.all():
            return linearised(pixels, state)
        rows, part = edges[pixels.edge], linearised(pixels.only(edges), state.only(edges))
        tables = []
        for name in _TABLES:
            table = getattr(self, name).copy()
            table[rows] = getattr(part, name)
            tables.append(table)
        return EdgeModel(*tables)

    def where(self, taken: NDArray[np.bool_], other: "EdgeModel") -> "EdgeModel":
        """This model for the stretches that are taken, the other's for the rest."""
        tables = []
        for name in _TABLES:
            mine, others = getattr(self, name), getattr(other, name)
            tables.append(np.where(taken.reshape(-1, *[1] * (mine.ndim - 1)), mine, others))
        return EdgeModel(*tables)


_TABLES = ("normal", "score", "shift", "shift_sigma", "squares", "variance")


def _limb_table() -> tuple[Float, Float]:
    """sqrt(max(x, 0)) blurred by a Gaussian of sigma 1, tabulated: a parabolic cylinder function (DLMF 12.5.1)."""
    x = np.linspace(-6.0, 24.0, 1201)
    return x, gamma(1.5) / np.sqrt(2 * np.pi) * np.exp(-0.25 * x**2) * pbdv(-1.5, -x)[0]


_LIMB_X, _LIMB_Y = _limb_table()
_LIMB_SLOPE = np.gradient(_LIMB_Y, _LIMB_X)


def linearised(pixels: EdgePixels, state: EdgeStates) -> EdgeModel:
    """Model and derivatives of all edges at a state."""
    blocks = [_linearised(pixels.rows(i, i + _BLOCK), state) for i in range(0, len(pixels.edge), _BLOCK)]
    return EdgeModel(*(np.concatenate([getattr(block, name) for block in blocks]) for name in _TABLES))


def _linearised(pixels: EdgePixels, state: EdgeStates) -> EdgeModel:
    edge = pixels.edge
    blur = np.exp(state.log_blur)[edge, None]
    tau = pixels.depth + state.offset[edge, None] - state.turn[edge, None] * pixels.along
    x = tau / blur
    step, bell = ndtr(x), _bell(x)
    weight, evenness = pixels.weight, pixels.evenness
    shading, by_depth, by_width = _shading(tau, x, step, bell, pixels.along, blur, pixels.half_width[:, None])
    coefficients = state.shading[edge, None, :]
    ramp = -tau * (1 - step) + blur * bell
    basis = np.stack((1 - step, ramp, step), axis=1) * weight[:, None]
    gram = basis @ basis.transpose(0, 2, 1)
    # The pipe's grey value goes on along it, to within its own stains: one row more holds each stretch's deviation.
    gram[:, 2, 2] += evenness**2
    inverse = np.linalg.inv(gram + 1e-9 * np.eye(3))
    wanted = (pixels.grey - (coefficients @ shading)[:, 0]) * weight
    level = (inverse @ (basis @ wanted[..., None]))[..., 0]
    residual = wanted - (level[:, None, :] @ basis)[:, 0]
    jump = (level[:, 2] - level[:, 0])[:, None]
    slope = level[:, 1][:, None]
    by_tau = jump * bell / blur - slope * (1 - step) + (coefficients @ by_depth)[:, 0]
    by_blur = -jump * bell * x + slope * bell * blur + (coefficients @ by_width)[:, 0]
    jacobian = np.concatenate((np.stack((by_tau, -by_tau * pixels.along, by_blur), axis=1), shading), axis=1)
    jacobian *= weight[:, None]
    crossed = basis @ jacobian.transpose(0, 2, 1)
    normal = jacobian @ jacobian.transpose(0, 2, 1) - crossed.transpose(0, 2, 1) @ (inverse @ crossed)
    score = (jacobian @ residual[..., None])[..., 0]  # residuals are free of the levels: so need not be the derivatives
    freedom = np.maximum(weight.sum(axis=1) - 4, 1)
    squares = (residual**2).sum(axis=1) + (evenness * level[:, 2]) ** 2
    variance = np.maximum(squares / freedom, pixels.noise**2)
    strength = np.maximum(normal[:, 0, 0], 1e-9)
    return EdgeModel(normal, score, score[:, 0] / strength, np.sqrt(variance / strength), squares, variance)


def _bell(x: Float) -> Float:
    return np.exp(-0.5 * x**2) * (1 / np.sqrt(2 * np.pi))


def _shading(
    tau: Float, x: Float, step: Float, bell: Float, along: Float, blur: Float, half_width: Float
) -> tuple[Float, Float, Float]:
    """What the shading inside may look like, blurred: terms, their derivatives by depth and by log blur, shape
    (stretches, terms, n) each.

    The root term is the face that turns away from the viewer at the limb; a slope, and kinks where the pipe's own
    shadow or a highlight begins, stand for the rest.

    Args:
        x: `tau / blur`, with its normal distribution `step` and density `bell`.
    """
    terms, by_depth, by_width = (np.empty((len(tau), SHADING_TERMS, tau.shape[1])) for _ in range(3))
    here = along / _TREND_PX
    terms[:, 0], by_depth[:, 0], by_width[:, 0] = step, bell / blur, -bell * x
    for table in (terms, by_depth, by_width):
        table[:, 1] = table[:, 0] * here
    scale = np.sqrt(blur * (2 - np.clip(tau / half_width, 0, 1)) / half_width)
    root = scale * np.interp(x, _LIMB_X, _LIMB_Y)
    root_slope = scale * np.interp(x, _LIMB_X, _LIMB_SLOPE) / blur
    terms[:, 2], by_depth[:, 2], by_width[:, 2] = root, root_slope, 0.5 * root - root_slope * tau
    for i, start in enumerate(_KINKS_PX, 3):
        y = x - start / blur
        beyond, density = (step, bell) if start == 0.0 else (ndtr(y), _bell(y))
        terms[:, i] = ((tau - start) * beyond + blur * density) / half_width
        by_depth[:, i] = beyond / half_width
        by_width[:, i] = blur * density / half_width
    return terms, by_depth, by_width
