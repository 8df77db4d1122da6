"""The refinement after the run: everything relinearised at once, outliers told apart, then solved again."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

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
from .linearised import Linearised, linearise, with_correlated_tracks
from .observability import Undetermined, determined
from .odometry import FAMILY as ODOMETRY
from .track_weights import track_weights

Float = NDArray[np.float64]

OUTLIER_SIGMA = 4.5
"""Residuals beyond it (probability of one dimension) are outliers: one in 150 000 by chance."""

SNOOPED = ("depth cloud", "pipe outline", "pipe width", "picks")
"""Families of few measurements, each of which may hold a degree of freedom almost alone."""
SNOOPING_SIGMA = 3.7
SNOOPING_ROUNDS = 8
CONVERGED, ON_THE_WAY = 1e-6, 1e-4
"""Share of the error that an iteration may still gain: at the end, and while outliers are being taken out."""
NOTHING = 1e-4
"""A gain in half the chi-square that is not worth an iteration."""
MOST_ITERATIONS = 40
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


def solve(log: FactorLog, start: gtsam.Values, robust_sigma: float) -> BatchSolution:
    """The robust optimum; then what is beyond noise is taken out, first by its residual, then by snooping."""
    off: set[int] = set()
    rejected: list[Rejection] = []
    first, iterations = optimum(log.graph(), start)
    at = linearise(log, off, first, robust_sigma)
    for finder, rounds in ((outliers, 3), (snooped, SNOOPING_ROUNDS)):
        for _ in range(rounds):
            found = _told_by(finder, at)
            if not found:
                break
            off |= {i for i, _ in found}
            found += orphans(at, off)
            off |= {i for i, _ in found}
            rejected += [r for _, r in found]
            values, more = optimum(without_factors(log, off), at.values, ON_THE_WAY)
            at = linearise(log, off, values, robust_sigma)
            iterations += more
    variance = corner_variance(at)
    at, more, slack = _with_weights(log, off, at, robust_sigma, corner_weights(at, variance))
    at = as_stated(with_correlated_tracks(at, ODOMETRY, slack), variance)
    iterations += more
    return BatchSolution(at.values, first, tuple(sorted(off)), tuple(rejected), iterations, at)


def _with_weights(
    log: FactorLog, off: set[int], at: Linearised, robust_sigma: float, corners: Mapping[int, float]
) -> tuple[Linearised, int, float]:
    """The optimum with tracks weighed by what they are worth, the iterations to there, and the weights' slack.

    Args:
        corners: weights of marker corners, by position.
    """
    weights = track_weights(at.active, at.system, ODOMETRY)
    if not weights.by_position and not corners:
        values, iterations = optimum(without_factors(log, off), at.values) if off else (at.values, 0)
        return (linearise(log, off, values, robust_sigma) if iterations else at), iterations, 1.0
    factors = {}
    for position, weight in {**weights.by_position, **corners}.items():
        index, factor, record = at.active[position]
        factors[index] = reweighed(factor, record.camera or "", weight, robust_sigma)
    weighed = log.replaced(factors)
    values, iterations = optimum(without_factors(weighed, off), at.values)
    return linearise(weighed, off, values, robust_sigma), iterations, weights.slack


def optimum(
    graph: gtsam.NonlinearFactorGraph, start: gtsam.Values, tolerance: float = CONVERGED
) -> tuple[gtsam.Values, int]:
    """The optimum from a start near it, and the number of iterations.

    Gauss-Newton, whose steps take two thirds of the time of Levenberg-Marquardt's; the latter where a step makes it
    worse or cannot be taken.
    """
    return _undamped(graph, start, tolerance) or _damped(graph, start, tolerance)


def _undamped(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, tolerance: float
) -> tuple[gtsam.Values, int] | None:
    """Gauss-Newton; None where that does not get there."""
    error, ordering = graph.error(values), None
    for iteration in range(1, MOST_ITERATIONS + 1):
        linear = graph.linearize(values)
        ordering = ordering or gtsam.Ordering.ColamdGaussianFactorGraph(linear)
        try:
            with determined():
                values = values.retract(linear.optimize(ordering))
        except Undetermined:
            return None
        before, error = error, graph.error(values)
        if not error <= before + NOTHING:  # nor where it is no number
            return None
        if before - error <= max(tolerance * before, NOTHING):
            return values, iteration
    return None


def _damped(graph: gtsam.NonlinearFactorGraph, start: gtsam.Values, tolerance: float) -> tuple[gtsam.Values, int]:
    """Levenberg-Marquardt."""
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(tolerance)
    parameters.setAbsoluteErrorTol(NOTHING)
    parameters.setMaxIterations(MOST_ITERATIONS)
    parameters.setlambdaInitial(1e-5)
    optimiser = gtsam.LevenbergMarquardtOptimizer(graph, start, parameters)
    with determined():
        values = optimiser.optimize()
    return values, optimiser.iterations()


def _told_by(finder: Finder, at: Linearised) -> list[tuple[int, Rejection]]:
    """What a test finds; where a landmark is undetermined, so that there is no test, all of that landmark's factors."""
    try:
        return finder(at)
    except Undetermined as error:
        if keys.kind(error.key) != "l":
            raise
        reason = "undetermined where its matches put it; views"
        touching = [at.active[p] for p in at.system.touching([error.key])[0]]
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
    for positions in at.system.touching(landmarks):
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
    for position, (total, dof) in zip(positions, at.system.standardised(positions), strict=True):
        index, _, record = at.active[position]
        sigma = deviate(total, dof) if dof else 0.0
        if sigma > SNOOPING_SIGMA and sigma > worst.get(record.family, (0.0,))[0]:
            told = Rejection(
                record.stamp_ns, record.family, record.what, "off the rest by sigmas", sigma, SNOOPING_SIGMA
            )
            worst[record.family] = (sigma, index, told)
    return [(index, told) for _, index, told in worst.values()]
