"""Not all tracks are equally good: each gets the variance that its own residuals show.

A feature may be no point at all: the outline of a pipe before a wall, a highlight, the crossing of an edge with another
one behind it. It wanders as the view changes, by more than its patches tell. Such a track is wrong in all of its views,
and where it is near, hence heavy, the estimate follows it and leaves it small residuals. So the residuals of a whole
track count as the others foretell them (Baarda 1968), and its variance is drawn from an inverse gamma distribution,
whose width this log's tracks tell: errors with a multivariate t distribution (Lange, Little and Taylor 1989).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.special import gammaln

from ..factors import keys
from .correlation import CAMERAS, Active
from .linear import DETERMINED, LinearSystem

Float = NDArray[np.float64]
Int = NDArray[np.int64]

FEWEST_TRACKS = 40
"""Tracks that tell how much their variances differ."""
WIDTHS = (1.5, 2.0, 3.0, 4.0, 6.0, 9.0, 14.0, 25.0, 60.0)
"""Degrees of freedom of the distribution of variances that are tried: from tracks of all kinds to tracks all alike."""
ALIKE = 0.5
"""Where variances differ little and no track has a smaller weight, all keep theirs."""
SCALES = np.exp(np.linspace(-0.5, 0.7, 25))
"""Typical variances that are tried, about the median of what the tracks show."""
MOST = 1.5
"""A track counts for so much more than stated at most: few residuals may be small by chance."""
LANDMARK = 3
"""Coordinates of a point."""
LIGHT = 0.03
"""Share of a track's squared residual that its own pull on the estimate makes, up to which first order is enough."""
AT_ONCE = 4_000_000
"""Entries of matrices that are worked on together: 32 MB."""
ROUNDS = 2
"""A heavy track's residuals grow when it is no longer followed."""

Views = list[tuple[int, Int]]
"""Landmark, and the positions of its factors in the system."""


@dataclass(frozen=True, slots=True)
class TrackWeights:
    by_position: dict[int, float]
    """Information over what is stated, by the positions of factors; empty where tracks are alike."""
    slack: float = 1.0
    """Standard deviations of the estimate over those that weights known beforehand would give."""
    step: Float | None = None
    """Shape (n,), from the system's solution to nearly the one with these weights; None where tracks are alike."""


def track_weights(active: Active, system: LinearSystem, family: str) -> TrackWeights:
    """How much the tracks of a family are worth.

    The weights come from the residuals themselves. A track that is more wrong gets less weight, so that the estimate
    follows a small error by less than the weighted normal equations say: with w degrees of freedom of the variances and
    d of the track by `(w + d) / (w + d + 2)`, on average (Lange, Little and Taylor 1989, section 5).

    Args:
        active: all factors of a system.
        system: their system, at its solution.
        family: whose tracks are meant.
    """
    tracks = _views(active, family)
    if len(tracks) < FEWEST_TRACKS:
        return TrackWeights({})
    weight = np.ones(len(tracks))
    spread: tuple[float, float] | None = None
    dof, step, weighed = weight, None, system
    for _ in range(ROUNDS):
        if spread is not None:
            weighed, step = _weighed(system, tracks, weight)
        chi2, dof = residuals_of_tracks(tracks, weighed)
        spread = spread or spread_of_variances(chi2, dof)
        width, scale = spread
        weight = np.minimum((width + dof) / (width + chi2 / (weight * scale)), MOST)
        if width == WIDTHS[-1] and weight.min() > ALIKE:
            return TrackWeights({})
    slack = float(((spread[0] + dof + 2.0) / (spread[0] + dof) * dof).sum() / dof.sum()) if spread else 1.0
    return TrackWeights(
        {int(p): float(w) for (_, positions), w in zip(tracks, weight, strict=True) for p in positions}, slack, step
    )


def _weighed(system: LinearSystem, tracks: Views, weight: Float) -> tuple[LinearSystem, Float]:
    root = np.ones(len(system.b))
    for (_, positions), w in zip(tracks, weight, strict=True):
        root[_rows(system, positions)] = np.sqrt(w)
    return system.weighed_rows(root)


def spread_of_variances(chi2: Float, dof: Float) -> tuple[float, float]:
    """Degrees of freedom and typical value of the inverse gamma distribution of variances, by maximum likelihood.

    Args:
        chi2: shape (n,), of every track.
        dof: shape (n,).
    """
    ratio = np.maximum(chi2 / dof, 1e-6)
    scales = float(np.median(ratio)) * SCALES
    likelihood = [[float(_log_f(ratio / s, dof, w).sum() - len(dof) * np.log(s)) for s in scales] for w in WIDTHS]
    best = np.unravel_index(int(np.argmax(likelihood)), (len(WIDTHS), len(scales)))
    return WIDTHS[int(best[0])], float(scales[int(best[1])])


