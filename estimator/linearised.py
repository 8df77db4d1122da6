"""All factors at an estimate: where they come from, the linear system that they make, and their residuals."""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix, diags

from ..factors.noise import robust_scale
from .correlation import Active, correlate
from .graph import FactorLog
from .linear import LinearSystem
from .marginal import FAMILY as EARLIER

Float = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Linearised:
    """One estimate and the factors that count for it."""

    values: gtsam.Values
    active: Active
    system: LinearSystem
    rejectable: NDArray[np.bool_]
    """(factors,), what may be thrown out and is softened by a Huber loss."""
    norms: Float
    """(factors,), norm of each whitened residual, the robust loss undone."""
    inflation: float = 1.0
    """Variance of the tracks' errors over what they state, on average."""

    def graph(self) -> gtsam.NonlinearFactorGraph:
        """The factors, with the weights that they have here."""
        graph = gtsam.NonlinearFactorGraph()
        for _, factor, _ in self.active:
            graph.add(factor)
        return graph

    def touching(self, variables: Sequence[int]) -> list[list[int]]:
        """Positions of the factors that each variable is in."""
        found: dict[int, list[int]] = {key: [] for key in variables}
        for position, (_, factor, _) in enumerate(self.active):
            for key in factor.keys():
                if key in found:
                    found[key].append(position)
        return list(found.values())


def linearise(log: FactorLog, off: Collection[int], values: gtsam.Values, robust_sigma: float) -> Linearised:
    """The factors of a log, without those that are off, at an estimate."""
    active = [row for row in log.active() if row[0] not in off]
    rows = np.array([factor.dim() for _, factor, _ in active])
    rejectable = np.array([record.rejectable for _, _, record in active])
    return _linearised(active, rows, rejectable, values, robust_sigma)


def relinearise(at: Linearised, kept: Sequence[int], values: gtsam.Values, robust_sigma: float) -> Linearised:
    """Some of the factors at another estimate.

    Args:
        kept: their positions.
    """
    active = [at.active[p] for p in kept]
    return _linearised(active, at.system.rows[kept], at.rejectable[kept], values, robust_sigma)


def _linearised(
    active: Active, rows: NDArray[np.int64], rejectable: NDArray[np.bool_], values: gtsam.Values, robust_sigma: float
) -> Linearised:
    graph = gtsam.NonlinearFactorGraph()
    for _, factor, _ in active:
        graph.add(factor)
    system = LinearSystem(graph, values, rows)
    return Linearised(values, active, system, rejectable, residual_norms(system, rejectable, robust_sigma))


def residual_norms(system: LinearSystem, rejectable: NDArray[np.bool_], robust_sigma: float) -> Float:
    """Norms of the whitened residuals, (factors,), from a system whose rejectable factors a Huber loss has softened.

    Beyond its scale k Huber's loss leaves sqrt(k r) of a residual of norm r.
    """
    softened = np.sqrt(np.add.reduceat(system.b**2, system.starts[:-1]))
    scale = np.array([robust_scale(robust_sigma, int(n)) for n in range(1, int(system.rows.max()) + 1)])
    scale = scale[system.rows - 1]
    return np.where(rejectable & (softened > scale), softened**2 / scale, softened)


def settled(at: Linearised, robust_sigma: float) -> tuple[Linearised, float]:
    """One Gauss-Newton step on, nothing linearised anew; and what the step gains of half the chi-square.

    Raises:
        Undetermined: a variable.
    """
    system, step, gain = at.system.settled()
    norms = residual_norms(system, at.rejectable, robust_sigma)
    return replace(at, values=system.moved(at.values, step), system=system, norms=norms), gain


def with_correlated_tracks(at: Linearised, family: str, slack: float = 1.0) -> Linearised:
    """The same with covariances that know that the errors of a family's tracks are correlated.

    What keyframes left that are gone is mostly made of tracks and cannot be told apart any more: it is widened as they
    are on average.

    Args:
        slack: what the estimate's variances are over those of weights known beforehand (`track_weights`). What the
            tracks contribute is smaller by as much, so that it enters squared beside an account of contributions.
    """
    found = correlate(at.active, at.values, at.system, family, 1.0 / slack)
    if found is None and slack == 1.0:
        return at
    inflation = slack if found is None else found.inflation * slack**2
    wider = {family: np.sqrt(slack) if found is None else slack, EARLIER: np.sqrt(max(inflation, 1.0))}
    own = csr_matrix(diags(np.repeat([wider.get(record.family, 1.0) for _, _, record in at.active], at.system.rows)))
    at.system.root = own if found is None else csr_matrix(own @ found.root)
    return replace(at, inflation=inflation)
