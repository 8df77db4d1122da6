"""The linearised problem as one sparse system: covariances of anything, and what each factor contributes."""

from collections.abc import Iterator, Sequence
from copy import copy
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import block_diag, csr_matrix, diags, identity, vstack

from ..factors.chance import chi2_sf, normal_isf
from .normal_equations import NormalEquations

Float = NDArray[np.float64]
Blocks = Sequence[tuple[int, Float]]

DETERMINED = 1e-3
"""A residual direction with less than this share of its own variance left is determined by its own measurement."""

CHUNK = 64
"""Right-hand sides that are solved together, at most: more of them only fill the caches."""
CHUNK_ENTRIES = 8_000_000
"""... and entries (rows of the system times right-hand sides): 64 MB, however long the recording."""


def deviate(total: float, dof: int) -> float:
    """Chi-square in words of sigmas of one normal variable, two-sided."""
    tail = chi2_sf(total, dof)
    return float(np.sqrt(total)) if tail < 1e-300 else normal_isf(tail / 2)


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
        return np.asarray(covariance @ self.right, float), np.asarray(covariance, float)


class LinearSystem:
    """Whitened Jacobian A at an estimate, with columns by variable and rows by factor.

    `covariance` and `contributions` use the same A, so that contributions sum to the covariance exactly.
    """

    def __init__(
        self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, rows: NDArray[np.int64] | None = None
    ) -> None:
        """
        Args:
            rows: dimensions of the factors, where they are known already.
        """
        self.linear = graph.linearize(values)
        self.rows = np.array([graph.at(i).dim() for i in range(graph.size())]) if rows is None else rows
        self.starts = np.concatenate([[0], np.cumsum(self.rows)])
        zero = values.zeroVectors()
        self.columns: dict[int, slice] = {}
        column = 0
        for key in sorted(self.linear.keyVector()):
            size = zero.at(key).size
            self.columns[key] = slice(column, column + size)
            column += size
        self._columns = column
        self._entries = np.asarray(self.linear.sparseJacobian_())
        right = np.flatnonzero(self._entries[1] > column)
        self.b = np.zeros(int(self.starts[-1]))
        self.b[self._entries[0, right].astype(np.int32) - 1] = self._entries[2, right]
        self.root: csr_matrix | None = None
        """Shape (rows, rows): times its transpose the covariance of the whitened errors, where they are correlated;
        None for the identity."""

    @cached_property
    def A(self) -> csr_matrix:
        """Shape (rows, parameters). Residuals alone do without."""
        i, j, data = self._entries
        left = j <= self._columns
        place = i[left].astype(np.int32) - 1, j[left].astype(np.int32) - 1
        return csr_matrix((data[left], place), shape=(len(self.b), self._columns))

    @cached_property
    def _normal(self) -> NormalEquations:
        """Only covariances need it, residuals do not."""
        return NormalEquations(self.information, self.columns)

    @cached_property
    def information(self) -> csr_matrix:
        """`A^T A`, shape (parameters, parameters)."""
        return csr_matrix(self.A.T @ self.A)

    @property
    def parameters(self) -> int:
        return self._columns

    @property
    def _together(self) -> int:
        """Right-hand sides that are solved together."""
        return max(1, min(CHUNK, CHUNK_ENTRIES // max(len(self.b), 1)))

    def solve(self, right: Float) -> Float:
        """`(A^T A)^-1 right`, right of shape (n, k)."""
        if right.shape[1] <= CHUNK:
            return self._normal.solve(right)
        parts = range(0, right.shape[1], CHUNK)
        return np.hstack([self._normal.solve(np.ascontiguousarray(right[:, at : at + CHUNK])) for at in parts])

    def residuals_of(self, errors: Float) -> Float:
        """What the adjustment leaves of errors of the measurements, both (rows, k)."""
        left = np.empty_like(errors)
        for start in range(0, errors.shape[1], self._together):
            part = errors[:, start : start + self._together]
            left[:, start : start + self._together] = part - self.A @ self.solve(self.A.T @ part)
        return left

    def rest_covariance(self) -> tuple[NDArray[np.int64], Float | None]:
        """Place (n,) of every unknown among those that are no landmark, -1 for landmarks, and the covariance of those;
        None where they are too many."""
        return self._normal.rest_inverse()

    def settled(self) -> "tuple[LinearSystem, Float, float]":
        """The same with the residuals of its solution, the step (n,) to there, and its gain of half the squares."""
        pull = self.A.T @ self.b
        step = self.solve(pull[:, None])[:, 0]
        other = copy(self)
        other.b = self.b - self.A @ step
        return other, step, 0.5 * float(pull @ step)

    def moved(self, values: gtsam.Values, step: Float) -> gtsam.Values:
        """The estimate a step (n,) on."""
        delta = gtsam.VectorValues()
        for key, columns in self.columns.items():
            delta.insert(key, step[columns])
        return values.retract(delta)

    def weighed_rows(self, root_weight: Float) -> "tuple[LinearSystem, Float]":
        """The system of the same factors with other weights, at its own solution, and the step (n,) to there.

        Args:
            root_weight: shape (rows,), one over the factors of the rows' standard deviations.
        """
        return self._other(csr_matrix(diags(root_weight) @ self.A), root_weight * self.b).settled()[:2]

    def exchanged(
        self, removed: Sequence[int], graph: gtsam.NonlinearFactorGraph, values: gtsam.Values
    ) -> "LinearSystem":
        """The system with other factors of the same variables in the place of some; their errors are independent.

        Args:
            removed: positions of factors.
            graph: the new ones, which come after those that stay.
            values: where they are linearised; the others stay as they are.
        """
        new = LinearSystem(graph, values)
        place = np.concatenate([np.arange(self.parameters)[self.columns[key]] for key in new.columns])
        J = new.A.tocoo()
        J = csr_matrix((J.data, (J.row, place[J.col])), shape=(len(new.b), self.parameters))
        stays = np.ones(len(self.rows), bool)
        stays[removed] = False
        rows = np.repeat(stays, self.rows)
        other = self._other(csr_matrix(vstack([self.A[rows], J])), np.concatenate([self.b[rows], new.b]))
        gone = self.A[~rows]
        other.information = csr_matrix(self.information - gone.T @ gone + J.T @ J)
        other.rows = np.concatenate([self.rows[stays], new.rows])
        other.starts = np.concatenate([[0], np.cumsum(other.rows)])
        if self.root is not None:
            other.root = csr_matrix(block_diag((self.root[rows][:, rows], identity(len(new.b)))))
        return other

    def _other(self, A: csr_matrix, b: Float) -> "LinearSystem":
        """Of the same variables."""
        other = copy(self)
        for cached in ("_normal", "information"):
            other.__dict__.pop(cached, None)
        other.A, other.b, other.root = A, b, None
        return other

    def selector(self, blocks: Blocks) -> Float:
        """A Jacobian over all variables from blocks (key, J of shape (m, dim)); returns its transpose (n, m)."""
        full = np.zeros((self.parameters, blocks[0][1].shape[0]))
        for key, J in blocks:
            full[self.columns[key]] += J.T
        return full

    def influence(self, blocks: Blocks) -> Float:
        """`R^T A (A^T A)^-1 J^T`, shape (rows, m), R R^T the errors' covariance: its squares are the contributions.

        With R = 1 they sum to `J (A^T A)^-1 J^T`, else to the covariance of the same estimate under the errors as they
        are (the sandwich form, Huber 1967).
        """
        return self.weigh(self.A @ self.solve(self.selector(blocks)))

    def weigh(self, sensitivity: Float) -> Float:
        """`R^T Y` of sensitivities Y to the whitened errors, (rows, m)."""
        return sensitivity if self.root is None else np.asarray(self.root.T @ sensitivity)

    def spread(self, X: Float) -> Float:
        """Covariance (m, m) of `X^T A^T e`, e the whitened errors, X of shape (n, m): as `influence`, in parts that do
        not leave the caches."""
        weighed = np.empty((len(self.b), X.shape[1]))
        for start in range(0, X.shape[1], self._together):
            part = slice(start, start + self._together)
            weighed[:, part] = self.weigh(self.A @ np.ascontiguousarray(X[:, part]))
        return weighed.T @ weighed

    def error_covariance(self, rows: NDArray[np.int64] | NDArray[np.bool_]) -> Float:
        """Covariance (k, k) of the whitened errors of some rows (index or mask)."""
        root = (csr_matrix(identity(len(self.b))) if self.root is None else self.root)[rows]
        return np.asarray((root @ root.T).todense())

    def covariance(self, blocks: Blocks) -> Float:
        """Covariance of `J x`, shape (m, m)."""
        influence = self.influence(blocks)
        return influence.T @ influence

    def joint(self, keys: Sequence[int]) -> Float:
        """Joint covariance of some variables, in the order of `keys`."""
        widths = [self.columns[k].stop - self.columns[k].start for k in keys]
        offsets = np.concatenate([[0], np.cumsum(widths)])
        blocks = [(k, np.eye(offsets[-1])[:, offsets[i] : offsets[i + 1]]) for i, k in enumerate(keys)]
        return self.covariance(blocks)

    def marginals(self, keys: Sequence[int]) -> list[Float]:
        """Each variable's own covariance."""
        if self.root is not None:
            return self.covariances([[(k, np.eye(self.columns[k].stop - self.columns[k].start))] for k in keys])
        found = []
        for chunk in _chunks([self.columns[k].stop - self.columns[k].start for k in keys], self._together):
            found += self._normal.inverse_blocks([self.columns[keys[i]] for i in chunk])
        return found

    def covariances(self, of: Sequence[Blocks]) -> list[Float]:
        """Covariance of each of several `J x` alone, given by blocks (key, J of shape (m, dim))."""
        found = []
        for chunk in _chunks([blocks[0][1].shape[0] for blocks in of], self._together):
            right = [self.selector(of[i]) for i in chunk]
            influence = self.weigh(self.A @ self.solve(np.hstack(right)))
            at = np.concatenate([[0], np.cumsum([r.shape[1] for r in right])])
            found += [influence[:, a:b].T @ influence[:, a:b] for a, b in pairwise(at)]
        return found

    def hats(self, positions: Sequence[int]) -> list[Float]:
        """Each factor's own block of the hat matrix `A (A^T A)^-1 A^T`."""
        found = []
        for chunk in _chunks([int(self.rows[p]) for p in positions], self._together):
            rows = [slice(self.starts[positions[i]], self.starts[positions[i] + 1]) for i in chunk]
            A = vstack([self.A[r] for r in rows]).tocsr()
            hat = A @ self.solve(A.T.toarray())
            at = np.concatenate([[0], np.cumsum([r.stop - r.start for r in rows])])
            found += [hat[a:b, a:b].copy() for a, b in pairwise(at)]
        return found

    def standardised(self, positions: Sequence[int]) -> list[tuple[float, int]]:
        """Residual of each factor against what all others predict: chi-square and its degrees of freedom.

        The residual's covariance is I - H, with H the factor's block of the hat matrix; directions that the factor
        determines alone do not count.
        """
        found = []
        for position, hat in zip(positions, self.hats(positions), strict=True):
            eigenvalues, vectors = np.linalg.eigh(np.eye(len(hat)) - 0.5 * (hat + hat.T))
            free = eigenvalues > DETERMINED
            along = (vectors.T @ self.b[self.starts[position] : self.starts[position + 1]])[free]
            found.append((float((along**2 / eigenvalues[free]).sum()), int(free.sum())))
        return found

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
        rng, hat = np.random.default_rng(seed), np.zeros(self.b.size)
        for start in range(0, probes, self._together):
            signs = rng.choice([-1.0, 1.0], size=(self.b.size, min(self._together, probes - start)))
            hat += (signs * (self.A @ self.solve(self.A.T @ signs))).sum(axis=1) / probes
        shares = np.bincount(np.repeat(group, self.rows), weights=hat, minlength=groups)
        rows = np.bincount(np.repeat(group, self.rows), minlength=groups).astype(float)
        return np.asarray(np.clip(shares, 0.0, rows), np.float64)


def _chunks(widths: Sequence[int], most: int) -> Iterator[list[int]]:
    """Indices in groups of at most so many columns together."""
    group: list[int] = []
    total = 0
    for i, width in enumerate(widths):
        if group and total + width > most:
            yield group
            group, total = [], 0
        group.append(i)
        total += width
    if group:
        yield group
