"""What a camera sees across the occluding edges of cylinders: grey values as a function of where each edge is.

Outside, the background is a level and a slope per stretch of the edge. Inside, a shaded cylinder changes towards its
limb like the square root of the distance from it, which drags an ordinary step edge inwards; so the model has that
term. Both are blurred by the same Gaussian. Grey values are used where the pixels are, nothing is interpolated.

Single precision is enough to find the edge; where the pixels are given in double precision the model is worked out so.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import gamma, ndtr, pbdv

Float = NDArray[np.float64]
Real = NDArray[np.floating]
"""In single or double precision."""

_LOG_BLUR_RANGE = (float(np.log(0.4)), float(np.log(1.2)))
"""A pixel alone blurs by 0.3 px. Edges softer than 1.2 px are shading or out of focus."""
_USUAL_LOG_BLUR = float(np.log(0.6))
_KINKS_PX = np.array((0.0, 1.8, 3.2))[:, None, None]
"""Depths at which the shading may change its slope; the first is the edge."""
SHADING_TERMS = 3 + len(_KINKS_PX)
_USUAL = np.array((0.0, 0.0, _USUAL_LOG_BLUR, *[0.0] * SHADING_TERMS))
_LONGEST_STEP = np.array((0.7, 0.03, 0.3, *[np.inf] * SHADING_TERMS))
_TREND_PX = 40.0
_BLOCK = 128
"""Stretches that are worked on together: so many fit into a processor's cache."""


@dataclass(frozen=True, slots=True)
class EdgeStates:
    """What is fitted, of all edges together."""

    values: Float
    """(edges, parameters): offset, turn, log blur, and coefficients of `_shading`, grey values at full depth."""

    @classmethod
    def start(cls, edges: int) -> "EdgeStates":
        return cls(np.tile(_USUAL, (edges, 1)))

    @property
    def offset(self) -> Float:
        """(edges,), px outwards"""
        return self.values[:, 0]

    @property
    def turn(self) -> Float:
        return self.values[:, 1]

    @property
    def log_blur(self) -> Float:
        return self.values[:, 2]

    @property
    def shading(self) -> Float:
        """(edges, terms)"""
        return self.values[:, 3:]

    def moved(self, step: Float) -> "EdgeStates":
        """By steps (edges, parameters), but by no more than what is plausible."""
        values = self.values + np.minimum(np.maximum(step, -_LONGEST_STEP), _LONGEST_STEP)
        values[:, 2] = np.minimum(np.maximum(values[:, 2], _LOG_BLUR_RANGE[0]), _LOG_BLUR_RANGE[1])
        return EdgeStates(values)

    def only(self, edges: NDArray[np.bool_]) -> "EdgeStates":
        return EdgeStates(self.values[edges])

    def where(self, taken: NDArray[np.bool_], other: "EdgeStates") -> "EdgeStates":
        """This state for the edges that are taken, the other's for the rest."""
        return EdgeStates(np.where(taken[:, None], self.values, other.values))

    def deviation(self) -> Float:
        """From the priors' means, (edges, parameters)."""
        return self.values - _USUAL


@dataclass(frozen=True, slots=True)
class EdgePixels:
    """Pixels by stretch, padded: shape (stretches, n) each. The stretches of an edge follow each other."""

    grey: Real
    depth: Real
    """Distance from the first guess of the edge, px, positive inside the pipe."""
    along: Real
    weight: Real
    """1, or 0 for padding."""
    half_width: Float
    """(stretches,), half the pipe's width."""
    evenness: Float
    """(stretches,), white noise over how much the pipe's own grey value varies from stretch to stretch."""
    edge: NDArray[np.int64]
    """(stretches,), which edge a stretch belongs to."""
    noise: Float
    """(stretches,), white noise of the image, grey values."""

    @property
    def edges(self) -> int:
        """How many there are."""
        return int(self.edge[-1]) + 1

    def double(self) -> "EdgePixels":
        """The same in double precision."""
        grey, depth, along, weight = (t.astype(np.float64) for t in (self.grey, self.depth, self.along, self.weight))
        return replace(self, grey=grey, depth=depth, along=along, weight=weight)

    def rows(self, start: int, stop: int) -> "EdgePixels":
        """Some stretches, with the numbers of the edges as they are."""
        part = slice(start, stop)
        grey, depth, along, weight = (t[part] for t in (self.grey, self.depth, self.along, self.weight))
        half_width, evenness = self.half_width[part], self.evenness[part]
        return EdgePixels(grey, depth, along, weight, half_width, evenness, self.edge[part], self.noise[part])

    def only(self, edges: NDArray[np.bool_]) -> "EdgePixels":
        """The pixels of some edges, (edges,), which are numbered anew."""
        keep = edges[self.edge]
        grey, depth, along, weight = (t[keep] for t in (self.grey, self.depth, self.along, self.weight))
        number = (np.cumsum(edges) - 1)[self.edge[keep]]
        half_width, evenness, noise = self.half_width[keep], self.evenness[keep], self.noise[keep]
        return EdgePixels(grey, depth, along, weight, half_width, evenness, number, noise)


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

    def only(self, stretches: NDArray[np.bool_]) -> "EdgeModel":
        """The model of some stretches."""
        return EdgeModel(*(getattr(self, name)[stretches] for name in _TABLES))

    def where(self, taken: NDArray[np.bool_], other: "EdgeModel") -> "EdgeModel":
        """This model for the stretches that are taken, the other's for the rest."""
        if taken.all():
            return self
        tables = [getattr(other, name).copy() for name in _TABLES]
        for table, name in zip(tables, _TABLES, strict=True):
            table[taken] = getattr(self, name)[taken]
        return EdgeModel(*tables)


