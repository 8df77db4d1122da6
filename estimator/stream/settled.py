"""Answers at the optimum of the graph, also where iSAM2 is not there yet.

A pipe and its points begin from rough guesses, and iSAM2 relinearises rarely: its estimate of them can be many sigmas
off for seconds. Here Newton steps go on until the answer stays where it is. The engine does not see it: what it decides
about the next measurements must not depend on when somebody asks.
"""

from collections.abc import Sequence

import gtsam

from ...factors.errors import ObservabilityError
from ..engine import Engine
from ..marginal import only
from .posterior import Posterior
from .variables import long_lived

SETTLED_SIGMA = 0.5
"""Standard deviations by which one more step may move an answer."""
STEPS = 2
"""For one answer: the next one goes on."""


class Settled:
    """Posteriors of one engine, each from where the last one ended."""

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        self._ahead: gtsam.Values | None = None
        """Where the last answer was, if the engine's estimate was not there."""
        self.steps = 0

    def posterior(self, more: Sequence[int] = ()) -> Posterior:
        """Mean and joint covariance of the variables that live on, and `more`.

        Raises:
            ObservabilityError: they are not determined.
        """
        solver = self._engine.solver
        stay = [*long_lived(solver.values()), *more]
        at = self._start()
        posterior = Posterior(solver.joint_gaussian(stay, at))
        for _ in range(STEPS):
            if posterior.step_sigma < SETTLED_SIGMA:
                break
            try:
                at = solver.stepped(solver.values() if at is None else at)
            except ObservabilityError:
                break  # of a landmark: the engine gives it up in time
            self.steps += 1
            posterior = Posterior(solver.joint_gaussian(stay, at))
        self._ahead = at
        return posterior

    def _start(self) -> gtsam.Values | None:
        """The last answer's estimate, with what is new, where it fits better than the engine's; else None."""
        if self._ahead is None:
            return None
        solver = self._engine.solver
        ahead = gtsam.Values(solver.values())
        ahead.update(only(self._ahead, [key for key in self._ahead.keys() if ahead.exists(key)]))
        graph = solver.log.graph()
        return ahead if graph.error(ahead) < graph.error(solver.values()) else None
