"""What would the estimate be without one family of measurements? How far that is, in sigmas, tests the family."""

from collections.abc import Iterable, Mapping

import numpy as np
from numpy.typing import NDArray

from .correlation import Active
from .linear import DETERMINED, LinearSystem, deviate

Float = NDArray[np.float64]
Blocks = list[tuple[int, Float]]

MOST_ROWS = 1500
"""A family of more rows, such as the stereo tracks, is what holds everything together: there is no estimate without."""


def without_families(
    active: Active, system: LinearSystem, points: Mapping[str, Blocks], families: Iterable[str]
) -> dict[tuple[str, str], float]:
    """By point and family: how far the point moves when the family is left out, in sigmas of that difference.

    With F the family's rows, r their residuals and H = F P F^T their part of the hat matrix, the estimate moves by
    -P F^T (I - H)^-1 r, and that has the covariance P F^T (I - H)^-1 F P, by which the estimate's own grows. Families
    without which something is undetermined, or that hold nothing of `J x`, are not among the answers.

    Args:
        active: the factors of the system, in its order.
        points: J of each as blocks (key, shape (m, dim)).
    """
    found = {}
    for family in families:
        mine = np.repeat([record.family == family for _, _, record in active], system.rows)
        count = int(mine.sum())
        if not 0 < count <= MOST_ROWS:
            continue
        F = system.A[np.flatnonzero(mine)]
        X = system.solve(np.asarray(F.T.todense()))
        rest = np.eye(count) - np.asarray(F @ X)
        if np.linalg.eigvalsh(0.5 * (rest + rest.T))[0] < DETERMINED:
            continue
        for name, blocks in points.items():
            G = system.selector(blocks).T @ X
            sigma = _moved(G, np.asarray(np.linalg.solve(rest, G.T), np.float64), system.b[mine])
            if sigma is not None:
                found[name, family] = sigma
    return found


def _moved(G: Float, gain: Float, residuals: Float) -> float | None:
    """How far `gain^T residuals` is from nothing, in sigmas of its covariance `G gain`; None where that is nothing."""
    moved, spread = gain.T @ residuals, G @ gain
    eigenvalues, vectors = np.linalg.eigh(0.5 * (spread + spread.T))
    free = eigenvalues > 1e-9 * max(float(eigenvalues[-1]), 1e-18)
    if eigenvalues[-1] < 1e-14:
        return None
    return deviate(float((((vectors.T @ moved)[free]) ** 2 / eigenvalues[free]).sum()), int(free.sum()))
