"""Which two edges are the outline of the pipe: hypotheses, scored as log-likelihoods."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .edges import EdgeLine

Float = NDArray[np.float64]

_USUAL_WIDTH = (np.log(0.06), 0.8)
"""Diameter over distance of a pipe that somebody picks to be cut: logarithm's mean and sigma (0.01 to 0.3)."""


@dataclass(frozen=True, slots=True)
class OutlinePrior:
    """What is known of an outline before the image is looked at, in ideal pixels."""

    centre_px: Float
    """(2,), a point near the middle between the edges."""
    middle_sigma_px: float
    """How far the middle may be off, across the pipe."""
    half_width_px: float | None = None
    half_width_sigma_px: float = 0.0
    direction_rad: float | None = None
    """Direction of the pipe's axis in the image, modulo pi."""
    direction_sigma_rad: float = 0.0


@dataclass(frozen=True, slots=True)
class PairLimits:
    """Widths and shapes that are considered."""

    thinnest_px: float = 4.0
    widest_px: float = 110.0
    nearest_vanishing_f: float = 0.35
    """The edges meet no nearer than this many focal lengths (a pipe seen nearly along its axis is refused)."""


@dataclass(frozen=True, slots=True)
class EdgePair:
    """Two edges that might be the outline."""

    first: EdgeLine
    second: EdgeLine
    lines: Float
    """(2, 3), positive outside, in ideal pixels."""
    direction_rad: float
    """Of the bisector, modulo pi."""
    width_px: float
    middle_px: float
    """Signed distance of the prior's centre from the middle, across the pipe."""
    score: float
    """Log-likelihood by geometry and support."""
    surprise: float
    """Chi-square of middle and width (and direction) against the prior."""
    region: float = 0.0
    """Log-likelihood ratio that a pipe fills the space between, see `surface.region_score`."""


def edge_pairs(
    lines: list[EdgeLine], prior: OutlinePrior, focal_px: float, limits: PairLimits, most: int | None = None
) -> list[EdgePair]:
    """The pairs with the prior's centre between them that a cylinder could show, best first, at most so many."""
    if len(lines) < 2:
        return []
    first, second = np.triu_indices(len(lines), 1)
    angle, rho, evidence = np.array([(line.angle, line.rho, line.evidence) for line in lines]).T
    turn, other = _aligned(angle[second] - angle[first], rho[second])
    bisector = angle[first] + 0.5 * turn
    sides = np.stack((rho[first], other)) / np.cos(0.5 * turn)
    width, middle = np.abs(sides[1] - sides[0]), 0.5 * (sides[0] + sides[1])
    possible = np.abs(turn) <= np.deg2rad(25.0)
    possible &= (limits.thinnest_px <= width) & (width <= limits.widest_px)
    possible &= np.abs(middle) <= np.minimum(4 * prior.middle_sigma_px, 0.45 * width)
    possible &= np.abs(turn) <= width / (limits.nearest_vanishing_f * focal_px) + np.deg2rad(2.0)
    surprise = _surprise(width, middle, bisector + 0.5 * np.pi, focal_px, prior)
    score = 0.5 * (evidence[first] + evidence[second] - surprise)
    best = np.flatnonzero(possible)
    best = best[np.argsort(-score[best], kind="stable")][:most]
    edges = _outlines(angle[first[best]], rho[first[best]], turn[best], other[best], prior.centre_px, middle[best])
    return [
        EdgePair(
            lines[first[i]], lines[second[i]], both, float(np.mod(bisector[i] + 0.5 * np.pi, np.pi)),
            float(width[i]), float(middle[i]), float(score[i]), float(surprise[i]),
        )
        for i, both in zip(best, edges, strict=True)
    ]  # fmt: skip


def _aligned(turn: Float, rho: Float) -> tuple[Float, Float]:
    """Turns from one normal to another, within a right angle, and the other's rho with its normal turned alike."""
    back, forth = turn > np.pi / 2, turn <= -np.pi / 2
    return turn - np.pi * back + np.pi * forth, np.where(back | forth, -rho, rho)


def _outlines(angle: Float, rho: Float, turn: Float, other: Float, centre: Float, middle: Float) -> Float:
    """Both lines of each pair, (pairs, 2, 3), positive outside."""
    out = np.stack((_lines(angle, rho, centre), _lines(angle + turn, other, centre)), axis=1)
    bisector = angle + 0.5 * turn
    between = centre + middle[:, None] * np.column_stack((np.cos(bisector), np.sin(bisector)))
    inside = np.einsum("pij,pj->pi", out, np.column_stack((between, np.ones(len(between)))))
    return out * -np.sign(inside)[..., None]


def _lines(angle: Float, rho: Float, centre: Float) -> Float:
    normal = np.column_stack((np.cos(angle), np.sin(angle)))
    return np.column_stack((normal, -normal @ centre - rho))


def _surprise(width: Float, middle: Float, direction: Float, focal_px: float, prior: OutlinePrior) -> Float:
    chi2 = (middle / prior.middle_sigma_px) ** 2
    if prior.half_width_px is None:
        wide = np.log(np.maximum(width, 1e-9) / focal_px)
        chi2 += ((wide - _USUAL_WIDTH[0]) / _USUAL_WIDTH[1]) ** 2
    else:
        chi2 += ((0.5 * width - prior.half_width_px) / prior.half_width_sigma_px) ** 2
    if prior.direction_rad is not None:
        turn = np.mod(direction - prior.direction_rad + np.pi / 2, np.pi) - np.pi / 2
        chi2 += (turn / prior.direction_sigma_rad) ** 2
    return chi2
