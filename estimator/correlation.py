"""Errors of one track in successive keyframes are alike: how much, from the run's own residuals."""

from collections import defaultdict

import gtsam
import numpy as np
from numpy.typing import NDArray

from .graph import Record
from .linear import LinearSystem

Float = NDArray[np.float64]
Active = list[tuple[int, gtsam.NonlinearFactor, Record]]
"""Factors with their index in the log and their record."""

FEWEST_VIEWS = 8
FEWEST_PAIRS = 300
LARGEST = 4.0
TAKEN = 0.75
"""Parameters of a landmark per row of one of its views (two cameras, two rows each)."""


def track_inflation(records: list[Record], system: LinearSystem, family: str) -> float:
    """Factor by which white-noise variances understate what tracks with correlated errors leave in an estimate.

    For a first-order autoregressive error with lag-one correlation rho a mean over many views has
    (1 + rho) / (1 - rho) times the variance of the same number of independent ones (Bartlett 1946). rho comes from
    the whitened residuals of long tracks. A landmark's three parameters, fitted to n views by two cameras, take
    3 / (4 n) of every residual's variance, which leaves white noise anticorrelated by 0.75 / (n - 0.75) between any
    two views; that is added back.

    Returns:
        At least 1; exactly 1 where too few tracks are long enough to tell.
    """
    tracks: dict[str, list[tuple[int, Float]]] = defaultdict(list)
    for position, record in enumerate(records):
        if record.family == family and record.camera is not None:
            rows = slice(system.starts[position], system.starts[position + 1])
            tracks[record.what].append((record.stamp_ns, system.b[rows]))
    products = squares = bias = 0.0
    pairs = 0
    for sightings in tracks.values():
        if len(sightings) < FEWEST_VIEWS:
            continue
        residual = np.array([r for _, r in sorted(sightings, key=lambda s: s[0])])
        count = len(residual) - 1
        products += float((residual[1:] * residual[:-1]).sum())
        squares += float((residual**2).sum()) * count / len(residual)
        bias += TAKEN / (len(residual) - TAKEN) * count
        pairs += count
    if pairs < FEWEST_PAIRS or squares <= 0.0:
        return 1.0
    rho = products / squares + bias / pairs
    return float(np.clip((1 + rho) / (1 - min(rho, 0.9)), 1.0, LARGEST))
