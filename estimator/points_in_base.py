"""Points, axes and radii in {b}, with covariance from the joint of `o_T_b` and what is seen from it."""

from collections.abc import Sequence
from functools import cache
from typing import Protocol

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from ..factors import keys
from ..factors.chance import chi2_ppf
from ..factors.geometry import point_to_frame
from .result import PipeEstimate

Float = NDArray[np.float64]
Blocks = list[tuple[int, Float]]


class Covariances(Protocol):
    """A solved problem."""

    def covariance(self, blocks: Sequence[tuple[int, Float]]) -> Float:
        """Covariance of `J x`, J given by blocks (key, columns of the key)."""
        ...


def present_base(values: gtsam.Values) -> int:
    """Key of `o_T_b` of the last station."""
    station = 0
    while values.exists(keys.base(station + 1)):
        station += 1
    return keys.base(station)


def point_blocks(values: gtsam.Values, base: int, point: int) -> tuple[Float, Blocks]:
    """`b_p = o_T_b^-1 o_p` and its Jacobians."""
    b_p, d_pose, d_point = point_to_frame(values.atPose3(base), values.atPoint3(point))
    return b_p, [(base, d_pose), (point, d_point)]


def radius95(covariance: Float) -> float:
    """Radius of the sphere about the mean that holds 95 % of a trivariate normal distribution.

    Exact: the squared radius is a weighted sum of three chi-square variables; its distribution is integrated over
    the largest axis (Gauss-Legendre), the two others in closed form by a further quadrature over the angle.
    """
    variances = np.clip(np.sort(np.linalg.eigvalsh(covariance))[::-1], 0.0, None)
    if variances[0] == 0.0:
        return 0.0
    sigma = np.sqrt(variances)
    upper = float(sigma[0] * np.sqrt(chi2_ppf(0.95, 3)))
    lower = float(sigma[0] * 1.9)
    root = brentq(lambda r: _inside(r, sigma) - 0.95, lower, upper * 1.0001, xtol=1e-9 + 1e-6 * upper)
    return float(root)  # pyright: ignore[reportArgumentType]  # without full_output it is a number


@cache
def _quadrature() -> tuple[Float, Float]:
    """Gauss-Legendre nodes and weights on (-1, 1)."""
    return np.polynomial.legendre.leggauss(64)


def _inside(radius: float, sigma: Float) -> float:
    """Probability of a centred trivariate normal within a sphere; `sigma` in descending order."""
    nodes, weights = _quadrature()
    angles = (nodes + 1) * np.pi / 4
    reach = min(radius, 8.5 * sigma[0])
    x = (nodes + 1) / 2 * reach
    s1, s2 = max(sigma[1], 1e-9 * sigma[0]), max(sigma[2], 1e-9 * sigma[0])
    rest = radius**2 - x**2
    g = (np.cos(angles) / s1) ** 2 + (np.sin(angles) / s2) ** 2
    disc = (-np.expm1(-0.5 * np.outer(rest, g)) / g / (s1 * s2)) @ weights * (np.pi / 4) * 2 / np.pi
    density = np.exp(-0.5 * (x / sigma[0]) ** 2) / (np.sqrt(2 * np.pi) * sigma[0])
    return float((density * disc) @ weights * reach)


def pipe_estimate(
    name: str, frame: str, index: int, base: int, near: Float, values: gtsam.Values, system: Covariances
) -> PipeEstimate:
    """A pipe in {b}: the point of its axis nearest to `near` ({b}), direction and radius, covariance (7, 7)."""
    a, blocks_a = point_blocks(values, base, keys.axis_start(index))
    b, blocks_b = point_blocks(values, base, keys.axis_end(index))
    d = (b - a) / np.linalg.norm(b - a)
    s = float(d @ (near - a)) / float(np.linalg.norm(b - a))
    across = (np.eye(3) - np.outer(d, d)) / np.linalg.norm(b - a)
    shape = np.zeros((7, 7))
    shape[:3, :3], shape[:3, 3:6] = (1 - s) * np.eye(3), s * np.eye(3)
    shape[3:6, :3], shape[3:6, 3:6] = -across, across
    shape[6, 6] = 1.0
    blocks: Blocks = []
    for key, J in blocks_a:
        blocks.append((key, shape[:, :3] @ J))
    for key, J in blocks_b:
        blocks.append((key, shape[:, 3:6] @ J))
    blocks.append((keys.radius(index), shape[:, 6:]))
    covariance = system.covariance(blocks)
    radius = float(values.atVector(keys.radius(index))[0])
    return PipeEstimate(name, frame, a + s * (b - a), d, radius, covariance)
