"""Straight edges near a place of an image.

The image is turned to many directions. In each, stretches along the edge direction are averaged before the derivative
across is taken, which lifts weak contrast out of the noise, and a line's support is counted stretch by stretch against
how often such support is met by chance in this image and direction.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]
Float32 = NDArray[np.float32]

_ANGLE_STEP = np.deg2rad(2.0)
_STRETCH = 6
"""Length of a stretch, px."""
_STRETCHES = 24
_HALF_LENGTH = _STRETCH * _STRETCHES // 2
_DERIVATIVE_SIGMA = 1.0
_SIGNIFICANT = 3.5
"""In sigmas of the derivative's noise."""
_HIT = 0.85
"""Probability that a stretch of a true edge shows."""
_NOISE_GAIN = 0.75 * 0.375 / np.sqrt(_STRETCH)
"""Noise of the derivative per noise of the image: interpolation, Gaussian derivative of sigma 1, mean of a stretch."""


@dataclass(frozen=True, slots=True)
class EdgeLine:
    """A straight line with the support that it has in the image."""

    angle: float
    """Direction of the line's normal, rad, in [0, pi)."""
    rho: float
    """The line is normal . (p - centre) = rho, px."""
    span: tuple[float, float]
    """First and last supported place along (-sin, cos), from the centre's foot, px."""
    evidence: float
    """Log-likelihood ratio of the support against chance."""


def straight_lines(
    patch: Float32, centre: Float, noise: float, widest_px: float, angles: tuple[float, float] | None, count: int = 40
) -> list[EdgeLine]:
    """The best supported straight edges about a centre.

    Args:
        patch: Shape (h, w), grey values in ideal pixels, NaN outside the image.
        centre: Shape (2,), in pixels of the patch.
        noise: White noise of the image, grey values.
        widest_px: Largest distance of a line from the centre.
        angles: Middle and half-width of the allowed directions of the normal, rad; None: all.
        count: At most so many.
    """
    theta = _directions(angles)
    reach = int(np.ceil(widest_px)) + 3
    slope = _slopes(patch, centre, theta, reach)
    size = np.abs(slope)
    limit = _SIGNIFICANT * _NOISE_GAIN * max(noise, 0.3)
    valid = np.isfinite(size)
    size = np.where(valid, size, 0.0)
    peak = np.zeros(size.shape, bool)
    inner = size[:, :, 1:-1]
    peak[:, :, 1:-1] = (inner > limit) & (inner >= size[:, :, :-2]) & (inner > size[:, :, 2:])
    near = peak.copy()
    near[:, :, 1:] |= peak[:, :, :-1]
    near[:, :, :-1] |= peak[:, :, 1:]
    score, first, last = _spans(near, valid)
    seeds = _maxima(score, count, closed=angles is None)
    if not len(seeds):
        return []
    i, j = seeds.T
    rows = np.arange(_STRETCHES)
    places = _places(peak[i], size[i], j, (rows >= first[i, j, None]) & (rows <= last[i, j, None]))
    lines = _refined(theta[i], places - reach, score[i, j])
    return _distinct([line for line in lines if line is not None and abs(line.rho) <= widest_px])


def _directions(angles: tuple[float, float] | None) -> Float:
    if angles is None:
        return np.arange(0.0, np.pi - 1e-9, _ANGLE_STEP)
    steps = int(np.ceil(angles[1] / _ANGLE_STEP))
    return angles[0] + _ANGLE_STEP * np.arange(-steps, steps + 1)


def _slopes(patch: Float32, centre: Float, theta: Float, reach: int) -> Float32:
    """Derivative across the direction of every stretch, shape (directions, stretches, 2 reach + 1)."""
    across = np.arange(-reach, reach + 1, dtype=np.float32)
    along = np.arange(_STRETCH * _STRETCHES, dtype=np.float32) - _HALF_LENGTH + 0.5
    cosine, sine = np.cos(theta).astype(np.float32)[:, None, None], np.sin(theta).astype(np.float32)[:, None, None]
    u = np.float32(centre[0]) + across * cosine - along[:, None] * sine
    v = np.float32(centre[1]) + across * sine + along[:, None] * cosine
    flat = (-1, len(across))
    turned = cv2.remap(
        patch, u.reshape(flat), v.reshape(flat), cv2.INTER_LINEAR, None, cv2.BORDER_CONSTANT, (np.nan,) * 4
    )
    means = turned.reshape(len(theta) * _STRETCHES, _STRETCH, len(across)).mean(axis=1)
    taps = np.arange(-4, 5, dtype=np.float32)
    kernel = taps * np.exp(-0.5 * (taps / _DERIVATIVE_SIGMA) ** 2)
    kernel = (kernel / (kernel @ taps)).astype(np.float32)
    slope = cv2.filter2D(means, cv2.CV_32F, kernel[None], borderType=cv2.BORDER_REFLECT)
    return np.asarray(slope, np.float32).reshape(len(theta), _STRETCHES, len(across))


def _spans(near: NDArray[np.bool_], valid: NDArray[np.bool_]) -> tuple[Float, NDArray[np.int64], NDArray[np.int64]]:
    """Best run of stretches through the middle for every direction and distance: log-likelihood ratio, first, last."""
    chance = np.clip(near.mean(axis=(1, 2), where=valid), 0.02, 0.6)[:, None, None]
    ratio = np.where(near, np.log(_HIT / chance), np.log((1 - _HIT) / (1 - chance)))
    ratio = np.where(valid, ratio, -0.3)
    half = _STRETCHES // 2
    after = np.cumsum(ratio[:, half:], axis=1)
    before = np.cumsum(ratio[:, half - 1 :: -1], axis=1)
    last, first = after.argmax(axis=1), before.argmax(axis=1)
    best = np.maximum(after.max(axis=1), 0) + np.maximum(before.max(axis=1), 0)
    return best, half - 1 - first, half + last