_TABLES = ("normal", "score", "shift", "shift_sigma", "squares", "variance")
_OUTER, _RAMP, _INNER, _RESIDUAL, _BY_STATE = 0, 1, 2, 3, 4
"""Rows of a stretch over its pixels: its own levels, what they leave over, and derivatives by the state."""
_ROWS = _BY_STATE + 3 + SHADING_TERMS
_FROM, _TO, _PER_SIGMA = -12.0, 24.0, 128
"""Places of the table of blurred functions, in sigmas of the blur: the nearest one and a slope are enough."""


@dataclass(frozen=True, slots=True)
class _Blurred:
    """Functions blurred by a Gaussian of sigma 1, by place."""

    step: Real
    """Of a step at 0: the normal distribution."""
    root: Real
    """Of sqrt(max(x, 0)): a parabolic cylinder function (DLMF 12.5.1)."""
    slope: Real
    """Its derivative."""

    @classmethod
    def table(cls) -> "_Blurred":
        x = np.linspace(_FROM, _TO, int((_TO - _FROM) * _PER_SIGMA) + 1)
        inside = np.maximum(x, -6.0)
        root = gamma(1.5) / np.sqrt(2 * np.pi) * np.exp(-0.25 * inside**2) * pbdv(-1.5, -inside)[0]
        return cls(ndtr(x), root, np.gradient(root, x))

    def single(self) -> "_Blurred":
        return _Blurred(*(t.astype(np.float32) for t in (self.step, self.root, self.slope)))


_DOUBLE = _Blurred.table()
_SINGLE = _DOUBLE.single()


def linearised(pixels: EdgePixels, state: EdgeStates) -> EdgeModel:
    """Model and derivatives of all edges at a state."""
    if len(pixels.edge) <= _BLOCK:
        return _linearised(pixels, state)
    blocks = [_linearised(pixels.rows(i, i + _BLOCK), state) for i in range(0, len(pixels.edge), _BLOCK)]
    return EdgeModel(*(np.concatenate([getattr(block, name) for block in blocks]) for name in _TABLES))


def _linearised(pixels: EdgePixels, state: EdgeStates) -> EdgeModel:
    edge, weight, precision = pixels.edge, pixels.weight, pixels.grey.dtype
    places = _Places.at(pixels, state)
    shading = _shading(places, pixels)
    coefficients = state.shading[edge, None, :].astype(precision)
    shade, by_depth, by_width = (coefficients @ shading.transpose(0, 2, 1, 3))[:, :, 0]
    rows = np.empty((_ROWS, *weight.shape), precision)
    outside = np.subtract(1, places.step[0], out=rows[_OUTER])
    np.subtract(places.spread[0], places.depth[0] * outside, out=rows[_RAMP])
    rows[_INNER] = places.step[0]
    rows[:_RESIDUAL] *= weight
    wanted = np.multiply(pixels.grey - shade, weight, out=rows[_RESIDUAL])
    level, inverse = _levels(rows, pixels.evenness)
    wanted -= (level.astype(precision)[:, None, :] @ rows[:_RESIDUAL].transpose(1, 0, 2))[:, 0]
    jump, slope = (t.astype(precision)[:, None] for t in (level[:, 2] - level[:, 0], level[:, 1]))
    by_tau = np.add(jump * places.density - slope * outside, by_depth, out=rows[_BY_STATE])
    np.multiply(by_tau, -pixels.along, out=rows[_BY_STATE + 1])
    np.add(slope * places.spread[0] - jump * places.widening, by_width, out=rows[_BY_STATE + 2])
    rows[_BY_STATE + 3 :] = shading[0]
    rows[_BY_STATE:] *= weight
    return _projected(rows, level, inverse, pixels)


def _levels(rows: Real, evenness: Float) -> tuple[Float, Float]:
    """Levels of every stretch, (stretches, 3), and their inverse normal equations."""
    basis = rows[: _RESIDUAL + 1].transpose(1, 0, 2)
    products = (basis @ basis.transpose(0, 2, 1)).astype(np.float64)
    gram: Float = products[:, :3, :3]
    # The pipe's grey value goes on along it, to within its own stains: one row more holds each stretch's deviation.
    gram[:, 2, 2] += evenness**2
    inverse: Float = np.asarray(np.linalg.inv(gram + 1e-9 * np.eye(3)), np.float64)
    return (inverse @ products[:, :3, 3:])[..., 0], inverse


