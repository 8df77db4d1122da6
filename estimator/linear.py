"""The linearised problem as one sparse system: covariances of anything, and what each factor contributes."""

from collections.abc import Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_matrix, csr_matrix
from scipy.sparse.linalg import splu
from scipy.stats import chi2, norm

Float = NDArray[np.float64]

DETERMINED = 1e-3
"""A residual direction with less than this share of its own variance left is determined by its own measurement."""


def deviate(total: float, dof: int) -> float:
    """Chi-square in words of sigmas of one normal variable, two-sided."""
    tail = float(chi2.sf(total, dof))
    return float(np.sqrt(total)) if tail < 1e-300 else float(norm.isf(tail / 2))


@dataclass(frozen=True, slots=True)
class Shift:
    """k errors of the measurements, the other n unknowns eliminated (Baarda 1968)."""

    information: Float
    """Shape (k, k)."""
    alone: Float
    """Shape (k,): the diagonal of the information, were the other unknowns known."""
    right: Float
    """Shape (k,): information times estimate."""
    response: Float
    """Shape (n, k): the other unknowns change by `response @ y`."""

    def determined(self) -> bool:
        """Can the data tell these errors from the unknowns?"""
        least = float(np.linalg.eigvalsh(self.information / np.sqrt(np.outer(self.alone, self.alone)))[0])
        return bool((self.alone > 0).all()) and least > DETERMINED

    def solution(self) -> tuple[Float, Float]:
        """Estimate (k,) and covariance (k, k)."""
        covariance = np.linalg.inv(self.information)
        return covariance @ self.right, covariance


class LinearSystem:
    """Whitened Jacobian A at an estimate, with columns by variable and rows by factor.

    `covariance` and `contributions` use the same A, so that contributions sum to the covariance exactly.
    """

    def __init__(self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values) -> None:
        linear = graph.linearize(values)
        self.rows = np.array([linear.at(i).jacobian()[0].shape[0] for i in range(linear.size())])
        self.starts = np.concatenate([[0], np.cumsum(self.rows)])
        entries = np.asarray(linear.sparseJacobian_())
        keys = list(linear.keyVector())
        zero = values.zeroVectors()
        self.columns: dict[int, slice] = {}
        column = 0
        for key in sorted(keys):
            size = zero.at(key).size
            self.columns[key] = slice(column, column + size)
            column += size
        i, j = entries[0].astype(int) - 1, entries[1].astype(int) - 1
        shape = (int(self.starts[-1]), column)
        keep = j < column
        self.A = csr_matrix((entries[2][keep], (i[keep], j[keep])), shape=shape)
        self.b = np.zeros(shape[0])
        self.b[i[~keep]] = entries[2][~keep]
        information = csc_matrix(self.A.T @ self.A)
        self.inflation = np.ones(shape[0])
        """Variance of each row's error over what its whitening says, for errors that are correlated among rows."""
        self._factor = splu(
            information, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
        )

    @property
    def parameters(self) -> int:
        return self.A.shape[1]

    def solve(self, right: Float) -> Float:
        """`(A^T A)^-1 right`, right of shape (n, k)."""
        return self._factor.solve(np.ascontiguousarray(right))

    def selector(self, blocks: Sequence[tuple[int, Float]]) -> Float:
        """A Jacobian over all variables from blocks (key, J of shape (m, dim)); returns its transpose (n, m)."""
        full = np.zeros((self.parameters, blocks[0][1].shape[0]))
        for key, J in blocks:
            full[self.columns[key]] += J.T
        return full

    def influence(self, blocks: Sequence[tuple[int, Float]]) -> Float:
        """`C^1/2 A (A^T A)^-1 J^T`, shape (rows, m), C the rows' inflation: the squares of its rows are the contributions.

        With C = 1 they sum to `J (A^T A)^-1 J^T`, else to the covariance of the same estimate under the larger errors
        (the sandwich form, Huber 1967).
        """
        return np.sqrt(self.inflation)[:, None] * (self.A @ self.solve(self.selector(blocks)))

    def covariance(self, blocks: Sequence[tuple[int, Float]]) -> Float:
        """Covariance of `J x`, shape (m, m)."""
        influence = self.influence(blocks)
        return influence.T @ influence

    def joint(self, keys: Sequence[int]) -> Float:
        """Joint covariance of some variables, in the order of `keys`."""
        widths = [self.columns[k].stop - self.columns[k].start for k in keys]
        offsets = np.concatenate([[0], np.cumsum(widths)])
        blocks = [(k, np.eye(offsets[-1])[:, offsets[i] : offsets[i + 1]]) for i, k in enumerate(keys)]
        return self.covariance(blocks)

    def standardised(self, position: int) -> float:
        """Residual of one factor against what all others predict, as a deviate of one normal variable."""
        rows = slice(self.starts[position], self.starts[position + 1])
        A = self.A[rows].toarray()
        hat = A @ self.solve(A.T)
        eigenvalues, vectors = np.linalg.eigh(np.eye(A.shape[0]) - 0.5 * (hat + hat.T))
        free = eigenvalues > DETERMINED
        if not free.any():
            return 0.0
        along = (vectors.T @ self.b[rows])[free]
        return deviate(float((along**2 / eigenvalues[free]).sum()), int(free.sum()))

    def shift(self, C: csr_matrix) -> Shift:
        """Errors of the measurements as further unknowns y: `b = A x + C y`.

        Args:
            C: shape (rows, k), whitened.
        """
        AC = np.asarray((self.A.T @ C).todense())
        response = -self.solve(AC)
        full = np.asarray((C.T @ C).todense())
        return Shift(full + AC.T @ response, full.diagonal(), np.asarray(C.T @ self.b), response)

    def leverage(self, group: NDArray[np.int64], groups: int, probes: int = 64, seed: int = 0) -> Float:
        """Number of parameters that each group of factors determines (trace of its part of the hat matrix).

        Args:
            group: shape (number of factors,), group of each.

        Hutchinson's estimator with fixed random signs, one solution for all groups; reproducible.
        """
        signs = np.random.default_rng(seed).choice([-1.0, 1.0], size=(self.A.shape[0], probes))
        hat = (signs * (self.A @ self.solve(self.A.T @ signs))).mean(axis=1)
        shares = np.bincount(np.repeat(group, self.rows), weights=hat, minlength=groups)
        rows = np.bincount(np.repeat(group, self.rows), minlength=groups)
        return np.clip(shares, 0.0, rows)
