"""Sub-pixel fit of the occluding edges of a pipe, see `limb_model` for what they look like."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..covariance import larger
from ..median import median
from .limb_fit import LAST_STAGE, Stretches, converged, information, stretch_weights
from .limb_model import EdgeModel, EdgePixels, EdgeStates, linearised

Float = NDArray[np.float64]
Real = NDArray[np.floating]

_STRETCH_PX = 5.0
_WIDE, _NARROW = (4.5, 5.0), (3.0, 2.5)
"""How far outside and inside the edge a fit looks, px."""


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
class EdgeSeed:
    """Where an occluding edge is looked for."""

    line: Float
    """(3,), where the edge is to 2 px, unit normal, positive outside."""
    foot_px: Float
    """(2,), a point of that line; the result's covariance refers to the fitted edge beside it."""
    span: tuple[float, float]
    """Part of the line to use, px from the foot along (-l1, l0)."""
    half_width_px: float
    """Half the pipe's width in the image."""


@dataclass(frozen=True, slots=True)
class Window:
    """The pixels about a place of an image."""

    grey: Real
    """(n,)"""
    px: Float
    """(n, 2), ideal."""
    noise: float
    """White noise of the image, grey values."""


Looked = Sequence[tuple[Window, EdgeSeed]]
"""Edges, and the pixels that each is looked for in."""


def fit_edges(looked: Looked) -> list[EdgeFit | None]:
    """Fits occluding edges, each near its seed; all of them at once, because one alone is too little work for NumPy.

    Returns:
        Per edge; None where the grey values do not hold such an edge. What is to be used as a measurement wants
        `confirmed_edges` as well.
    """
    found = _fitted(looked, _WIDE)
    return [None if one is None else _result(seed, one) for (_, seed), one in zip(looked, found, strict=True)]


def confirmed_edges(looked: Looked, fits: Sequence[EdgeFit]) -> list[EdgeFit | None]:
    """The same edges fitted in a narrower window: what the two do not agree on is the model's error, not noise.

    Returns:
        The given fits with a covariance that holds the disagreement; None where the narrow window finds no edge.
    """
    found = _fitted(looked, _NARROW)  # from the seeds again: who ends elsewhere is unsure
    return [
        None if one is None else replace(fit, covariance=fit.covariance + _disagreement(seed, fit, one.state))
        for (_, seed), fit, one in zip(looked, fits, found, strict=True)
    ]


@dataclass(frozen=True, slots=True)
class _Converged:
    """One edge at the end of a fit."""

    pixels: EdgePixels
    state: EdgeStates
    linear: EdgeModel
    weights: Float
    """(stretches,)"""


def _fitted(looked: Looked, reach_px: tuple[float, float]) -> list[_Converged | None]:
    """Every edge where its fit converges, by the pixels so far outside and inside."""
    gathered = [_gather(window, seed, reach_px) for window, seed in looked]
    parts = [table for table in gathered if table is not None]
    if not parts:
        return [None] * len(looked)
    pixels = _joined(parts)
    state, good = converged(pixels)
    pixels = pixels.double()
    linear = linearised(pixels, state)
    weights = stretch_weights(Stretches.of(pixels.edge), linear)
    number = iter(range(len(parts)))
    found: list[_Converged | None] = []
    for table in gathered:
        this = None if table is None else next(number)
        if this is None or not good[this]:
            found.append(None)
        else:
            one = np.arange(len(good)) == this
            rows = one[pixels.edge]
            found.append(_Converged(pixels.only(one), state.only(one), linear.only(rows), weights[rows]))
    return found


def _disagreement(seed: EdgeSeed, fit: EdgeFit, other: EdgeStates) -> Float:
    """Covariance (2, 2) of what a fit in another window says otherwise about offset and turn."""
    offset = float(fit.foot_px @ seed.line[:2] + seed.line[2])
    turn = float(np.arctan2(seed.line[0] * fit.line[1] - seed.line[1] * fit.line[0], fit.line[:2] @ seed.line[:2]))
    return np.diag([(offset - float(other.offset[0])) ** 2, (turn - float(other.turn[0])) ** 2])


def _gather(window: Window, seed: EdgeSeed, reach_px: tuple[float, float]) -> EdgePixels | None:
    """The pixels on both sides of a seed, by stretch."""
    grey, px, noise = window.grey, window.px, max(window.noise, 0.3)
    line, span = seed.line, seed.span
    outside, deepest = reach_px
    inside = float(np.clip(0.8 * seed.half_width_px, 2.0, deepest)) + 0.5
    depth = -(px @ line[:2] + line[2])
    near = np.flatnonzero((depth > -outside) & (depth < inside))
    along = (px[near] - seed.foot_px) @ np.array([-line[1], line[0]])
    keep = (along >= span[0]) & (along < span[1]) & np.isfinite(grey[near])
    grey, depth, along = grey[near[keep]], depth[near[keep]], along[keep]
    number = max(1, round((span[1] - span[0]) / _STRETCH_PX))
    stretch = np.minimum(((along - span[0]) / (span[1] - span[0]) * number).astype(int), number - 1)
    count = np.bincount(stretch, minlength=number)
    full = count >= 0.6 * _STRETCH_PX * (inside + outside)
    if full.sum() < 2:
        return None
    order = np.argsort(stretch, kind="stable")
    place = np.arange(len(order)) - np.repeat(np.cumsum(count) - count, count)
    table = np.zeros((4, number, count.max()), np.float32)
    for i, values in enumerate((grey, depth, along, np.ones(len(grey)))):
        table[i, stretch[order], place] = values[order]
    values, depths, places, weight = table[:, full]
    evenness = noise / _stains(values, depths, places, weight, inside)
    half_width, evenness, noises = (np.full(len(values), v) for v in (seed.half_width_px, evenness, noise))
    return EdgePixels(values, depths, places, weight, half_width, evenness, np.zeros(len(values), np.int64), noises)


