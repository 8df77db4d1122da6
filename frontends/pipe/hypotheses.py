"""Hypotheses of a pipe's outline with sub-pixel edges, of several pictures side by side, and which is likely."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .limb import EdgeFit, EdgeSeed, Window, confirmed_edges, fit_edges
from .pairs import EdgePair, OutlinePrior
from .surface import occlusion_score

Float = NDArray[np.float64]

_NO_FIT = 3.0
_NEAR_FITTED_PX, _NEAR_SEEDS_PX = 0.5, 1.6


@dataclass(frozen=True, slots=True)
class Found:
    """A hypothesis with its sub-pixel edges."""

    pair: EdgePair
    fits: tuple[EdgeFit, EdgeFit] | None
    """None where the sub-pixel fit failed; the hypothesis stays, as what might have been."""
    seeds: tuple[EdgeSeed, EdgeSeed]
    score: float


@dataclass(frozen=True, slots=True)
class Begun:
    """What a picture shows before edges are fitted."""

    prior: OutlinePrior
    pairs: list[EdgePair]
    """The best hypotheses."""
    window: Window
    patch: NDArray[np.float32]
    """The surroundings, ideal pixels."""
    origin: Float
    """(2,), its first pixel."""


def refined(begun: Sequence[Begun]) -> list[list[Found]]:
    """Every picture's hypotheses with their sub-pixel edges."""
    seeds = [_seeds(one) for one in begun]
    looked = [(one.window, seed) for one, of_one in zip(begun, seeds, strict=True) for seed in of_one.values()]
    fits = iter(fit_edges(looked))
    return [
        _hypotheses(one, of_one, {key: next(fits) for key in of_one}) for one, of_one in zip(begun, seeds, strict=True)
    ]


_Key = tuple[int, bool]
"""An edge, and whether its normal points outwards."""


def _keys(pair: EdgePair) -> tuple[_Key, _Key]:
    first, second = (
        (id(edge), bool(line[:2] @ (np.cos(edge.angle), np.sin(edge.angle)) > 0))
        for line, edge in zip(pair.lines, (pair.first, pair.second), strict=True)
    )
    return first, second


def _seeds(begun: Begun) -> dict[_Key, EdgeSeed]:
    """Where the fits begin: pairs share edges."""
    seeds: dict[_Key, EdgeSeed] = {}
    for pair in begun.pairs:
        for key, line, edge in zip(_keys(pair), pair.lines, (pair.first, pair.second), strict=True):
            span = edge.span if key[1] else (-edge.span[1], -edge.span[0])
            seeds.setdefault(key, _seed(line, span, begun.prior, pair))
    return seeds


def _hypotheses(begun: Begun, seeds: dict[_Key, EdgeSeed], fits: dict[_Key, EdgeFit | None]) -> list[Found]:
    blur, found = _sharp_blur(fits.values()), []
    for pair in begun.pairs:
        first, second = _keys(pair)
        one, other, both = fits[first], fits[second], (seeds[first], seeds[second])
        if one is None or other is None:
            found.append(Found(pair, None, both, pair.score - _NO_FIT))
        else:
            score = pair.score + sum(_fit_score(fit, blur) for fit in (one, other))
            found.append(Found(pair, (one, other), both, score))
    return found


def seen_sides(found: Found, begun: Begun) -> Found:
    """With what the texture on both sides of the edges says."""
    if found.fits is None:
        return found
    lines = np.array([fit.line for fit in found.fits])
    feet = np.array([fit.foot_px for fit in found.fits])
    score = occlusion_score(begun.patch, begun.origin, lines, [fit.extent for fit in found.fits], feet)
    return replace(found, score=found.score + score)


def _seed(line: Float, span: tuple[float, float], prior: OutlinePrior, pair: EdgePair) -> EdgeSeed:
    """Where the sub-pixel fit of one edge begins."""
    foot = prior.centre_px - (line[:2] @ prior.centre_px + line[2]) * line[:2]
    return EdgeSeed(line, foot, (max(span[0] - 4, -75.0), min(span[1] + 4, 75.0)), 0.5 * pair.width_px)


def confirmed(found: list[list[Found]], windows: list[Window]) -> list[list[Found]]:
    """The best hypothesis of each picture has its edges in a narrow window as well; one that has not is no fit."""
    found = [*found]
    going = [i for i, of_one in enumerate(found) if of_one and of_one[0].fits is not None]
    while going:
        best = [found[i][0] for i in going]
        looked = [(windows[i], seed) for i, one in zip(going, best, strict=True) for seed in one.seeds]
        fits = confirmed_edges(looked, [fit for one in best if one.fits is not None for fit in one.fits])
        refuted = []
        for i, one, first, second in zip(going, best, fits[::2], fits[1::2], strict=True):
            if first is not None and second is not None:
                found[i] = [replace(one, fits=(first, second)), *found[i][1:]]
                continue
            without = replace(one, fits=None, score=one.score - _NO_FIT)
            found[i] = sorted([without, *found[i][1:]], key=lambda f: -f.score)
            if found[i][0].fits is not None:
                refuted.append(i)
        going = refuted
    return found


def outermost(found: list[Found], penalty: float = 1.5) -> list[Found]:
    """Lowers hypotheses that lie within another likely one: highlights and the pipe's own shadow have edges as well."""
    result = []
    for inner in found:
        nested = any(outer is not inner and outer.fits is not None and _contains(outer, inner) for outer in found)
        result.append(replace(inner, score=inner.score - penalty * nested))
    return sorted(result, key=lambda f: -f.score)


def same_place(one: Found, other: Found, centre_px: Float) -> bool:
    """True when two hypotheses mean the same two edges (seeds differ; what they were fitted to does not)."""
    nearest = _NEAR_FITTED_PX if one.fits is not None and other.fits is not None else _NEAR_SEEDS_PX
    lines = [np.array([f.line for f in h.fits]) if h.fits is not None else h.pair.lines for h in (one, other)]
    first, second = (line @ np.append(centre_px, 1.0) for line in lines)
    if lines[0][0, :2] @ lines[1][0, :2] < 0:
        second = second[::-1]
    return bool(np.abs(first - second).max() < nearest)


def _contains(outer: Found, inner: Found) -> bool:
    """True when both edges of `outer` lie at or outside those of `inner`, one clearly so."""
    if outer.pair.width_px < inner.pair.width_px + 1.5 or outer.pair.surprise > 6.0:
        return False
    shift = abs(outer.pair.middle_px - inner.pair.middle_px)
    return shift < 0.5 * (outer.pair.width_px - inner.pair.width_px) + 0.8


def _fit_score(fit: EdgeFit, blur_px: float) -> float:
    """Log-likelihood that an edge is one sharp straight step, for which shading and highlights are too soft."""
    step = float(np.clip(12.0 * (fit.sharpness - 0.65), -5.0, 2.0))
    soft = max(np.log(fit.blur_px / blur_px), 0.0) / 0.25
    return 4.0 * (fit.supported / fit.stretches - 1.0) + step - 0.5 * float(soft**2)


def _sharp_blur(fits: Iterable[EdgeFit | None]) -> float:
    """Blur that a sharp edge has in this image, from the sharper edges about the pipe; at least the usual 0.6 px."""
    values = [fit.blur_px for fit in fits if fit is not None and fit.sharpness > 0.75]
    return max(0.6, float(np.quantile(values, 0.25))) if values else 0.6
