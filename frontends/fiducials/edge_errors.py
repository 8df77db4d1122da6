"""How far the printed edges lie from where the model has them, each for itself, by what the fit leaves over.

Noise of pixels is one thing, an edge that is off as a whole another: pixels that see only a part of their area, paper
that is not flat, ink that ran, a picture made smaller without care. Such an error is common to all pixels of an edge,
so more pixels do not help against it. It is told from the noise as a component of variance: every grid line of the
pattern may be shifted across itself and turned, with one variance for all markers of the image,

    r = M (noise + G d),    d ~ N(0, s^2),    M: what is left after the fit,    G: a grid line's shift or turn

and the quadratic form u' D^-1 u of the scores u = G' W r has the expectation s^2 tr(D^-1 S S) + sigma^2 tr(D^-1 S) with
S = G' W M G (estimation of variance components: Rao, "Estimation of variance and covariance components", 1971).
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

# NumPy's own annotations widen every sum and product: double and single precision are told apart for the reader
Float = NDArray[Any]
Single = NDArray[Any]

_TURN = np.float32(np.sqrt(3.0))
"""A turn about the middle of a line, of a quarter of the mean square along it that a shift has: a line that errs as a
whole has no turn, one that errs piece by piece as much of it as of a shift."""
_LEAST_SHARE = 1e-3
"""Lines that are seen less than this share of the best one tell nothing."""
_RANK = 1e-3
"""Directions that the fit takes up to this share tell nothing."""
_ROUNDING2 = 1.0 / 12.0
_STANDS_OUT = 4.0
"""Sigmas by which one marker's edges err more than those of the others say."""


@dataclass(frozen=True, slots=True)
class EdgeErrors:
    """Of the m markers of one image."""

    variance_px2: Float
    """Of one grid line's place, shape (m,): the same for all, but for markers that stand out."""
    noise_variance: Float
    """Of a pixel, in grey values, without what the lines explain; shape (m,)."""
    spread: Float
    """Covariance of the eight corner coordinates by lines that err by one pixel, shape (m, 8, 8)."""


def edge_errors(
    columns: Single, inverse: Float, residual: Single, weight: Single, shifts: Single, place: Single
) -> EdgeErrors:
    """Variance components of m fits.

    Args:
        columns: Jacobian of the fit, the corners first, shape (m, k, n).
        inverse: of its normal matrix, shape (m, k, k).
        residual: shape (m, n), of the fit.
        weight: shape (m, n).
        shifts: change of the grey values by a shift of each grid line of constant a, then of b, shape (m, 2, l, n).
        place: (a - 1/2, b - 1/2) of each pixel in the marker, shape (m, 2, n).
    """
    m, _, lines, n = shifts.shape
    G = np.empty((m, 2, 2, lines, n), np.float32)
    G[:, 0] = shifts
    np.multiply(shifts, (place[:, ::-1] * _TURN)[:, :, None], out=G[:, 1])
    G = G.reshape(m, -1, n)
    weighted = G * weight[:, None]
    strength = (weighted @ G.transpose(0, 2, 1)).astype(float)
    cross = (weighted @ columns.transpose(0, 2, 1)).astype(float)
    through = inverse @ cross.transpose(0, 2, 1)
    S = strength - cross @ through
    u = (weighted @ residual[..., None])[..., 0].astype(float)
    D = np.einsum("mll->ml", strength)
    over = np.where(D > _LEAST_SHARE * D.max(1, keepdims=True), 1.0 / np.maximum(D, 1e-12), 0.0)
    seen = over > 0
    S = S * seen[:, :, None] * seen[:, None, :]
    noise = _noise(S, u * seen, over, residual, weight, columns.shape[1])
    by_noise = np.einsum("mll,ml->m", S, over)
    by_lines = np.einsum("mlk,mlk,ml->m", S, S, over)
    off = ((u**2 * over).sum(1) - noise * by_noise) / noise
    variance = _variance(off, by_lines / noise, S, np.sqrt(over), noise)
    K = through[:, :8] * seen[:, None, :]
    return EdgeErrors(variance, noise, K @ K.transpose(0, 2, 1))


def _variance(off: Float, by_lines: Float, S: Float, root: Float, noise: Float) -> Float:
    """The variance that all markers share, and the own one of a marker that the others do not explain.

    Lens, exposure and print are common to the markers of an image. The edge of a shadow, a fold or a stain is one
    marker's: it would spoil the others and be played down there.

    Args:
        off: excess of each marker's quadratic form, over its noise, shape (m,).
        by_lines: expectation of that for a variance of one, shape (m,).
        S: shape (m, l, l).
        root: D^-1/2, shape (m, l).
        noise: shape (m,).
    """
    shared = np.full(len(off), max(float(off.sum() / max(by_lines.sum(), 1e-12)), 0.0))
    if len(off) < 2:
        return shared
    others = np.maximum((off.sum() - off) / np.maximum(by_lines.sum() - by_lines, 1e-12), 0.0)
    half = root[:, :, None] * S
    form = others[:, None, None] * (half @ half.transpose(0, 2, 1)) + noise[:, None, None] * half * root[:, None]
    scatter = np.sqrt(2.0 * np.einsum("mlk,mkl->m", form, form)) / noise
    alone = off - by_lines * others > _STANDS_OUT * scatter
    if not alone.any() or alone.all():
        return shared
    rest = max(float(off[~alone].sum() / max(by_lines[~alone].sum(), 1e-12)), 0.0)
    return np.where(alone, off / np.maximum(by_lines, 1e-12), rest)


def _noise(S: Float, u: Float, over: Float, residual: Single, weight: Single, unknowns: int) -> Float:
    """Variance of a pixel once every line may be where it likes, shape (m,)."""
    root = np.sqrt(over)
    scaled = S * root[:, :, None] * root[:, None, :]
    inverse = np.linalg.inv(scaled + _RANK * np.eye(S.shape[-1]))
    along = u * root
    explained = np.einsum("mk,mkl,ml->m", along, inverse, along)
    told = np.einsum("mkl,mlk->m", scaled, inverse)
    left = (residual**2 * weight).sum(1) - explained
    freedom = np.maximum(weight.sum(1) - unknowns - told, 1.0)
    return np.maximum(left / freedom, _ROUNDING2)
