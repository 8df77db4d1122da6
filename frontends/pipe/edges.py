"""Straight edges near a place of an image.

The image is turned to many directions. In each, stretches along the edge direction are averaged before the derivative
across is taken, which lifts weak contrast out of the noise, and a line's support is counted stretch by stretch against
how often such support is met by chance in this image and direction.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..median import median

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
    lines: list[EdgeLine] = []
    for i, j in seeds:
        line = _refined(theta[i], j - reach, peak[i], size[i], first[i, j], last[i, j], reach, float(score[i, j]))
        if line is not None and abs(line.rho) <= widest_px and all(not _same(line, other) for other in lines):
            lines.append(line)
    return lines


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


def _maxima(score: Float, count: int, closed: bool) -> list[tuple[int, int]]:
    """Local maxima over direction and distance; directions close up with the distance mirrored."""
    table = score.astype(np.float32)
    top = np.vstack((table[-2:, ::-1], table, table[:2, ::-1])) if closed else np.pad(table, ((2, 2), (0, 0)))
    peak = (table >= cv2.dilate(top, np.ones((5, 3), np.uint8))[2:-2]) & (table > 2.5)
    rows, columns = np.nonzero(peak)
    best = np.argsort(-table[rows, columns])[:count]
    return [(int(rows[i]), int(columns[i])) for i in best]


def _refined(
    theta: float,
    distance: int,
    peak: NDArray[np.bool_],
    size: Float,
    first: int,
    last: int,
    reach: int,
    evidence: float,
) -> EdgeLine | None:
    """Line through the sub-pixel maxima of the stretches of one seed."""
    rows = np.arange(first, last + 1)
    column = distance + reach
    places = []
    for row in rows:
        for c in (column, column - 1, column + 1):
            if 0 < c < peak.shape[1] - 1 and peak[row, c]:
                left, middle, right = size[row, c - 1 : c + 2]
                bend = left - 2 * middle + right
                places.append((row, c - reach + (0.5 * (left - right) / bend if bend < 0 else 0.0)))
                break
    if len(places) < 2:
        return None
    row, where = np.array(places).T
    along = (row + 0.5) * _STRETCH - _HALF_LENGTH
    slope, shift = _straight(along, where)
    for _ in range(2):
        off = np.abs(where - slope * along - shift)
        keep = off <= max(2.5 * median(off), 0.4)
        if keep.sum() >= 2:
            slope, shift = _straight(along[keep], where[keep])
    turn = float(np.arctan(slope))
    # x = shift + slope s: the normal turns by -turn (along is (-sin, cos)).
    angle, rho = theta - turn, float(shift * np.cos(turn))
    move = float(shift * np.sin(turn))
    start, end = row.min() * _STRETCH - _HALF_LENGTH, (row.max() + 1) * _STRETCH - _HALF_LENGTH
    wraps = int(np.floor(angle / np.pi))
    sign = 1 if wraps % 2 == 0 else -1
    span = (float(start + move), float(end + move))
    return EdgeLine(angle - wraps * np.pi, sign * rho, span if sign > 0 else (-span[1], -span[0]), evidence)


def _straight(x: Float, y: Float) -> tuple[float, float]:
    """Slope and offset of the least squares line."""
    middle = x.mean()
    slope = float((x - middle) @ y / ((x - middle) @ (x - middle)))
    return slope, float(y.mean() - slope * middle)


def _same(a: EdgeLine, b: EdgeLine) -> bool:
    turn = np.mod(a.angle - b.angle + np.pi / 2, np.pi) - np.pi / 2
    rho = b.rho if abs(a.angle - b.angle) < np.pi / 2 else -b.rho
    return bool(abs(turn) < np.deg2rad(1.5) and abs(a.rho - rho) < 0.8)


def image_noise(patch: Float32) -> float:
    """Standard deviation of the white noise, grey values (Immerkaer 1996, by the median, for the edges)."""
    kernel = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
    response = np.abs(cv2.filter2D(patch, cv2.CV_32F, kernel))[1:-1, 1:-1]
    response = response[np.isfinite(response)]
    return float(np.median(response) / 0.6745 / 6.0) if response.size else 0.0
