"""What further measurements would do to a covariance: predicted factors added to the linearised graph."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Self

import gtsam
import numpy as np
from numpy.typing import NDArray

from .linear import LinearSystem

Float = NDArray[np.float64]
Blocks = Sequence[tuple[int, Float]]


@dataclass(frozen=True, slots=True)
class Predicted:
    """A factor that is not there yet, with residual zero at the estimate."""

    factor: gtsam.NonlinearFactor
    inflation: float = 1.0
    """Variance of its error over what its noise model says (errors that are correlated among factors)."""


@dataclass(frozen=True, slots=True)
class Rows:
    """Whitened rows of predicted factors over the touched variables, new variables eliminated."""

    W: Float
    """Shape (k, t)."""
    C: Float
    """Shape (k, k), covariance of the whitened errors: the identity, or more where errors are correlated."""


@dataclass(frozen=True, slots=True)
class Joint:
    """Some variables: the inverse information that weighs measurements, and the covariance of the estimate.

    They are equal as long as the weights are right. Where errors are correlated (`LinearSystem.root`) the weights
    stay and the covariance grows.
    """

    columns: Mapping[int, slice]
    weight: Float
    """Shape (t, t): `(A^T A)^-1`."""
    covariance: Float
    """Shape (t, t): `(A^T A)^-1 A^T C A (A^T A)^-1`."""

    @classmethod
    def of(cls, system: LinearSystem, keys: Sequence[int]) -> Self:
        """The joint of some variables of the graph as it is."""
        columns, X = _solved(system, keys)
        selected = np.concatenate([np.arange(system.parameters)[system.columns[key]] for key in keys])
        weight = X[selected]
        return cls(columns, 0.5 * (weight + weight.T), system.spread(X))

    def after(self, rows: Rows, blocks: Blocks) -> Float:
        """Covariance of `J x` after further measurements.

        The estimator weighs them by the gain G = P W^T (W P W^T + I)^-1 with the weights P that it has; the error of
        the new estimate is (I - G W) e + G n, so its covariance is (I - G W) S (I - G W)^T + G C G^T (Joseph's form).
        Only J times that is formed.
        """
        J, W, P = self._jacobian(blocks), rows.W, self.weight
        if len(W) == 0:
            return J @ self.covariance @ J.T
        WP = W @ P
        JG = np.linalg.solve(WP @ W.T + np.eye(len(W)), WP @ J.T).T
        JK = J - JG @ W
        return JK @ self.covariance @ JK.T + JG @ rows.C @ JG.T

    def rows(self, predicted: Sequence[Predicted], values: gtsam.Values) -> Rows:
        """Linearises factors at the estimate; variables that the joint does not hold are new and eliminated.

        Rows that a new variable touches are projected on the left null space of its Jacobian, which leaves what they
        say about the others (Mourikis and Roumeliotis 2007).

        Args:
            values: the estimate, with places for the new variables.
        """
        linear = [p.factor.linearize(values) for p in predicted]
        sizes = [factor.jacobian()[0].shape[0] for factor in linear]
        starts = np.concatenate([[0], np.cumsum(sizes)]).astype(int)
        zero = values.zeroVectors()
        new: dict[int, slice] = {}
        width = 0
        for key in sorted({int(k) for factor in linear for k in factor.keys()} - set(self.columns)):
            new[key] = slice(width, width + zero.at(key).size)
            width = new[key].stop
        W, N = np.zeros((starts[-1], len(self.weight))), np.zeros((starts[-1], width))
        c = np.concatenate([np.full(n, p.inflation) for n, p in zip(sizes, predicted, strict=True)])
        for i, factor in enumerate(linear):
            A, offset = factor.jacobian()[0], 0
            for key in factor.keys():
                own = self.columns.get(key)
                target, place = (W, own) if own is not None else (N, new[key])
                size = place.stop - place.start
                target[starts[i] : starts[i + 1], place] = A[:, offset : offset + size]
                offset += size
        if width == 0:
            return Rows(W, np.diag(c))
        left = _left_null_space(N)
        return Rows(left @ W, left @ (c[:, None] * left.T))

    def _jacobian(self, blocks: Blocks) -> Float:
        J = np.zeros((blocks[0][1].shape[0], len(self.weight)))
        for key, part in blocks:
            J[:, self.columns[key]] += part
        return J


def _solved(system: LinearSystem, keys: Sequence[int]) -> tuple[dict[int, slice], Float]:
    """Columns of `(A^T A)^-1` that belong to some variables, shape (n, t), and which column is whose."""
    columns: dict[int, slice] = {}
    width = 0
    for key in keys:
        own = system.columns[key]
        columns[key] = slice(width, width + own.stop - own.start)
        width = columns[key].stop
    right = np.zeros((system.parameters, width))
    for key, place in columns.items():
        right[system.columns[key], place] = np.eye(place.stop - place.start)
    return columns, system.solve(right)


def _left_null_space(N: Float) -> Float:
    """Orthonormal rows L with L N = 0, shape (rows - rank, rows)."""
    scale = np.linalg.norm(N, axis=0)
    vectors, singular, _ = np.linalg.svd(N / np.where(scale > 0, scale, 1.0), full_matrices=True)
    rank = int((singular > 1e-9 * singular[0]).sum()) if singular.size else 0
    return vectors[:, rank:].T


def measured_again(system: LinearSystem, rows: NDArray[np.bool_], times: float, blocks: Blocks) -> Float:
    """Covariance of `J x` if some rows of the graph had been measured `times` as often, with independent errors.

    Args:
        rows: shape (rows of the system,).
    """
    J = system.selector(blocks)
    W = np.sqrt(times - 1.0) * system.A[rows].toarray()
    right = np.hstack([J, W.T])
    X = system.solve(right)
    joint = Joint({0: slice(0, right.shape[1])}, right.T @ X, system.spread(X))
    select = np.hstack([np.zeros((len(W), J.shape[1])), np.eye(len(W))])
    return joint.after(Rows(select, system.error_covariance(rows)), [(0, np.eye(J.shape[1], right.shape[1]))])
