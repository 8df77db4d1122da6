"""Covariances that stand for the worse of two accounts."""

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]


def larger(a: Float, b: Float) -> Float:
    """A covariance that is no smaller than either in any direction: b's excess over a, direction by direction, on a."""
    root = np.linalg.cholesky(a)
    inner = np.linalg.solve(root, np.linalg.solve(root, b).T)
    values, vectors = np.linalg.eigh(0.5 * (inner + inner.T))
    return np.asarray(root @ (vectors * np.maximum(values, 1.0)) @ vectors.T @ root.T, np.float64)
