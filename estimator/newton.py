"""The optimum of a graph from a start near it: Gauss-Newton, and Levenberg-Marquardt where that does not get there."""

from collections.abc import Sequence

import gtsam

from .observability import Undetermined, determined

CONVERGED, ON_THE_WAY = 1e-6, 1e-4
"""Share of the error that the last step may still gain: at the end, and where more steps will follow."""
NOTHING = 1e-4
"""A gain in half the chi-square that is not worth an iteration."""
MOST_ITERATIONS = 40


class Elimination:
    """Solves linearised graphs of hardly ever different variables: in what order is found out once, which takes as long
    as half a solution."""

    def __init__(self) -> None:
        self._ordering = gtsam.Ordering()

    def solved(self, linear: gtsam.GaussianFactorGraph) -> gtsam.VectorValues:
        """
        Raises:
            Undetermined: a variable.
        """
        present = linear.keys()
        if self._ordering.size() != present.size():
            self._ordering = self._among(linear, present)
        with determined():
            return linear.optimize(self._ordering)

    def _among(self, linear: gtsam.GaussianFactorGraph, present: gtsam.KeySet) -> gtsam.Ordering:
        """The known order, without variables that are gone; a new one where there are others."""
        left = gtsam.Ordering()
        for i in range(self._ordering.size()):
            if present.count(key := self._ordering.at(i)):
                left.push_back(key)
        return left if left.size() == present.size() else gtsam.Ordering.ColamdGaussianFactorGraph(linear)


def optimum(
    graph: gtsam.NonlinearFactorGraph,
    start: gtsam.Values,
    tolerance: float = CONVERGED,
    elimination: Elimination | None = None,
) -> tuple[gtsam.Values, int]:
    """The optimum from a start near it, and the number of iterations.

    Gauss-Newton, whose steps take two thirds of the time of Levenberg-Marquardt's; the latter where a step makes it
    worse or cannot be taken.
    """
    found = _undamped(graph, start, tolerance, elimination or Elimination())
    return found or _damped(graph, start, tolerance)


def _undamped(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, tolerance: float, elimination: Elimination
) -> tuple[gtsam.Values, int] | None:
    """Gauss-Newton; None where that does not get there.

    How much a step gains is known before it is taken: where that is next to nothing, there is no need to look whether
    it was gained.
    """
    error = graph.error(values)
    for iteration in range(1, MOST_ITERATIONS + 1):
        linear = graph.linearize(values)
        try:
            step = elimination.solved(linear)
        except Undetermined:
            return None
        values = values.retract(step)
        if gain(linear, step) <= max(tolerance * error, NOTHING):
            return values, iteration
        before, error = error, graph.error(values)
        if not error <= before + NOTHING:  # nor where it is no number
            return None
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


def gain(linear: gtsam.GaussianFactorGraph, step: gtsam.VectorValues) -> float:
    """What a step to the minimum of a linearised graph takes off half its chi-square."""
    return -0.5 * linear.gradientAtZero().dot(step)


def step_with(
    linear: gtsam.GaussianFactorGraph, kept: Sequence[int], values: gtsam.Values, elimination: Elimination
) -> gtsam.Values | None:
    """One Gauss-Newton step with some factors of a linearised graph; None where they determine no step.

    Args:
        kept: their places.
        values: where it was linearised. Variables that no kept factor touches stay.
    """
    part = gtsam.GaussianFactorGraph()
    for place in kept:
        part.push_back(linear.at(place))
    try:
        return values.retract(elimination.solved(part))
    except Undetermined:
        return None
