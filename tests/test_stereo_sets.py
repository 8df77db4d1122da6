"""The project's solvers on GTSAM's own stereo sets: the optimum that plain GTSAM finds."""

import gtsam
import pytest

from surecut.estimator.incremental import Incremental
from surecut.estimator.newton import optimum
from surecut.simulation.stereo_sets import load, updates


def test_small_set_frame_by_frame_and_at_once():
    solver = Incremental()
    starts = gtsam.Values()
    for update in updates(load("large")):
        solver.update(update)
        starts.insert(update.values)
    graph = solver.log.graph()
    assert graph.error(starts) == pytest.approx(6099.9, abs=0.1)
    running = solver.settle(20)
    assert graph.error(running) < 1426.0
    assert graph.error(optimum(graph, running)[0]) < 1425.8
    assert graph.error(optimum(graph, starts)[0]) < 1425.8