def _projected(rows: Real, level: Float, inverse: Float, pixels: EdgePixels) -> EdgeModel:
    """The model from its rows, (rows, stretches, n): products of each with each."""
    by_stretch = rows.transpose(1, 0, 2)
    products = (by_stretch @ by_stretch.transpose(0, 2, 1)).astype(np.float64)
    crossed = products[:, :_RESIDUAL, _BY_STATE:]
    normal = products[:, _BY_STATE:, _BY_STATE:] - crossed.transpose(0, 2, 1) @ (inverse @ crossed)
    score = products[:, _BY_STATE:, _RESIDUAL]  # residuals are free of the levels: so need not be the derivatives
    freedom = np.maximum(pixels.weight.sum(axis=1) - 4, 1)
    squares = products[:, _RESIDUAL, _RESIDUAL] + (pixels.evenness * level[:, 2]) ** 2
    variance = np.maximum(squares / freedom, pixels.noise**2)
    strength = np.maximum(normal[:, 0, 0], 1e-9)
    return EdgeModel(normal, score, score[:, 0] / strength, np.sqrt(variance / strength), squares, variance)


@dataclass(frozen=True, slots=True)
class _Places:
    """Where pixels are across the edge, and blurred functions there.

    Shape (kinks, stretches, n) by the distance from each kink of the shading, the first of which is the edge itself;
    (stretches, n) of the edge alone.
    """

    depth: Real
    """Within each kink, px."""
    blur: Real
    """(stretches, 1), px."""
    step: Real
    spread: Real
    """Derivative of a ramp by log blur."""
    density: Real
    """Derivative of the edge's step by depth."""
    widening: Real
    """Its derivative by log blur, negative."""
    root: Real
    slope: Real

    @classmethod
    def at(cls, pixels: EdgePixels, state: EdgeStates) -> "_Places":
        edge, precision = pixels.edge, pixels.grey.dtype
        table = _SINGLE if precision == np.float32 else _DOUBLE
        offset, turn, blur = (
            t[edge, None].astype(precision) for t in (state.offset, state.turn, np.exp(state.log_blur))
        )
        tau = pixels.depth - turn * pixels.along
        tau += offset
        depth = tau - _KINKS_PX.astype(precision)
        x = depth * (1 / blur)
        bell = _bell(x)
        cell, left = _nearest(x)
        slope = table.slope.take(cell[0], mode="clip")
        root = table.root.take(cell[0], mode="clip") + left[0] * slope
        left *= bell
        step = table.step.take(cell, mode="clip")
        step += left
        return cls(depth, blur, step, bell * blur, bell[0] * (1 / blur), bell[0] * x[0], root, slope)


def _nearest(x: Real) -> tuple[NDArray[np.intp], Real]:
    """The nearest place of the table, and how far off it is; beyond the table there is nothing but straight lines."""
    place = x * _PER_SIGMA
    place -= _FROM * _PER_SIGMA
    cell = np.rint(place)
    place -= cell
    place *= 1 / _PER_SIGMA
    return cell.astype(np.intp), place


def _bell(x: Real) -> Real:
    bell = x * x
    bell *= -0.5
    np.exp(bell, out=bell)
    bell *= 1 / np.sqrt(2 * np.pi)
    return bell


def _shading(places: _Places, pixels: EdgePixels) -> Real:
    """What the shading inside may look like, blurred: terms, their derivatives by depth and by log blur, shape
    (3, terms, stretches, n).

    The root term is the face that turns away from the viewer at the limb; a slope, and kinks where the pipe's own
    shadow or a highlight begins, stand for the rest.
    """
    tau, blur = places.depth[0], places.blur
    shading = np.empty((3, SHADING_TERMS, *tau.shape), tau.dtype)
    terms, by_depth, by_width = shading
    terms[0], by_depth[0] = places.step[0], places.density
    np.negative(places.widening, out=by_width[0])
    np.multiply(shading[:, 0], pixels.along * (1 / _TREND_PX), out=shading[:, 1])
    one = (1 / pixels.half_width).astype(tau.dtype)[:, None]
    scale = np.maximum(tau * -one, -1)
    np.minimum(scale, 0, out=scale)
    scale += 2
    scale *= blur * one
    np.sqrt(scale, out=scale)
    root = np.multiply(places.root, scale, out=terms[2])
    scale *= 1 / blur
    slope = np.multiply(places.slope, scale, out=by_depth[2])
    np.subtract(0.5 * root, slope * tau, out=by_width[2])
    kinks = slice(3, None)
    np.multiply(places.step, one, out=by_depth[kinks])
    np.multiply(places.spread, one, out=by_width[kinks])
    np.multiply(places.depth, by_depth[kinks], out=terms[kinks])
    terms[kinks] += by_width[kinks]
    return shading