def _maxima(score: Float, count: int, closed: bool) -> NDArray[np.int64]:
    """Local maxima over direction and distance, (n, 2); directions close up with the distance mirrored."""
    table = score.astype(np.float32)
    top = np.vstack((table[-2:, ::-1], table, table[:2, ::-1])) if closed else np.pad(table, ((2, 2), (0, 0)))
    peak = (table >= cv2.dilate(top, np.ones((5, 3), np.uint8))[2:-2]) & (table > 2.5)
    rows, columns = np.nonzero(peak)
    best = np.argsort(-table[rows, columns])[:count]
    return np.column_stack((rows[best], columns[best]))


def _places(peak: NDArray[np.bool_], size: Float32, column: NDArray[np.int64], used: NDArray[np.bool_]) -> Float:
    """Sub-pixel column of the maximum of each stretch about a seed's column, shape (seeds, stretches); NaN for none.

    Args:
        peak: (seeds, stretches, columns), where the maxima are.
        size: Likewise, what is greatest there.
        column: (seeds,)
        used: (seeds, stretches), which stretches to look at.
    """
    seed, row = np.arange(len(column))[:, None], np.arange(used.shape[1])
    inner = peak.shape[2] - 2
    places = np.full(used.shape, np.nan)
    for aside in (1, -1, 0):  # the seed's own column last: it is preferred
        at = column[:, None] + aside
        inside = np.clip(at, 1, inner)
        here = used & (at == inside) & peak[seed, row, inside]
        left, middle, right = (size[seed, row, inside + k].astype(float) for k in (-1, 0, 1))
        bend = left - 2 * middle + right
        curved = bend < 0
        places = np.where(here, at + np.where(curved, 0.5 * (left - right) / np.where(curved, bend, 1.0), 0.0), places)
    return places


def _refined(theta: Float, places: Float, evidence: Float) -> list[EdgeLine | None]:
    """Lines through the sub-pixel maxima of the stretches of each seed, (seeds, stretches); None with fewer than 2."""
    there = np.isfinite(places)
    count = there.sum(axis=1)
    where = np.where(there, places, 0.0)
    along = (np.arange(places.shape[1]) + 0.5) * _STRETCH - _HALF_LENGTH
    slope, shift = _straight(along, where, there)
    for _ in range(2):
        off = np.abs(where - slope[:, None] * along - shift[:, None])
        keep = there & (off <= np.maximum(2.5 * _medians(off, there, count), 0.4)[:, None])
        again = keep.sum(axis=1) >= 2
        slope, shift = np.where(again, _straight(along, where, keep | ~again[:, None]), (slope, shift))
    turn = np.arctan(slope)
    # x = shift + slope s: the normal turns by -turn (along is (-sin, cos)).
    angle, rho, move = theta - turn, shift * np.cos(turn), shift * np.sin(turn)
    start = there.argmax(axis=1) * _STRETCH - _HALF_LENGTH + move
    end = (places.shape[1] - there[:, ::-1].argmax(axis=1)) * _STRETCH - _HALF_LENGTH + move
    wraps = np.floor(angle / np.pi)
    back = wraps % 2 != 0
    angle, rho = angle - wraps * np.pi, np.where(back, -rho, rho)
    start, end = np.where(back, -end, start), np.where(back, -start, end)
    tables = zip(angle.tolist(), rho.tolist(), start.tolist(), end.tolist(), evidence.tolist(), count, strict=True)
    return [EdgeLine(a, r, (s, e), float(v)) if c > 1 else None for a, r, s, e, v, c in tables]


def _straight(x: Float, y: Float, used: NDArray[np.bool_]) -> tuple[Float, Float]:
    """Slopes and offsets of least squares lines, (lines,), through places x (n,) and y (lines, n)."""
    count = np.maximum(used.sum(axis=1), 1)
    middle, height = (used @ x) / count, (used * y).sum(axis=1) / count
    off = (x - middle[:, None]) * used
    slope = (off * y).sum(axis=1) / np.maximum((off**2).sum(axis=1), 1e-12)
    return slope, height - slope * middle


def _medians(values: Float, used: NDArray[np.bool_], count: NDArray[np.int64]) -> Float:
    """Of the values of each row that are used, (rows,); infinite where there are none."""
    ordered = np.sort(np.where(used, values, np.inf), axis=1)
    row = np.arange(len(count))
    return 0.5 * (ordered[row, np.maximum(count - 1, 0) // 2] + ordered[row, count // 2])


def _distinct(lines: list[EdgeLine]) -> list[EdgeLine]:
    """Without those that are the same as one before."""
    if not lines:
        return []
    angle, rho = np.array([(line.angle, line.rho) for line in lines]).T
    between = angle[:, None] - angle
    turn = np.mod(between + np.pi / 2, np.pi) - np.pi / 2
    other = np.where(np.abs(between) < np.pi / 2, rho, -rho)
    same = (np.abs(turn) < np.deg2rad(1.5)) & (np.abs(rho[:, None] - other) < 0.8)
    kept: list[int] = []
    for i in range(len(lines)):
        if not same[i, kept].any():
            kept.append(i)
    return [lines[i] for i in kept]


def image_noise(patch: Float32) -> float:
    """Standard deviation of the white noise, grey values (Immerkaer 1996, by the median, for the edges)."""
    kernel = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
    response = np.abs(cv2.filter2D(patch, cv2.CV_32F, kernel))[1:-1, 1:-1]
    response = response[np.isfinite(response)]
    return float(np.median(response) / 0.6745 / 6.0) if response.size else 0.0
