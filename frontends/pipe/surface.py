"""Do the two sides of an edge show one surface? Texture along the edge tells: it goes on across a shadow, a highlight
or a stain, and breaks where one thing hides another."""

import cv2
import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]
Float32 = NDArray[np.float32]

_BIN_PX = 2


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
        inside, outside = _flat(inside[good]), _flat(outside[good])
        inner.append(float(inside.var()))
        outer.append(float(outside.var()))
        correlation = float((inside * outside).mean() / max(np.sqrt(inner[-1] * outer[-1]), 1e-9))
        # Neighbouring bins of a texture are not independent: half of them count.
        score += 0.25 * len(inside) * float(np.log(max(1 - max(correlation, 0.0) ** 2, 1e-3)))
    if inner:
        score += float(np.clip(0.5 * np.log((np.mean(outer) + 1.0) / (np.mean(inner) + 1.0)), -1.5, 2.5))
    return max(score, -8.0)


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
    values = cv2.remap(patch, place.astype(np.float32), None, cv2.INTER_LINEAR, None, cv2.BORDER_CONSTANT, np.nan)
    return values.reshape(bins, -1).mean(axis=1).astype(float)


def _flat(values: Float) -> Float:
    """Without mean and trend."""
    place = np.arange(len(values)) - 0.5 * (len(values) - 1)
    return values - values.mean() - place * float(values @ place) / float(place @ place)