def _log_f(x: Float, d: Float, w: float) -> Float:
    """Logarithm of the density of Fisher's F distribution with d and w degrees of freedom."""
    beta = gammaln(0.5 * (d + w)) - gammaln(0.5 * d) - gammaln(0.5 * w)
    return beta + 0.5 * d * np.log(d / w) + (0.5 * d - 1.0) * np.log(x) - 0.5 * (d + w) * np.log1p(d * x / w)


def _views(active: Active, family: str) -> Views:
    views: dict[int, list[int]] = {}
    for position, (_, factor, record) in enumerate(active):
        if record.family == family and record.camera in CAMERAS:
            views.setdefault(keys.landmark_among(factor.keys()), []).append(position)
    return [(landmark, np.array(positions)) for landmark, positions in views.items()]


def residuals_of_tracks(tracks: Views, system: LinearSystem) -> tuple[Float, Float]:
    """Squared residuals (n,) of whole tracks in units of their covariance, and their degrees of freedom (n,).

    Any place of the landmark would do, and what the track itself does to the estimate is taken out. At the solution
    the residuals of a track are orthogonal to its landmark, and to first order in its leverage H the square is
    `r^T (1 + H) r`; only tracks for which that matters are looked at closely.
    """
    place, covariance = system.rest_covariance()
    rows = [_rows(system, positions) for _, positions in tracks]
    chi2 = np.array([float(system.b[r] @ system.b[r]) for r in rows])
    dof = np.array([max(len(r) - LANDMARK, 1e-3) for r in rows])
    if covariance is None:
        return chi2, dof
    held = csr_matrix(system.A[:, np.flatnonzero(place >= 0)])
    followed = _followed(rows, system, held, covariance)
    heavy = np.flatnonzero(followed > LIGHT * chi2)
    chi2 = chi2 + followed
    length = np.array([len(rows[i]) for i in heavy], dtype=np.int64)
    for n in np.unique(length).tolist():
        alike = heavy[length == n]
        for part in np.array_split(alike, -(-len(alike) * n * len(covariance) // AT_ONCE)):
            landmarks = np.array([np.arange(LANDMARK) + system.columns[tracks[i][0]].start for i in part])
            chi2[part], dof[part] = _residuals(np.array([rows[i] for i in part]), landmarks, system, held, covariance)
    return chi2, dof


def _followed(rows: list[Int], system: LinearSystem, held: csr_matrix, covariance: Float) -> Float:
    """`r^T H r` of every track, shape (n,).

    Args:
        held: the columns of the system that are no landmark's.
        covariance: of those unknowns.
    """
    every = np.concatenate(rows)
    owner = np.repeat(np.arange(len(rows)), [len(r) for r in rows])
    pull = csr_matrix((system.b[every], (owner, np.arange(len(every)))), shape=(len(rows), len(every)))
    drawn = np.asarray((pull @ held[every]).todense())
    return ((drawn @ covariance) * drawn).sum(axis=1)


def _residuals(
    rows: Int, landmarks: Int, system: LinearSystem, held: csr_matrix, covariance: Float
) -> tuple[Float, Float]:
    """`z^T (I - H)^-1 z` (n,) of what is left of tracks' residuals when their landmarks are eliminated, and its
    dimension (n,).

    Args:
        rows: shape (n, m), of n tracks with as many measurements.
        landmarks: shape (n, 3), their columns.
        held: the columns that are no landmark's.
        covariance: of those unknowns.
    """
    count, m = rows.shape
    part, B = system.A[rows.ravel()], held[rows.ravel()]
    hat = (B @ covariance).reshape(count, m, -1) @ B.toarray().reshape(count, m, -1).transpose(0, 2, 1)
    i, j = np.arange(count * m).reshape(count, m, 1), landmarks[:, None, :]
    i, j = (index.ravel() for index in np.broadcast_arrays(i, j))
    landmark = np.linalg.qr(np.asarray(part[i, j]).reshape(count, m, LANDMARK))[0]
    free = np.eye(m) - landmark @ landmark.transpose(0, 2, 1)
    spread = free @ (np.eye(m) - 0.5 * (hat + hat.transpose(0, 2, 1))) @ free
    eigenvalues, vectors = np.linalg.eigh(spread)
    known = eigenvalues > DETERMINED
    along = (vectors.transpose(0, 2, 1) @ (free @ system.b[rows][..., None]))[..., 0]
    chi2 = np.where(known, along**2 / np.where(known, eigenvalues, 1.0), 0.0).sum(axis=1)
    return chi2, np.maximum(known.sum(axis=1), 1e-3)


def _rows(system: LinearSystem, positions: Int) -> Int:
    """Two for every factor."""
    return (system.starts[positions][:, None] + np.arange(2)).ravel()
