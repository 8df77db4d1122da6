"""Levenberg-Marquardt for occluding edges, many of them side by side, see `limb_model` for what they look like."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .limb_model import SHADING_TERMS, EdgeModel, EdgePixels, EdgeStates, linearised

Float = NDArray[np.float64]

_ITERATIONS, _STAGE = 16, 4
"""Steps altogether, and of each early stage."""
LAST_STAGE = 2
_FARTHEST_PX, _FARTHEST_RAD = 2.6, 0.12
"""The fit may move the line so far: shading inside can be steeper than the edge that a seed is taken for."""
_SMALL_PX, _SMALL_RAD = 5e-3, 2e-4
"""Steps that are of no account."""
_SHADING_RANGE = 80.0
"""Prior sigma of a shading term, grey values over half the pipe's width."""


@dataclass(frozen=True, slots=True)
class Stretches:
    """Which stretches an edge has."""

    number: NDArray[np.int64]
    """(edges, most), of its stretches; any where there are fewer."""
    there: NDArray[np.bool_]
    """(edges, most)"""
    count: NDArray[np.int64]
    """(edges,)"""
    edge: NDArray[np.int64]
    """(stretches,)"""
    each: Float
    """(edges, stretches), 1 where a stretch is the edge's."""

    @classmethod
    def of(cls, edge: NDArray[np.int64]) -> "Stretches":
        """Those of edges whose stretches follow each other, shape (stretches,)."""
        count = np.bincount(edge)
        starts = np.cumsum(count) - count
        place = np.arange(count.max())
        there = place < count[:, None]
        each = (np.arange(len(count))[:, None] == edge).astype(np.float64)
        return cls(np.where(there, starts[:, None] + place, 0), there, count, edge, each)

    def table(self, values: Float) -> Float:
        """Values by edge, (edges, most), infinite where there are none."""
        return np.where(self.there, values[self.number], np.inf)


@dataclass(frozen=True, slots=True)
class _Running:
    """Edges whose fit goes on."""

    number: NDArray[np.int64]
    """Which of all edges."""
    pixels: EdgePixels
    stretches: Stretches
    state: EdgeStates
    linear: EdgeModel
    weights: Float
    """(stretches,)"""
    damping: Float

    @classmethod
    def start(cls, pixels: EdgePixels) -> "_Running":
        edges = pixels.edges
        state = EdgeStates.start(edges)
        linear, weights = linearised(pixels, state), np.ones(len(pixels.edge))
        number = np.arange(edges)
        return cls(number, pixels, Stretches.of(pixels.edge), state, linear, weights, np.full(edges, 1e-3))

    def only(self, edges: NDArray[np.bool_]) -> "_Running":
        """The fits of some of these edges."""
        if edges.all():
            return self
        rows, pixels = edges[self.pixels.edge], self.pixels.only(edges)
        stretches = Stretches.of(pixels.edge) if edges.any() else self.stretches
        state, linear, weights = self.state.only(edges), self.linear.only(rows), self.weights[rows]
        return _Running(self.number[edges], pixels, stretches, state, linear, weights, self.damping[edges])

    def step(self, prior: Float) -> Float:
        """(edges, parameters)"""
        terms = len(prior)
        scaled = self.stretches.each * (self.weights / self.linear.variance)
        normal = (scaled @ self.linear.normal.reshape(-1, terms**2)).reshape(-1, terms, terms) + np.diag(prior)
        gradient = scaled @ self.linear.score - prior * self.state.deviation()
        damped = normal + self.damping[:, None, None] * (np.eye(terms) * normal)
        return np.asarray(np.linalg.solve(damped, gradient[..., None])[..., 0], np.float64)

    def gone_on(self, trial: EdgeStates, prior: Float) -> tuple["_Running", NDArray[np.bool_]]:
        """With the trial for the edges that it is better for, and for which."""
        proposal = linearised(self.pixels, trial)
        less = self.linear.squares - proposal.squares
        gain = self.stretches.each @ (self.weights / self.linear.variance * less)
        gain += (self.state.deviation() ** 2 - trial.deviation() ** 2) @ prior
        better = gain >= 0
        damping = np.where(better, np.maximum(self.damping / 5.0, 1e-4), self.damping * 10.0)
        taken = better[self.pixels.edge]
        linear = proposal.where(taken, self.linear)
        weights = np.where(taken, stretch_weights(self.stretches, linear), self.weights)
        state = trial.where(better, self.state)
        return replace(self, state=state, linear=linear, weights=weights, damping=damping), better


def converged(pixels: EdgePixels) -> tuple[EdgeStates, NDArray[np.bool_]]:
    """Levenberg-Marquardt in three stages (see `information`), and which edges did not run away."""
    good = np.ones(pixels.edges, bool)
    final = EdgeStates.start(len(good)).values
    running = _Running.start(pixels)
    for iteration in range(_ITERATIONS):
        prior = information(iteration // _STAGE)
        step = running.step(prior)
        trial = running.state.moved(step)
        near = (np.abs(trial.offset) <= _FARTHEST_PX) & (np.abs(trial.turn) <= _FARTHEST_RAD)
        good[running.number[~near]] = False
        running, trial, step = running.only(near), trial.only(near), step[near]
        if not len(running.number):
            break
        running, better = running.gone_on(trial, prior)
        final[running.number] = running.state.values
        lost = better & (running.stretches.each @ running.weights < 1.5)
        good[running.number[lost]] = False
        still = (np.abs(step[:, 0]) < _SMALL_PX) & (np.abs(step[:, 1]) < _SMALL_RAD)
        running = running.only(~lost & ~(still & (iteration > LAST_STAGE * _STAGE)))
        if not len(running.number):
            break
    return EdgeStates(final), good


def stretch_weights(stretches: Stretches, linear: EdgeModel) -> Float:
    """Tukey weights of the stretches by where each alone would put their edge."""
    shift, count, edge = stretches.table(linear.shift), stretches.count, stretches.edge
    order = np.argsort(shift, axis=1)
    known = np.where(stretches.there, linear.shift_sigma[stretches.number] ** -2, 0.0)
    reached = np.cumsum(np.take_along_axis(known, order, axis=1), axis=1)
    halfway = np.minimum((reached < 0.5 * reached[:, -1:]).sum(axis=1), count - 1)
    every = np.arange(len(count))
    middle = shift[every, order[every, halfway]]
    off = linear.shift - middle[edge]
    ranked = np.sort(stretches.table(np.abs(off)), axis=1)
    typical = 1.4826 * 0.5 * (ranked[every, (count - 1) // 2] + ranked[every, count // 2])
    typical = np.where(count > 3, typical, 0.0)[edge]
    scale = np.sqrt(linear.shift_sigma**2 + np.clip(typical, 0.08, 0.5) ** 2)
    ratio = off / (4.0 * scale)
    return np.where(np.abs(ratio) < 1, (1 - ratio**2) ** 2, 0.0)


def information(stage: int) -> Float:
    """Of the weak priors, by parameter; early stages hold blur and kinks, so that the step is found before its
    finish."""
    shading = np.full(SHADING_TERMS, _SHADING_RANGE**-2.0)
    shading[0] = 1e-6
    if stage < LAST_STAGE:
        shading[3:] = 1e6
    return np.concatenate(((1e-9, 1e-9, 1.0 if stage >= 1 else 1e6), shading))
