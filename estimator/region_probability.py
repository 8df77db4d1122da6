"""Probability that a 3-D Gaussian error stays inside a tolerance region, by quadrature.

The cylinder (an interval along the axis, a disc across it) comes down to one dimension. With the error split into its
part along the axis `a` and across it `c`, `a` given `c` is normal with mean `k . c` and deviation `s`. Whiten `c` and
turn the whitened axes so that `k` acts on `z2` alone; then

    P = integral of phi(z2) [Phi((t - kappa z2) / s) - Phi((-t - kappa z2) / s)] [Phi(hi(z2)) - Phi(lo(z2))] dz2,

where (lo, hi) is the chord that `z2` cuts from the ellipse into which whitening turns the disc. The substitution
z2 = z_max sin(phi) takes the square roots from the ends, and the panels break where the first bracket is steep.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

Float = NDArray[np.float64]

REACH = 9.0
"""Sigmas after which a standard normal is nothing (2e-19)."""
NODES, WEIGHTS = np.polynomial.legendre.leggauss(16)
PANELS = 24
BALL_PANELS = 12


def cylinder_probability(covariance_m2: Float, axis: Float, along_m: float, across_m: float) -> float:
    """P(|error along the axis| <= along_m and distance from the axis <= across_m), error ~ N(0, covariance).

    Args:
        covariance_m2: shape (3, 3), positive definite.
        axis: shape (3,), any length but zero.
        along_m, across_m: half width of the interval and radius of the disc; nothing is left where one is <= 0.
    """
    if along_m <= 0 or across_m <= 0:
        return 0.0
    turn = axis_frame(axis)
    local = turn @ covariance_m2 @ turn.T
    across = local[1:, 1:]
    slope: Float = np.linalg.solve(across, local[1:, 0]).astype(np.float64)
    spread = float(np.sqrt(max(local[0, 0] - local[0, 1:] @ slope, 1e-18 * local[0, 0])))
    whiten, kappa = _whitened(across, slope)
    column_1, column_2 = whiten.T
    a, b, c = column_1 @ column_1, column_1 @ column_2, column_2 @ column_2
    # Largest |z2| of the ellipse a z1^2 + 2 b z1 z2 + c z2^2 = r^2.
    z_max = across_m * float(np.sqrt(a / (a * c - b * b)))
    z, weight = _nodes(z_max, along_m, kappa, spread)
    half = across_m * np.sqrt(np.maximum(1.0 - (z / z_max) ** 2, 0.0) / a)
    chord = _between(-b / a * z - half, -b / a * z + half)
    slab = _between((-along_m - kappa * z) / spread, (along_m - kappa * z) / spread)
    return _clip(weight @ (np.exp(-0.5 * z * z) / np.sqrt(2 * np.pi) * slab * chord))


def ball_probability(covariance_m2: Float, radius_m: float) -> float:
    """P(|error| <= radius_m), error ~ N(0, covariance); the region that fits every direction of an unknown axis.

    The outer integral runs over the longest principal axis, the middle one over the next, the last is closed.
    """
    if radius_m <= 0:
        return 0.0
    third, second, first = np.sqrt(np.linalg.eigvalsh(covariance_m2))
    edge = np.arcsin(min(1.0, REACH * first / radius_m))
    outer, weight = _sine_nodes(np.linspace(-edge, edge, BALL_PANELS + 1))
    outer, weight = outer * radius_m / first, weight * radius_m / first
    rest = np.sqrt(np.maximum(radius_m**2 - (first * outer) ** 2, 0.0))
    unit, unit_weight = _sine_nodes(np.linspace(-np.pi / 2, np.pi / 2, BALL_PANELS + 1))
    # The inner interval ends at the disc or at REACH sigmas, whichever comes first; the rest is cut by the bracket.
    limit = np.minimum(rest / second, REACH)
    inner = limit[:, None] * unit
    last = np.sqrt(np.maximum(rest[:, None] ** 2 - (second * inner) ** 2, 0.0)) / third
    density = np.exp(-0.5 * inner**2) / np.sqrt(2 * np.pi)
    disc = limit * ((density * _between(-last, last)) @ unit_weight)
    return _clip(weight @ (np.exp(-0.5 * outer**2) / np.sqrt(2 * np.pi) * disc))


def axis_frame(axis: Float) -> Float:
    """Rotation, shape (3, 3), whose rows are the axis and two unit vectors across it."""
    along = axis / np.linalg.norm(axis)
    helper = np.eye(3)[np.argmin(np.abs(along))]
    side = np.cross(along, helper)
    side /= np.linalg.norm(side)
    return np.array([along, side, np.cross(along, side)], dtype=np.float64)


def _whitened(across: Float, slope: Float) -> tuple[Float, float]:
    """Square root M of the covariance across (c = M z), turned so that slope . c = kappa z2."""
    root: Float = np.linalg.cholesky(across).astype(np.float64)
    gradient = root.T @ slope
    kappa = float(np.linalg.norm(gradient))
    if kappa == 0.0:
        return root, 0.0
    second = gradient / kappa
    return root @ np.array([[-second[1], second[0]], [second[0], second[1]]]).T, kappa


def _nodes(z_max: float, along_m: float, kappa: float, spread: float) -> tuple[Float, Float]:
    edge = np.arcsin(min(1.0, REACH / z_max))
    breaks = np.linspace(-edge, edge, PANELS + 1)
    if kappa > 0:
        steep = (along_m + spread * np.linspace(-REACH, REACH, 7)) / kappa
        inside = np.concatenate([steep, -steep]) / z_max
        breaks = np.concatenate([breaks, np.arcsin(inside[np.abs(inside) < np.sin(edge)])])
    z, weight = _sine_nodes(np.sort(breaks))
    return z_max * z, z_max * weight


def _sine_nodes(breaks: Float) -> tuple[Float, Float]:
    """Gauss-Legendre nodes and weights on panels of phi, for integrals over sin(phi)."""
    half = np.diff(breaks)[:, None] / 2
    phi = breaks[:-1, None] + half * (NODES + 1)
    return np.sin(phi).ravel(), (half * WEIGHTS * np.cos(phi)).ravel()


def _between(low: Float, high: Float) -> Float:
    """Phi(high) - Phi(low) without cancellation in the upper tail."""
    flip = low > 0
    return np.where(flip, ndtr(-low) - ndtr(-high), ndtr(high) - ndtr(low))


def _clip(probability: float) -> float:
    return float(min(max(probability, 0.0), 1.0))
