"""The refinement after the run: everything relinearised at once, outliers told apart, then solved again."""

from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray

from ..factors import keys
from ..factors.measurements import Rejection
from ..factors.noise import huber_norm, robust_scale
from .graph import FactorLog, Record
from .linear import LinearSystem, deviate
from .observability import determined

Float = NDArray[np.float64]

OUTLIER_SIGMA = 4.5
"""Residuals beyond it (probability of one dimension) are outliers: one in 150 000 by chance."""

SNOOPED = ("depth cloud", "pipe outline", "picks")
"""Families of few measurements, each of which may hold a degree of freedom almost alone."""
SNOOPING_SIGMA = 3.7
SNOOPING_ROUNDS = 8
MINIMUM_VIEWS = 2
"""Pixels that a landmark needs to be a point."""


@dataclass(frozen=True, slots=True)
class BatchSolution:
    values: gtsam.Values
    first_values: gtsam.Values
    """The optimum over all factors, before outliers were taken out: what the running solver must agree with."""
    outliers: tuple[int, ...]
    """Indices of factors that were taken out."""
    rejected: tuple[Rejection, ...]
    iterations: int


def solve(log: FactorLog, start: gtsam.Values, robust_sigma: float) -> BatchSolution:
    """Robust Levenberg-Marquardt; then what is beyond noise is taken out, first by its residual, then by snooping."""
    first, iterations = optimum(log.graph(), start)
    values = first
    off: set[int] = set()
    rejected: list[Rejection] = []
    for finder, rounds in ((outliers, 3), (snooped, SNOOPING_ROUNDS)):
        for _ in range(rounds):
            found = finder(log, values, robust_sigma, off)
            if not found:
                break
            rejected += [r for _, r in found]
            off |= {i for i, _ in found}
            alone = orphans(log, off)
            rejected += [r for _, r in alone]
            off |= {i for i, _ in alone}
            values, more = optimum(_without(log, off), values)
            iterations += more
    return BatchSolution(values, first, tuple(sorted(off)), tuple(rejected), iterations)


def optimum(graph: gtsam.NonlinearFactorGraph, start: gtsam.Values) -> tuple[gtsam.Values, int]:
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(1e-6)
    parameters.setAbsoluteErrorTol(1e-4)
    parameters.setMaxIterations(40)
    parameters.setlambdaInitial(1e-8)
    optimiser = gtsam.LevenbergMarquardtOptimizer(graph, start, parameters)
    with determined():
        values = optimiser.optimize()
    return values, optimiser.iterations()


def _without(log: FactorLog, off: set[int]) -> gtsam.NonlinearFactorGraph:
    graph = gtsam.NonlinearFactorGraph()
    for index, factor, _ in log.active():
        if index not in off:
            graph.add(factor)
    return graph


def residual_norm(factor: gtsam.NonlinearFactor, values: gtsam.Values, robust_sigma: float, rejectable: bool) -> float:
    """Norm of the whitened residual, the robust loss undone."""
    loss = factor.error(values)
    if not rejectable:
        return float(np.sqrt(2.0 * loss))
    return huber_norm(loss, robust_scale(robust_sigma, factor.dim()))


def outliers(log: FactorLog, values: gtsam.Values, robust_sigma: float, off: set[int]) -> list[tuple[int, Rejection]]:
    """Factors whose residual is beyond what noise explains."""
    found = []
    for index, factor, record in log.active():
        if index in off or not record.rejectable:
            continue
        depth_m = landmark_depth(factor, record, values)
        if depth_m is not None and depth_m <= 0:
            reason = "landmark behind the camera by m"
            found.append((index, Rejection(record.stamp_ns, record.family, record.what, reason, -depth_m, 0.0)))
            continue
        norm = residual_norm(factor, values, robust_sigma, True)
        limit = robust_scale(OUTLIER_SIGMA, factor.dim())
        if norm > limit:
            reason = "whitened residual"
            found.append((index, Rejection(record.stamp_ns, record.family, record.what, reason, norm, limit)))
    return found


def landmark_depth(factor: gtsam.NonlinearFactor, record: Record, values: gtsam.Values) -> float | None:
    """How far before the mobile camera a factor's landmark is; None for factors of anything else.

    GTSAM's projection factors give the residual zero for a point behind the camera, so the residual cannot tell.
    """
    if record.camera not in ("m_left", "m_right"):
        return None
    involved = factor.keys()
    landmark = next((key for key in involved if keys.kind(key) == "l"), None)
    pose = next((key for key in involved if keys.kind(key) == "x"), None)
    if landmark is None or pose is None:
        return None
    return float(values.atPose3(pose).transformTo(values.atPoint3(landmark))[2])


def orphans(log: FactorLog, off: set[int]) -> list[tuple[int, Rejection]]:
    """What is left of landmarks that the removal of outliers left with one view: it determines no point."""
    views: dict[int, list[int]] = {}
    for index, factor, record in log.active():
        if index in off or record.camera is None:
            continue
        for key in factor.keys():
            if keys.kind(key) == "l":
                views.setdefault(key, []).append(index)
    lonely = {key for key, indices in views.items() if len(indices) < MINIMUM_VIEWS}
    found = []
    for index, factor, record in log.active():
        if index not in off and lonely.intersection(factor.keys()):
            left = float(max(len(views[key]) for key in factor.keys() if key in lonely))
            reason = "too few good views of the landmark; views"
            found.append((index, Rejection(record.stamp_ns, record.family, record.what, reason, left, MINIMUM_VIEWS)))
    return found


def snooped(log: FactorLog, values: gtsam.Values, robust_sigma: float, off: set[int]) -> list[tuple[int, Rejection]]:
    """The worst measurement of each small family by Baarda's test, where it is beyond the limit.

    A wrong measurement that few others control pulls the estimate and hides its residual. Its standardised residual
    r / sqrt(1 - h), with h its own block of the hat matrix, does not hide (Baarda 1968, data snooping). One per
    family and round, because one wrong measurement makes its neighbours look wrong.
    """
    active = [(i, f, r) for i, f, r in log.active() if i not in off]
    positions = [i for i, (_, _, r) in enumerate(active) if r.rejectable and r.family in SNOOPED]
    if not positions:
        return []
    graph = gtsam.NonlinearFactorGraph()
    for _, factor, _ in active:
        graph.add(factor)
    system = LinearSystem(graph, values)
    worst: dict[str, tuple[float, int, Rejection]] = {}
    for position, (total, dof) in zip(positions, system.standardised(positions), strict=True):
        index, _, record = active[position]
        sigma = deviate(total, dof) if dof else 0.0
        if sigma > SNOOPING_SIGMA and sigma > worst.get(record.family, (0.0,))[0]:
            told = Rejection(
                record.stamp_ns, record.family, record.what, "off the rest by sigmas", sigma, SNOOPING_SIGMA
            )
            worst[record.family] = (sigma, index, told)
    return [(index, told) for _, index, told in worst.values()]
