"""The refinement after the run: everything relinearised at once, outliers told apart, then solved again."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np
from numpy.typing import NDArray

from ..factors import keys
from ..factors.measurements import Rejection
from ..factors.noise import robust_scale
from ..factors.projection import reweighed
from .corner_variance import as_stated, corner_variance
from .corner_variance import weights as corner_weights
from .graph import FactorLog, Record
from .linear import deviate
from .linearised import Linearised, linearise, relinearise, settled, with_correlated_tracks
from .newton import ON_THE_WAY, Elimination, optimum, step_with
from .observability import Undetermined
from .odometry import FAMILY as ODOMETRY
from .track_weights import track_weights

Float = NDArray[np.float64]

OUTLIER_SIGMA = 4.5
"""Residuals beyond it (probability of one dimension) are outliers: one in 150 000 by chance."""

SNOOPED = ("depth cloud", "pipe outline", "pipe width", "picks")
"""Families of few measurements, each of which may hold a degree of freedom almost alone."""
SNOOPING_SIGMA = 3.7
SNOOPING_ROUNDS = 8
ROUGHLY = 2e-2
"""Share of the chi-square: from a step that gained no more one can look for further outliers, because the next gains a
fiftieth of that (rendered recordings: 0.0003 of the chi-square at most after steps that gained up to 0.02)."""
POLISHED = 2.5
"""Gain in half the chi-square, shared among thousands of variables, of a step after which nothing has to be linearised
anew: in rendered recordings it left a gain of 0.005 at most, and no pose or point moved by 0.012 sigma after it."""
MOST_ROUNDS = 6
"""Steps of that kind, before the optimum is looked for with more care."""
MINIMUM_VIEWS = 2
"""Pixels that a landmark needs to be a point."""


Finder = Callable[[Linearised], list[tuple[int, Rejection]]]
"""A test for outliers: places in the log, and why."""


@dataclass(frozen=True, slots=True)
class BatchSolution:
    values: gtsam.Values
    first_values: gtsam.Values
    """The optimum over all factors, before outliers were taken out: what the running solver must agree with."""
    outliers: tuple[int, ...]
    """Indices of factors that were taken out."""
    rejected: tuple[Rejection, ...]
    iterations: int
    at: Linearised
    """The factors that are left, at the solution."""


def solve(
    log: FactorLog,
    start: gtsam.Values,
    robust_sigma: float,
    meanwhile: Callable[[BatchSolution], None] | None = None,
) -> BatchSolution:
    """The robust optimum; then what is beyond noise is taken out, first by its residual, then by snooping.

    Args:
        meanwhile: gets the solution as soon as it is there; its covariances do not know yet that the errors of a track
            are correlated.
    """
    off: set[int] = set()
    elimination = Elimination()
    first, iterations = optimum(log.graph(), start, ON_THE_WAY, elimination)
    at = linearise(log, off, first, robust_sigma)
    at, rejected, more = cleaned(log, off, at, robust_sigma, ((outliers, 3), (snooped, SNOOPING_ROUNDS)), elimination)
    iterations += more
    at, more, slack, variance = weighed(log, off, at, robust_sigma)
    at = as_stated(at, variance)
    found = BatchSolution(at.values, first, tuple(sorted(off)), tuple(rejected), iterations + more, at)
    if meanwhile is not None:
        meanwhile(found)
    return replace(found, at=with_correlated_tracks(at, ODOMETRY, slack))


def cleaned(
    log: FactorLog,
    off: set[int],
    at: Linearised,
    robust_sigma: float,
    finders: Sequence[tuple[Finder, int]],
    elimination: Elimination,
) -> tuple[Linearised, list[Rejection], int]:
    """Without what is beyond noise, what was taken out, and the iterations.

    Args:
        off: places of factors that do not count; those that are found join them.
        at: near the optimum of the others.
        finders: each with its rounds, one after the other.
    """
    rejected: list[Rejection] = []
    iterations = 0
    for finder, rounds in finders:
        for _ in range(rounds):
            found = _told_by(finder, at)
            if not found:
                break
            off |= {i for i, _ in found}
            found += orphans(at, off)
            off |= {i for i, _ in found}
            rejected += [r for _, r in found]
            at, more = _without(log, off, at, robust_sigma, elimination)
            iterations += more
    return at, rejected, iterations


def weighed(log: FactorLog, off: set[int], at: Linearised, robust_sigma: float) -> tuple[Linearised, int, float, float]:
    """The optimum with tracks and corners weighed by their residuals, the iterations to there, the slack of the tracks'
    weights, and the variance of the corners over what is stated.

    Args:
        at: near the optimum without weights.
    """
    at = settled(at, robust_sigma)[0]
    variance = corner_variance(at)
    at, iterations, slack = _with_weights(log, off, at, robust_sigma, corner_weights(at, variance))
    return at, iterations, slack, variance


def _without(
    log: FactorLog, off: set[int], at: Linearised, robust_sigma: float, elimination: Elimination
) -> tuple[Linearised, int]:
    """Without some factors: near enough to the optimum of the others to go on, and the iterations to there.

    One step is, from the optimum that they were part of, unless much changes.
    """
    for iteration in range(1, MOST_ROUNDS + 1):
        kept = [p for p, (i, _, _) in enumerate(at.active) if i not in off]
        values = step_with(at.system.linear, kept, at.values, elimination)
        if values is None:
            break
        before = float((at.norms[kept] ** 2).sum())
        at = relinearise(at, kept, values, robust_sigma)
        after = float((at.norms**2).sum())
        if not after <= 1.01 * before:  # nor where it is no number
            break
        if before - after <= ROUGHLY * before:
            return at, iteration
    values, more = optimum(without_factors(log, off), at.values, ON_THE_WAY)
    return linearise(log, off, values, robust_sigma), more


def _with_weights(
    log: FactorLog, off: set[int], at: Linearised, robust_sigma: float, corners: Mapping[int, float]
) -> tuple[Linearised, int, float]:
    """The optimum with tracks weighed by what they are worth, the iterations to there, and the weights' slack.

    Args:
        at: the optimum without, roughly.
        corners: weights of marker corners, by position.
    """
    weights = track_weights(at.active, at.system, ODOMETRY)
    factors = {}
    for position, weight in {**weights.by_position, **corners}.items():
        index, factor, _ = at.active[position]
        factors[index] = reweighed(factor, weight, robust_sigma)
    start = at.values if weights.step is None else at.system.moved(at.values, weights.step)
    at, iterations = _polished(log.replaced(factors) if factors else log, off, start, robust_sigma)
    return at, iterations, weights.slack


def _polished(log: FactorLog, off: set[int], start: gtsam.Values, robust_sigma: float) -> tuple[Linearised, int]:
    """The optimum from very near it, and the iterations to there.

    Covariances want the system solved at any rate: here it makes the steps too, and the last one is so short that the
    linearisation holds where it leads.
    """
    values, last = start, float("inf")
    for iteration in range(1, MOST_ROUNDS + 1):
        at, gain = settled(linearise(log, off, values, robust_sigma), robust_sigma)
        if not gain <= last:  # nor where it is no number
            break
        if gain <= POLISHED:
            return at, iteration
        values, last = at.values, gain
    values, more = optimum(without_factors(log, off), start)
    return linearise(log, off, values, robust_sigma), more


def _told_by(finder: Finder, at: Linearised) -> list[tuple[int, Rejection]]:
    """What a test finds; where a landmark is undetermined, so that there is no test, all of that landmark's factors."""
    try:
        return finder(at)
    except Undetermined as error:
        if keys.kind(error.key) != "l":
            raise
        reason = "undetermined where its matches put it; views"
        touching = [at.active[p] for p in at.touching([error.key])[0]]
        return [(i, Rejection(r.stamp_ns, r.family, r.what, reason, 0.0, 1.0)) for i, _, r in touching]


