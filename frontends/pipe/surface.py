"""Do the two sides of an edge show one surface? Texture along the edge tells: it goes on across a shadow, a highlight
or a stain, and breaks where one thing hides another."""

import cv2
import numpy as np
from numpy.typing import NDArray

from ..median import median

Float = NDArray[np.float64]
Float32 = NDArray[np.float32]

_BIN_PX = 2
_REGION_PX = 30
_INDEPENDENT = 6.0
"""Independent bits of texture along a strip of 60 px: bricks and stains are that large."""
MOST_BY_REGION = 15.0
"""What the texture says at most, however wide a pipe is."""


def occlusion_score(
    patch: Float32, origin: Float, lines: Float, spans: list[tuple[float, float]], feet: Float
) -> float:
    """Log-likelihood ratio that both edges hide a background, against both lying on one surface.

    Args:
        patch: Shape (h, w), ideal pixels, NaN outside the image.
        origin: Shape (2,), the patch's first pixel in ideal pixels.
        lines: Shape (2, 3), the edges, positive outside.
        spans: Part of each edge to look at, px along (-l1, l0) from its foot.
        feet: Shape (2, 2).
    """
    width = float(np.abs(np.append(feet[0], 1.0) @ lines[1]))
    reach = float(np.clip(width / 2, 2.5, 5.0))
    score = 0.0
    inner, outer = [], []
    for line, span, foot in zip(lines, spans, feet, strict=True):
        inside = _profile(patch, origin, line, span, foot, -1.2 - reach / 1.5, -1.2)
        outside = _profile(patch, origin, line, span, foot, 1.5, 1.5 + reach)
        good = np.isfinite(inside) & np.isfinite(outside)
        if good.sum() < 8:
            continue
        inside, outside = flat(inside[good]), flat(outside[good])
        inner.append(float(inside.var()))
        outer.append(float(outside.var()))
        correlation = float((inside * outside).mean() / max(np.sqrt(inner[-1] * outer[-1]), 1e-9))
        # Neighbouring bins of a texture are not independent: half of them count.
        score += 0.25 * len(inside) * float(np.log(max(1 - max(correlation, 0.0) ** 2, 1e-3)))
    if inner:
        score += float(np.clip(0.5 * np.log((np.mean(outer) + 1.0) / (np.mean(inner) + 1.0)), -1.5, 2.5))
    return max(score, -8.0)


def sampled(patch: Float32, px: Float) -> Float32:
    """Grey values at places (..., 2) of a patch, interpolated; NaN outside."""
    u, v = (np.ascontiguousarray(px[..., i].reshape(len(px), -1), dtype=np.float32) for i in (0, 1))
    values = cv2.remap(patch, u, v, cv2.INTER_LINEAR, None, cv2.BORDER_CONSTANT, (np.nan,) * 4)
    return np.asarray(values, np.float32).reshape(px.shape[:-1])


def _profile(
    patch: Float32, origin: Float, line: Float, span: tuple[float, float], foot: Float, start: float, end: float
) -> Float:
    """Grey values along an edge, averaged across from `start` to `end` px outside it and over bins along it."""
    bins = int((span[1] - span[0]) / _BIN_PX)
    if bins < 1:
        return np.zeros(0)
    along = span[0] + 0.5 + np.arange(bins * _BIN_PX)
    across = np.linspace(start, end, max(2, round(end - start) + 1))
    place = foot - origin + along[:, None, None] * np.array([-line[1], line[0]]) + across[:, None] * line[:2]
    values = sampled(patch, place)
    return values.reshape(bins, -1).mean(axis=1).astype(float)


def flat(values: Float) -> Float:
    """Without mean and trend along the last axis, shape (..., n)."""
    place = np.arange(values.shape[-1]) - 0.5 * (values.shape[-1] - 1)
    trend = values @ place / float(place @ place)
    return values - values.mean(axis=-1, keepdims=True) - trend[..., None] * place


