"""Old variables out of the graph: what their factors say about the others stays, as one Gaussian factor.

Eliminating variables from the linearised problem (the Schur complement) leaves the posterior of the rest unchanged, to
first order about the linearisation point, which the factor keeps: Leutenegger et al. 2015, section 3.3.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

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
        """As one factor of the graph, with a row for each direction that is informed about."""
        A, b = square_root(self.H, self.g)
        stops = np.cumsum(self.widths)
        terms = [
            (key, A[:, stop - width : stop]) for key, width, stop in zip(self.keys, self.widths, stops, strict=True)
        ]
        # Of GTSAM's wrapped linear factors only the conditional takes any number of variables.
        many = gtsam.GaussianConditional(terms, 1, b, gtsam.noiseModel.Diagonal.Sigmas(np.ones(len(b))))
        return gtsam.LinearContainerFactor(gtsam.JacobianFactor(many), only(self.at, self.keys))


def square_root(H: Float, g: Float) -> tuple[Float, Float]:
    """A (m, n) and b (m,) with `A'A = H` and `A'b = g`, without directions that are rounding."""
    scale = 1.0 / np.sqrt(np.maximum(np.diag(H), 1e-300))
    values, vectors = np.linalg.eigh(0.5 * (H + H.T) * np.outer(scale, scale))
    real = values > NOTHING_REL * values[-1]
    A = (np.sqrt(values[real]) * vectors[:, real]).T / scale[None, :]
    return A, (vectors[:, real] / np.sqrt(values[real])).T @ (scale * g)


def marginal(factors: Sequence[gtsam.NonlinearFactor], values: gtsam.Values, gone: Collection[int]) -> GaussianPrior:
    """What factors say about the variables that stay.

    Args:
        factors: all that touch a variable that goes.
        values: the estimate; the linearisation point.
        gone: keys of the variables that go; each is determined by the factors and the variables that stay.
    """
    graph = gtsam.NonlinearFactorGraph()
    for factor in factors:
        graph.add(factor)
    return _eliminated(graph, values, set(gone).intersection(graph.keyVector()))


def _eliminated(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, gone: set[int]) -> GaussianPrior:
    order = gtsam.Ordering()
    for key in sorted(gone, key=lambda k: (keys.kind(k) not in "lz", k)):  # landmarks first: they are sparse
        order.push_back(key)
    _, rest = graph.linearize(values).eliminatePartialMultifrontal(order)
    joint = gtsam.HessianFactor(rest)
    order_of_rest = tuple(joint.keys())
    information = np.asarray(joint.augmentedInformation(), float)
    widths = tuple(WIDTHS[keys.kind(key)] for key in order_of_rest)
    return GaussianPrior(
        order_of_rest, widths, information[:-1, :-1], information[:-1, -1], only(values, order_of_rest)
    )


def gaussian_of(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, stay: Collection[int]) -> GaussianPrior:
    """The joint Gaussian of some variables of a graph, all others eliminated.

    Args:
        stay: keys; those that no factor touches are left out.
    """
    return _eliminated(graph, values, set(graph.keyVector()).difference(stay))


def joint_of(factor: gtsam.NonlinearFactor, values: gtsam.Values) -> GaussianPrior:
    """What a factor says about its variables to first order."""
    joint = gtsam.HessianFactor(factor.linearize(values))
    order = tuple(joint.keys())
    information = np.asarray(joint.augmentedInformation(), float)
    widths = tuple(WIDTHS[keys.kind(key)] for key in order)
    return GaussianPrior(order, widths, information[:-1, :-1], information[:-1, -1], only(values, order))


def without(prior: GaussianPrior, gone: Collection[int]) -> GaussianPrior | None:
    """What a joint Gaussian says about its variables but some; None where these are all.

    Directions of those that it knows nothing about take nothing with them.
    """
    stay = [i for i, key in enumerate(prior.keys) if key not in gone]
    if not stay:
        return None
    out = np.repeat([key in gone for key in prior.keys], prior.widths)
    H, g = prior.H, prior.g
    taken = H[np.ix_(~out, out)] @ np.linalg.pinv(H[np.ix_(out, out)], rcond=NOTHING_REL, hermitian=True)
    left = tuple(prior.keys[i] for i in stay)
    return GaussianPrior(
        left,
        tuple(prior.widths[i] for i in stay),
        H[np.ix_(~out, ~out)] - taken @ H[np.ix_(out, ~out)],
        g[~out] - taken @ g[out],
        only(prior.at, left),
    )


def renamed(prior: GaussianPrior, names: Mapping[int, int]) -> GaussianPrior:
    """The same about other variables of the same kinds: `rekey` of a factor made by `GaussianPrior.factor` would change
    the factor that it is taken from."""
    at = gtsam.Values()
    for key in prior.keys:
        at.insert(names.get(key, key), value_of(prior.at, key))
    return replace(prior, keys=tuple(names.get(key, key) for key in prior.keys), at=at)


def carried(prior: GaussianPrior, moved: Collection[int], correction: gtsam.Pose3) -> GaussianPrior:
    """The same about variables of which some have been moved together: what it says of their shape goes along.

    Tangents of poses are those of their own axes and stay; those of points turn with {o}.

    Args:
        correction: from the left on all that is moved.
    """
    at, turn = gtsam.Values(), np.eye(len(prior.g))
    stops = np.cumsum(prior.widths)
    for key, width, stop in zip(prior.keys, prior.widths, stops, strict=True):
        value = value_of(prior.at, key)
        if key in moved and isinstance(value, gtsam.Pose3):
            value = correction.compose(value)
        elif key in moved and keys.kind(key) in POINTS:
            value = correction.transformFrom(prior.at.atPoint3(key))
            turn[stop - width : stop, stop - width : stop] = correction.rotation().matrix()
        at.insert(key, value)
    return replace(prior, H=turn @ prior.H @ turn.T, g=turn @ prior.g, at=at)


POINTS = "lzqpuv"
WIDTHS = {
    "x": 6,
    "f": 6,
    "b": 6,
    "e": 6,
    "l": 3,
    "z": 3,
    "q": 3,
    "p": 3,
    "u": 3,
    "v": 3,
    "h": 2,
    "r": 1,
    "w": 1,
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
    if kind in POINTS:
        return values.atPoint3(key)
    return values.atCal3DS2(key) if kind == "k" else values.atVector(key)
