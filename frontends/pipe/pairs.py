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


def edge_pairs(lines: list[EdgeLine], prior: OutlinePrior, focal_px: float, limits: PairLimits) -> list[EdgePair]:
    """All pairs with the prior's centre between them that a cylinder could show, best first."""
    if len(lines) < 2:
        return []
    pairs = []
    for i, first in enumerate(lines):
        for second in lines[i + 1 :]:
            pair = _pair(first, second, prior, focal_px, limits)
            if pair is not None:
                pairs.append(pair)
    return sorted(pairs, key=lambda pair: -pair.score)


def _pair(
    first: EdgeLine, second: EdgeLine, prior: OutlinePrior, focal_px: float, limits: PairLimits
) -> EdgePair | None:
    turn, rho = _aligned(first, second)
    if abs(turn) > np.deg2rad(25.0):
        return None
    bisector = first.angle + 0.5 * turn
    cosine = np.cos(0.5 * turn)
    sides = np.array([first.rho, rho]) / cosine
    width = abs(sides[1] - sides[0])
    middle = 0.5 * (sides[0] + sides[1])
    if not limits.thinnest_px <= width <= limits.widest_px or abs(middle) > 4 * prior.middle_sigma_px:
        return None
    if abs(middle) > 0.45 * width:
        return None
    if abs(turn) > width / (limits.nearest_vanishing_f * focal_px) + np.deg2rad(2.0):
        return None
    surprise = _surprise(float(width), float(middle), bisector + 0.5 * np.pi, focal_px, prior)
    score = 0.5 * (first.evidence + second.evidence - surprise)
    out = np.array([_line(first.angle, first.rho, prior.centre_px), _line(first.angle + turn, rho, prior.centre_px)])
    centre = np.append(prior.centre_px + middle * np.array([np.cos(bisector), np.sin(bisector)]), 1.0)
    out *= -np.sign(out @ centre)[:, None]
    direction = float(np.mod(bisector + 0.5 * np.pi, np.pi))
    return EdgePair(first, second, out, direction, float(width), float(middle), score, surprise)


def _aligned(first: EdgeLine, second: EdgeLine) -> tuple[float, float]:
    """Turn from the first normal to the second, and the second's rho with its normal turned the same way round."""
    turn = second.angle - first.angle
    if turn > np.pi / 2:
        return turn - np.pi, -second.rho
    if turn <= -np.pi / 2:
        return turn + np.pi, -second.rho
    return turn, second.rho


def _line(angle: float, rho: float, centre: Float) -> Float:
    normal = np.array([np.cos(angle), np.sin(angle)])
    return np.array([normal[0], normal[1], -normal @ centre - rho])


def _surprise(width: float, middle: float, direction: float, focal_px: float, prior: OutlinePrior) -> float:
    chi2 = (middle / prior.middle_sigma_px) ** 2
    if prior.half_width_px is None:
        chi2 += ((np.log(width / focal_px) - _USUAL_WIDTH[0]) / _USUAL_WIDTH[1]) ** 2
    else:
        chi2 += ((0.5 * width - prior.half_width_px) / prior.half_width_sigma_px) ** 2
    if prior.direction_rad is not None:
        turn = np.mod(direction - prior.direction_rad + np.pi / 2, np.pi) - np.pi / 2
        chi2 += (turn / prior.direction_sigma_rad) ** 2
    return float(chi2)
