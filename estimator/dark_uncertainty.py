"""What given distances say about errors that no sigma in the model stands for.

Each given distance is predicted from everything else. Where the predictions miss by more than their sigmas allow, the
missing variance is found as between laboratories whose results disagree: Paule and Mandel, Consensus values and
weighting factors, J. Res. NBS 87 (1982) 377. The name is from Thompson and Ellison, Dark uncertainty, Accreditation and
Quality Assurance 16 (2011) 483.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from ..factors.measurements import Event
from .linear import DETERMINED, LinearSystem

Float = NDArray[np.float64]

ENOUGH = 4
"""Fewer distances tell too little about their own spread."""


def missing_variance(errors: Float, variances: Float) -> float:
    """The smallest tau^2 >= 0 with which sum e^2 / (v + tau^2) is not above the number of errors.

    Args:
        errors: shape (n,), each of mean zero. variances: shape (n,), of each as the model has it.
    """

    def excess(tau2: float) -> float:
        return float(np.sum(errors**2 / (variances + tau2))) - len(errors)

    if len(errors) == 0 or excess(0.0) <= 0.0:
        return 0.0
    root = brentq(excess, 0.0, float(np.sum(errors**2)), xtol=1e-18)
    return float(root)  # pyright: ignore[reportArgumentType]  # without full_output it is a number


def left_out(system: LinearSystem, positions: Sequence[int], sigmas: Float) -> tuple[Float, Float]:
    """Errors of the given values against what everything else predicts, and their variances.

    With the whitened residual r and the leverage h of a measurement of sigma s, leaving it out gives s r / (1 - h) with
    variance s^2 / (1 - h) (Cook and Weisberg 1982, section 2.2). Measurements that nothing else predicts are left away.

    Args:
        positions: of the factors in the system, one row each. sigmas: shape (n,).
    """
    leverage = np.array([hat[0, 0] for hat in system.hats(positions)])
    residual = np.array([system.b[system.starts[p]] for p in positions])
    predicted = 1.0 - leverage > DETERMINED
    free = 1.0 - leverage[predicted]
    s = sigmas[predicted]
    return s * residual[predicted] / free, s**2 / free


def of_distances(system: LinearSystem, positions: Sequence[int], sigmas: Float) -> float:
    """Missing variance of distances in m^2; zero with too few of them."""
    if len(positions) < ENOUGH:
        return 0.0
    errors, variances = left_out(system, positions, sigmas)
    return missing_variance(errors, variances) if len(errors) >= ENOUGH else 0.0


def event(tau2: float, sigmas: Float, stamp_ns: int) -> Event:
    """What the user has to know about it; a warning where it is more than the given sigmas."""
    tau_mm = 1e3 * float(np.sqrt(tau2))
    text = (
        f"the {len(sigmas)} given distances disagree with each other by {tau_mm:.1f} mm more than their sigmas say; "
        "this is added to the sigma of every distance"
    )
    severity = "warning" if tau2 > float(np.median(sigmas)) ** 2 else "info"
    return Event(stamp_ns, "dark_uncertainty", text, severity, {"tau_mm": tau_mm})
