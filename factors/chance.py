"""Tails of the normal and the chi-square distribution: limits of tests, and how surprising a statistic is.

The same functions are in scipy.stats, whose import costs most of a second.
"""

import numpy as np
from scipy.special import chdtr, chdtrc, chdtri, ndtr, ndtri


def chi2_isf(tail: float, dof: float) -> float:
    """What a chi-square variable exceeds with probability `tail`."""
    return float(chdtri(dof, tail))


def chi2_ppf(probability: float, dof: float) -> float:
    """What a chi-square variable stays below with a probability."""
    return float(chdtri(dof, 1.0 - probability))


def chi2_sf(value: float, dof: float) -> float:
    """Probability that a chi-square variable exceeds a value."""
    return float(chdtrc(dof, value))


def chi2_cdf(value: np.ndarray, dof: np.ndarray) -> np.ndarray:
    """Probability that chi-square variables stay below values; both of shape (n,)."""
    return np.asarray(chdtr(dof, value), float)


def normal_isf(tail: float) -> float:
    """What a normal variable of sigma 1 exceeds with probability `tail`."""
    return float(-ndtri(tail))


def normal_cdf(value: float) -> float:
    """Probability that a normal variable of sigma 1 stays below a value."""
    return float(ndtr(value))