def _joined(parts: list[EdgePixels]) -> EdgePixels:
    """Several edges in one table."""
    count = [len(part.edge) for part in parts]
    ends = np.cumsum(count)
    table = np.zeros((4, ends[-1], max(part.grey.shape[1] for part in parts)), np.float32)
    for part, end in zip(parts, ends, strict=True):
        stretches, n = part.grey.shape
        table[:, end - stretches : end, :n] = part.grey, part.depth, part.along, part.weight
    half_width, evenness, noise = (
        np.concatenate(t) for t in zip(*((p.half_width, p.evenness, p.noise) for p in parts), strict=True)
    )
    grey, depth, along, weight = table
    edge = np.repeat(np.arange(len(parts)), count)
    return EdgePixels(grey, depth, along, weight, half_width, evenness, edge, noise)


def _stains(grey: Real, depth: Real, along: Real, weight: Real, inside: float) -> float:
    """How much the pipe's grey value varies along it beyond a trend, well inside the edge; at least half a level."""
    deep = weight * (depth > min(2.2, inside - 1.5))
    count = deep.sum(axis=1)
    seen = count > 3
    if seen.sum() < 4:
        return 20.0
    level, place = ((deep * a).sum(axis=1)[seen] / count[seen] for a in (grey, along))
    left = level - np.polyval(np.polyfit(place, level, 1), place)
    return max(1.4826 * median(np.abs(left)), 0.5)


def _covariance(one: _Converged) -> Float:
    """Of (offset, turn): texture behind the pipe correlates the residuals of one stretch, so each stretch counts as one
    observation (cluster-robust sandwich), and no less than what independent pixels would give."""
    scaled, weights = one.weights / one.linear.variance, one.weights
    scores = scaled[:, None] * one.linear.score
    inverse = np.linalg.inv(np.tensordot(scaled, one.linear.normal, 1) + np.diag(information(LAST_STAGE)))
    effective = weights.sum() ** 2 / (weights**2).sum()
    sandwich = inverse @ (scores.T @ scores) @ inverse * effective / max(effective - 2.0, 0.5)
    return larger(np.asarray(inverse[:2, :2], np.float64), sandwich[:2, :2])


def _result(seed: EdgeSeed, one: _Converged) -> EdgeFit | None:
    """One edge's fit."""
    line, foot_px, pixels, state = seed.line, seed.foot_px, one.pixels, one.state
    good = (one.linear.shift_sigma < 0.5) & (one.weights > 0.1)
    if good.sum() < 2:
        return None
    offset, turn = float(state.offset[0]), float(state.turn[0])
    cosine, sine = np.cos(turn), np.sin(turn)
    normal = np.array([line[0] * cosine - line[1] * sine, line[0] * sine + line[1] * cosine])
    foot = foot_px + (offset - foot_px @ line[:2] - line[2]) * line[:2]
    inside = pixels.weight > 0
    start = np.where(inside, pixels.along, np.inf).min(axis=1)[good].min()
    end = np.where(inside, pixels.along, -np.inf).max(axis=1)[good].max()
    contrast, sharpness = _sharpness(pixels, state, good)
    return EdgeFit(
        line=np.array([normal[0], normal[1], -normal @ foot]),
        foot_px=foot,
        covariance=_covariance(one),
        extent=(float(start), float(end)),
        blur_px=float(np.exp(state.log_blur[0])),
        contrast=contrast,
        sharpness=sharpness,
        supported=int(good.sum()),
        stretches=len(one.weights),
    )


def _sharpness(pixels: EdgePixels, state: EdgeStates, good: NDArray[np.bool_]) -> tuple[float, float]:
    depth = (pixels.depth + state.offset - state.turn * pixels.along)[good]
    grey, weight = pixels.grey[good], pixels.weight[good]
    deepest = float(np.clip(0.8 * pixels.half_width[0], 2.2, 4.0))
    means = []
    for middle in (-1.0, 1.0, deepest):
        near = weight * (np.abs(depth - middle) < 0.6)
        count = near.sum(axis=1)
        means.append(np.where(count > 0, (grey * near).sum(axis=1) / np.maximum(count, 1), np.nan))
    changes = [np.abs(means[i + 1] - means[i]) for i in (0, 1)]
    changes = [c[np.isfinite(c)] for c in changes]
    if not all(len(c) for c in changes):
        return 0.0, 0.0
    edge, beyond = (median(c) for c in changes)
    return edge, edge / max(edge + beyond, 1e-9)
