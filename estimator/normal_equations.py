"""Sparse normal equations solved in two steps: variables that only touch the rest are eliminated block by block, the
rest is solved densely (the Schur complement of bundle adjustment; Triggs et al. 2000, section 6)."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse import csc_matrix, csr_matrix
from scipy.sparse.linalg import splu

from ..factors import keys
from ..factors.errors import ObservabilityError
from .observability import Undetermined, not_observable

Float = NDArray[np.float64]
Int = NDArray[np.int64]

DENSE = 4000
"""Unknowns up to which the rest is solved densely (0.13 GB)."""
DENSE_COUPLING = 0.05
"""Share of entries from which on a product of sparse matrices is slower than one of dense ones."""


class NormalEquations:
    """`H x = r` for many right-hand sides.

    Args:
        H: information matrix, (n, n), symmetric and positive definite.
        columns: slice of every variable.

    Raises:
        ObservabilityError: H is singular; names a variable that nothing determines.
    """

    def __init__(self, H: csr_matrix, columns: Mapping[int, slice]) -> None:
        self._size = int(H.indptr.size - 1)
        owners = np.array(sorted(columns, key=lambda k: columns[k].start), dtype=np.uint64)
        widths = np.array([columns[int(k)].stop - columns[int(k)].start for k in owners])
        self._owner = np.repeat(owners, widths)
        leaf = np.repeat(_independent(H, owners, widths), widths)
        self._leaf, self._rest = np.flatnonzero(leaf), np.flatnonzero(~leaf)
        leaves = H[self._leaf]
        self._inverse, half = self._blocks_inverted(csr_matrix(leaves[:, self._leaf]))
        scaled = csr_matrix(half @ csr_matrix(leaves[:, self._rest]))
        self._gain = csr_matrix(half.T @ scaled)
        self._gain_T = csr_matrix(self._gain.T)
        self._factor_rest(csr_matrix(H[self._rest][:, self._rest]), scaled)

    def solve(self, right: Float) -> Float:
        """Right-hand sides (n, k) to solutions (n, k)."""
        x = np.empty((self._size, right.shape[1]))
        own, rest = right[self._leaf], right[self._rest]
        if not own.any():  # as where poses' covariances are wanted
            rest = self._solve_rest(rest)
            x[self._rest], x[self._leaf] = rest, -(self._gain @ rest)
            return x
        rest = self._solve_rest(rest - self._gain_T @ own)
        x[self._rest], x[self._leaf] = rest, self._inverse @ own - self._gain @ rest
        return x

    def rest_inverse(self) -> tuple[Int, Float | None]:
        """What is left when the leaves are eliminated.

        Returns:
            place (n,) of every unknown in the rest, -1 for those that are not; and the rest's part of `H^-1`, None
            where it is too large.
        """
        place = np.full(self._size, -1, np.int64)
        place[self._rest] = np.arange(len(self._rest))
        return place, self._solve_rest(np.eye(len(self._rest))) if len(self._rest) <= DENSE else None

    def inverse_blocks(self, columns: Sequence[slice]) -> list[Float]:
        """Diagonal blocks of `H^-1`. Those of eliminated variables need a solution of the rest only."""
        place = np.empty(self._size, np.int64)
        place[self._leaf] = np.arange(len(self._leaf))
        place[self._rest] = np.arange(len(self._rest))
        is_leaf = np.zeros(self._size, bool)
        is_leaf[self._leaf] = True
        index = np.concatenate([np.arange(c.start, c.stop) for c in columns])
        right = np.zeros((len(index), len(self._rest)))
        leaf = is_leaf[index]
        right[leaf] = self._gain[place[index[leaf]]].toarray()
        right[np.flatnonzero(~leaf), place[index[~leaf]]] = 1.0
        inverse = right @ self._solve_rest(right.T)
        blocks, at = [], 0
        for column in columns:
            width = column.stop - column.start
            block = inverse[at : at + width, at : at + width].copy()
            if is_leaf[column.start]:
                own = slice(place[column.start], place[column.start] + width)
                block += self._inverse[own, own].toarray()
            blocks.append(block)
            at += width
        return blocks

    def _blocks_inverted(self, H: csr_matrix) -> tuple[csr_matrix, csr_matrix]:
        """Inverse of the block-diagonal part, by runs of equal width; and L^-1 of its factors L L^T."""
        owner = self._owner[self._leaf]
        _, first, width = np.unique(owner, return_index=True, return_counts=True)
        order = np.argsort(first)
        first, width = first[order], width[order]
        inverse, half, rows, cols = [], [], [], []
        for w in np.unique(width):
            at = first[width == w][:, None] + np.arange(w)
            i, j = np.repeat(at, w, axis=1), np.tile(at, (1, w))
            blocks = np.asarray(H[i.ravel(), j.ravel()]).reshape(-1, w, w)
            singular = np.linalg.eigvalsh(blocks)[:, 0] <= 1e-14 * np.trace(blocks, axis1=1, axis2=2)
            if singular.any():
                raise Undetermined(int(owner[at[np.argmax(singular), 0]]))
            inverted = np.linalg.inv(np.linalg.cholesky(blocks))
            half.append(inverted.ravel())
            inverse.append((inverted.transpose(0, 2, 1) @ inverted).ravel())
            rows.append(i.ravel())
            cols.append(j.ravel())
        if not half:
            return csr_matrix(H.shape), csr_matrix(H.shape)
        place = np.concatenate(rows), np.concatenate(cols)
        return (
            csr_matrix((np.concatenate(inverse), place), shape=H.shape),
            csr_matrix((np.concatenate(half), place), shape=H.shape),
        )

    def _factor_rest(self, H: csr_matrix, scaled: csr_matrix) -> None:
        """
        Args:
            scaled: L^-1 times what couples the leaves to the rest.
        """
        eliminated, rest = scaled.indptr.size - 1, H.indptr.size - 1
        if scaled.nnz > DENSE_COUPLING * max(eliminated * rest, 1):
            dense = scaled.toarray()
            S = H.toarray() - dense.T @ dense  # NumPy knows that this is symmetric, which halves the work
        else:
            S = H - scaled.T @ scaled
            S = S.toarray() if rest <= DENSE else csc_matrix(S)
        if isinstance(S, np.ndarray):
            try:
                factor = cho_factor(S, lower=True, overwrite_a=True, check_finite=False)
            except np.linalg.LinAlgError as error:
                minor = int(str(error).split("-")[0]) - 1 if str(error)[0].isdigit() else 0
                raise ObservabilityError(not_observable(int(self._owner[self._rest[minor]]))) from error
            self._solve_rest = lambda right: cho_solve(factor, right, check_finite=False)
            return
        options = {"SymmetricMode": True}
        lu = splu(S, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)
        self._solve_rest = lambda right: lu.solve(np.ascontiguousarray(right))


def _independent(H: csr_matrix, owners: NDArray[np.uint64], widths: Int) -> NDArray[np.bool_]:
    """Variables that may be eliminated block by block: landmarks, and keyframes that see no landmark and no other.

    What earlier keyframes left, or an earlier run, ties landmarks to each other: these are solved with the rest.
    """
    kinds = np.array([keys.kind(int(k)) for k in owners])
    variable = np.repeat(np.arange(len(owners)), widths)
    entries = H.tocoo()
    a, b = variable[entries.row], variable[entries.col]
    inner = np.isin(kinds, ("l", "x"))
    both = (a != b) & inner[a] & inner[b]
    a, b = a[both], b[both]
    tied = np.zeros(len(owners), bool)
    tied[a] = True
    landmark = kinds == "l"
    both = landmark[a] & landmark[b]
    joined = np.zeros(len(owners), bool)
    joined[a[both]] = True
    return (landmark & ~joined) | ((kinds == "x") & ~tied)