def without_factors(log: FactorLog, off: set[int]) -> gtsam.NonlinearFactorGraph:
    graph = gtsam.NonlinearFactorGraph()
    for index, factor, _ in log.active():
        if index not in off:
            graph.add(factor)
    return graph


def outliers(at: Linearised) -> list[tuple[int, Rejection]]:
    """Factors whose residual is beyond what noise explains, and points that lie behind their camera."""
    limit = np.array([robust_scale(OUTLIER_SIGMA, n) for n in range(1, int(at.system.rows.max()) + 1)])
    limit = limit[at.system.rows - 1]
    found = []
    for position in np.flatnonzero((at.norms > limit) | (at.norms == 0.0)):
        index, factor, record = at.active[position]
        if not record.rejectable:
            continue
        reason, norm, bound = "whitened residual", float(at.norms[position]), float(limit[position])
        depth_m = landmark_depth(factor, record, at.values)
        if depth_m is not None and depth_m <= 0:
            reason, norm, bound = "landmark behind the camera by m", -depth_m, 0.0
        elif norm <= bound:
            continue
        found.append((index, Rejection(record.stamp_ns, record.family, record.what, reason, norm, bound)))
    return found


def landmark_depth(factor: gtsam.NonlinearFactor, record: Record, values: gtsam.Values) -> float | None:
    """How far before the mobile camera a factor's landmark is; None for factors of anything else.

    GTSAM's projection factors give a point behind the camera the residual zero or a huge one, so that the residual
    cannot tell.
    """
    if record.camera not in ("m_left", "m_right"):
        return None
    involved = factor.keys()
    landmark = next((key for key in involved if keys.kind(key) == "l"), None)
    pose = next((key for key in involved if keys.kind(key) == "x"), None)
    if landmark is None or pose is None:
        return None
    return float(values.atPose3(pose).transformTo(values.atPoint3(landmark))[2])