def region_scores(patch: Float32, origin: Float, lines: Float, core_px: Float, half_width_px: Float) -> Float:
    """Log-likelihood ratios that a pipe fills the space between two edges, by the texture along it, one per pair.

    A pipe's grey value goes on along its axis, that of a wall behind mostly does not. Strips of the image along the
    axis are told apart by their variance; where pipe and background are alike in it, the score is 0.

    Args:
        patch: Shape (h, w), ideal pixels, NaN outside the image.
        origin: Shape (2,), the patch's first pixel in ideal pixels.
        lines: Shape (pairs, 2, 3), the edges, positive outside.
        core_px: Shape (2,), a point on the pipe.
        half_width_px: Shape (pairs,), half its width.

    Returns:
        Shape (pairs,), none beyond `MOST_BY_REGION`.
    """
    across = lines[:, 0, :2] - lines[:, 1, :2]
    across = across / np.linalg.norm(across, axis=1, keepdims=True)
    reach = (half_width_px * 1.3).astype(int) + 10
    place = np.arange(-reach.max(), reach.max() + 1.0)
    near = np.abs(place) <= reach[:, None]
    variance, known = _restlessness(patch, core_px - origin, across, place)
    inside = _signed(lines, core_px, place, across)
    core, beyond = np.abs(place) <= np.maximum(2.0, 0.4 * half_width_px)[:, None], near & (inside < -2.0)
    pipe = _medians(variance, core)
    wall = np.where(beyond.any(axis=1), _medians(variance, beyond), pipe)
    told = (known | ~near).all(axis=1) & (wall >= 2.0 * pipe)
    pipe, wall = np.where(told, (pipe, wall), [[1.0], [2.0]])[..., None]
    likeness = 0.5 * _INDEPENDENT * (np.log(wall / pipe) - variance * (1 / pipe - 1 / wall))
    likeness = np.where(near, np.clip(likeness, -3.0, 3.0), 0.0)
    # Strips next to an edge hold both sides; beyond 6 px another thing may begin.
    score = (likeness * (inside > 1.0)).sum(axis=1) - (likeness * ((inside < -1.0) & (inside > -6.0))).sum(axis=1)
    return np.where(told, np.clip(0.4 * score, -MOST_BY_REGION, MOST_BY_REGION), 0.0)


def _restlessness(patch: Float32, core: Float, across: Float, place: Float) -> tuple[Float, NDArray[np.bool_]]:
    """Variance of the grey value along strips at places (n,) across each direction (pairs, 2), and where it is known,
    shape (pairs, n)."""
    along = np.arange(-_REGION_PX, _REGION_PX + 1.0)
    axis = np.stack((-across[:, 1], across[:, 0]), axis=1)
    grid = core + place[:, None, None] * across[:, None, None] + along[:, None] * axis[:, None, None]
    strips = sampled(patch, grid)
    known = np.isfinite(strips.sum(axis=2))
    thirds = len(along) // 3 * 3
    smooth = sum((strips[..., i:thirds:3] for i in (1, 2)), strips[..., 0:thirds:3]).astype(float) / 3
    return np.where(known, flat(np.where(known[..., None], smooth, 0.0)).var(axis=-1), 0.0) + 0.5, known


def _medians(values: Float, used: NDArray[np.bool_]) -> Float:
    """Of the values of each row that are used, (rows,); infinite where there are none."""
    ordered = np.sort(np.where(used, values, np.inf), axis=1)
    row, count = np.arange(len(values)), used.sum(axis=1)
    return 0.5 * (
        ordered[row, np.maximum(count - 1, 0) // 2] + ordered[row, np.minimum(count // 2, len(ordered.T) - 1)]
    )


def _signed(lines: Float, core_px: Float, place: Float, across: Float) -> Float:
    """Distance inside the nearer edge for places (n,) across pipes, negative outside, shape (pairs, n)."""
    at_core = lines[..., :2] @ core_px + lines[..., 2]
    slope = np.einsum("pij,pj->pi", lines[..., :2], across)
    return -(at_core[..., None] + slope[..., None] * place).max(axis=1)


def region_edges(patch: Float32, centre: Float, angle: float, widest_px: float) -> list[tuple[float, float]]:
    """Where the texture along a direction begins on either side of a place: (distance, log-likelihood ratio) each.

    Args:
        patch: Shape (h, w), ideal pixels, NaN outside the image.
        centre: Shape (2,), a point on the pipe, in pixels of the patch.
        angle: Direction across the pipe, rad.
        widest_px: How far to look.
    """
    across = np.array([np.cos(angle), np.sin(angle)])
    axis = np.array([-across[1], across[0]])
    reach = int(widest_px) + 12
    place = np.arange(-reach, reach + 1.0)
    along = np.arange(-_REGION_PX, _REGION_PX + 1.0)
    strips = sampled(patch, centre + place[:, None, None] * across + along[:, None] * axis)
    smooth = strips[:, : 3 * (len(along) // 3)].reshape(len(place), -1, 3).mean(axis=2).astype(float)
    known = np.isfinite(smooth).all(axis=1)
    variance = np.where(known, flat(np.where(known[:, None], smooth, 0.0)).var(axis=1), np.nan) + 0.5
    core = variance[(np.abs(place) <= 3.0) & known]
    if len(core) < 4:
        return []
    pipe, found = median(core), []
    for side in (-1.0, 1.0):
        order = np.nonzero(place == 0)[0][0] + (side * np.arange(1, reach + 1)).astype(int)
        order = order[known[order]]
        if len(order) < 12:
            continue
        wall = median(variance[order[-10:]])
        if wall < 2.0 * pipe:
            continue
        likeness = 0.5 * _INDEPENDENT * (np.log(wall / pipe) - variance[order] * (1 / pipe - 1 / wall))
        total = np.cumsum(np.clip(likeness, -3.0, 3.0))
        last = int(np.argmax(total))
        if 1 < last < len(order) - 3:
            found.append((side * (last + 1.5), 0.4 * float(total[last] - total[-1])))
    return found
