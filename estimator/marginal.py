"""Old variables out of the graph: what their factors say about the others stays, as one Gaussian factor.

Eliminating variables from the linearised problem (the Schur complement) leaves the posterior of the rest unchanged, to
first order about the linearisation point, which the factor keeps: Leutenegger et al. 2015, section 3.3.
"""

import itertools
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray

from ..factors import keys

Float = NDArray[np.float64]

FAMILY = "earlier keyframes"
NOTHING_REL = 1e-14
"""Eigenvalues of the scaled information below this share of the largest are rounding."""


@dataclass(frozen=True, slots=True)
class GaussianPrior:
    """A joint Gaussian of some variables: `dx' H dx / 2 - g' dx`, dx in the tangents at `at`."""

    keys: tuple[int, ...]
    widths: tuple[int, ...]
    H: Float
    """Shape (n, n), n the sum of the widths."""
    g: Float
    """Shape (n,)."""
    at: gtsam.Values
    """Linearisation point, of at least these variables."""

    def factor(self) -> gtsam.NonlinearFactor:
        """As one factor of the graph. GTSAM's wrapper makes linear factors of up to three variables; their sum has
        any number."""
        starts = np.concatenate([[0], np.cumsum(self.widths)])
        cut = [slice(int(a), int(b)) for a, b in itertools.pairwise(starts)]
        H, g, energy = positive_part(self.H, self.g)
        parts = gtsam.GaussianFactorGraph()
        for i, (a, key) in enumerate(zip(cut, self.keys, strict=True)):
            parts.push_back(gtsam.HessianFactor(key, H[a, a], g[a], energy if i == 0 else 0.0))
            for b, other in zip(cut[i + 1 :], self.keys[i + 1 :], strict=True):
                if H[a, b].any():
                    zero_a, zero_b = np.zeros((self.widths[i],) * 2), np.zeros((b.stop - b.start,) * 2)
                    nothing = np.zeros(len(zero_a)), np.zeros(len(zero_b))
                    parts.push_back(
                        gtsam.HessianFactor(key, other, zero_a, H[a, b], nothing[0], zero_b, nothing[1], 0.0)
                    )
        return gtsam.LinearContainerFactor(gtsam.HessianFactor(parts), only(self.at, self.keys))


def positive_part(H: Float, g: Float) -> tuple[Float, Float, float]:
    """H and g without directions that are rounding, and the constant that makes the least value zero."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(H), 1e-300))
    values, vectors = np.linalg.eigh(0.5 * (H + H.T) * np.outer(scale, scale))
    real = values > NOTHING_REL * values[-1]
    root = (vectors[:, real] * np.sqrt(values[real])) / scale[:, None]
    whitened = (vectors[:, real] / np.sqrt(values[real])).T @ (scale * g)
    return root @ root.T, root @ whitened, float(whitened @ whitened)


def marginal(
    factors: Sequence[gtsam.NonlinearFactor], values: gtsam.Values, gone: Collection[int]
) -> gtsam.LinearContainerFactor:
    """What factors say about the variables that stay.

    Args:
        factors: all that touch a variable that goes.
        values: the estimate; the linearisation point.
        gone: keys of the variables that go; each is determined by the factors and the variables that stay.
    """
    graph = gtsam.NonlinearFactorGraph()
    for factor in factors:
        graph.add(factor)
    touched = {key for factor in factors for key in factor.keys()}
    order = gtsam.Ordering()
    for key in sorted(set(gone) & touched, key=lambda k: (keys.kind(k) != "l", k)):  # landmarks first: they are sparse
        order.push_back(key)
    _, rest = graph.linearize(values).eliminatePartialMultifrontal(order)
    return gtsam.LinearContainerFactor(gtsam.HessianFactor(rest), only(values, touched.difference(gone)))


def gaussian_of(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, stay: Collection[int]) -> GaussianPrior:
    """The joint Gaussian of some variables of a graph, all others eliminated.

    Args:
        stay: keys; those that no factor touches are left out.
    """
    factors = [graph.at(i) for i in range(graph.size())]
    touched = {key for factor in factors for key in factor.keys()}
    linear = marginal(factors, values, touched.difference(stay))
    order = tuple(linear.keys())
    information = np.asarray(linear.toHessian().augmentedInformation(), float)
    widths = tuple(WIDTHS[keys.kind(key)] for key in order)
    return GaussianPrior(order, widths, information[:-1, :-1], information[:-1, -1], only(values, order))


WIDTHS = {
    "x": 6,
    "f": 6,
    "b": 6,
    "e": 6,
    "l": 3,
    "q": 3,
    "p": 3,
    "u": 3,
    "v": 3,
    "h": 2,
    "r": 1,
    "k": 9,
    "d": 2,
    "g": 3,
}
"""Degrees of freedom by kind of variable."""


def only(values: gtsam.Values, wanted: Collection[int]) -> gtsam.Values:
    """Some of the values."""
    found = gtsam.Values()
    for key in wanted:
        found.insert(key, value_of(values, key))
    return found


def value_of(values: gtsam.Values, key: int) -> gtsam.Pose3 | gtsam.Cal3DS2 | Float:
    """A variable's value, whatever its kind."""
    kind = keys.kind(key)
    if kind in "xfbe":
        return values.atPose3(key)
    if kind in "lqpuv":
        return values.atPoint3(key)
    return values.atCal3DS2(key) if kind == "k" else values.atVector(key)