def orphans(at: Linearised, off: set[int]) -> list[tuple[int, Rejection]]:
    """What is left of landmarks that the removal of outliers left with one view: it determines no point."""
    gone = [factor for index, factor, _ in at.active if index in off]
    landmarks = sorted({key for factor in gone for key in factor.keys() if keys.kind(key) == "l"})
    found = []
    for positions in at.touching(landmarks):
        left = [p for p in positions if at.active[p][0] not in off]
        views = sum(at.active[p][2].camera is not None for p in left)
        if len(left) == len(positions) or views >= MINIMUM_VIEWS:
            continue
        for index, _, r in (at.active[p] for p in left):
            reason = "too few good views of the landmark; views"
            found.append((index, Rejection(r.stamp_ns, r.family, r.what, reason, float(views), MINIMUM_VIEWS)))
    return found


def snooped(at: Linearised) -> list[tuple[int, Rejection]]:
    """The worst measurement of each small family by Baarda's test, where it is beyond the limit.

    A wrong measurement that few others control pulls the estimate and hides its residual. Its standardised residual
    r / sqrt(1 - h), with h its own block of the hat matrix, does not hide (Baarda 1968, data snooping). One per
    family and round, because one wrong measurement makes its neighbours look wrong.
    """
    positions = [i for i, (_, _, r) in enumerate(at.active) if r.rejectable and r.family in SNOOPED]
    if not positions:
        return []
    worst: dict[str, tuple[float, int, Rejection]] = {}
    for position, (total, dof) in zip(positions, at.system.settled()[0].standardised(positions), strict=True):
        index, _, record = at.active[position]
        sigma = deviate(total, dof) if dof else 0.0
        if sigma > SNOOPING_SIGMA and sigma > worst.get(record.family, (0.0,))[0]:
            told = Rejection(
                record.stamp_ns, record.family, record.what, "off the rest by sigmas", sigma, SNOOPING_SIGMA
            )
            worst[record.family] = (sigma, index, told)
    return [(index, told) for _, index, told in worst.values()]
