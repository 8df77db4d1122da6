"""Copies of the process that share the end of a run change nothing about it; the optimum is found either way."""

from types import SimpleNamespace

import gtsam
import numpy as np
import pytest

from surecut.estimator import plain_tests
from surecut.estimator.aside import Aside
from surecut.estimator.bundle import bundles
from surecut.estimator.engine import Engine
from surecut.estimator.newton import optimum
from surecut.estimator.run import finish
from surecut.estimator.surfaces import lay_on_surfaces
from surecut.factors import keys
from surecut.factors.errors import ObservabilityError
from surecut.factors.noise import sigmas
from surecut.simulation.measurement_level import draw
from surecut.simulation.measurement_level_scenario import Scenario


def test_both_cores_find_what_one_finds():
    run = draw(Scenario.model_validate({"motion": {"duration_s": 6.0}}), 0)

    def result(apart):
        engine = Engine(run.rig, run.cameras, lay_on_surfaces)
        for bundle in bundles(list(run.measurements)):
            engine.add(bundle)
        return finish(engine, memory=True, apart=apart)

    one, both = result(False), result(True)
    for p, q in zip(one.points, both.points, strict=True):
        np.testing.assert_allclose(q.position_m, p.position_m, atol=0.02 * np.sqrt(np.diag(p.covariance_m2)).min())
        np.testing.assert_allclose(q.covariance_m2, p.covariance_m2, rtol=0.02, atol=1e-9)
    assert len(both.trajectory) == len(one.trajectory)
    assert both.advice.keys() == one.advice.keys()
    assert [m.from_ns for m in both.motions] == [m.from_ns for m in one.motions]
    assert [e.kind for e in both.events] == [e.kind for e in one.events]
    assert max(both.streaming_difference_sigma.values()) < 0.1
    assert bool(both.memory) == bool(one.memory)


@pytest.mark.parametrize("apart", [True, False])
def test_the_result_of_a_copy_is_waited_for(apart):
    aside: Aside[int] = Aside(apart)
    aside.begin(lambda: sum(range(1_000_000)))
    assert aside.awaited() == 499_999_500_000
    assert not aside.busy()

    def fails():
        raise ObservabilityError("nothing ties it")

    aside.begin(fails)
    with pytest.raises(ObservabilityError, match="nothing ties it"):
        aside.awaited()


@pytest.mark.parametrize("apart", [True, False])
def test_what_has_begun_counts_for_its_own_solution_only(apart, monkeypatch):
    monkeypatch.setattr(plain_tests, "plain", lambda engine, solution: solution.name)
    first, last = (SimpleNamespace(name=name, values=object()) for name in ("first", "last"))
    tests = plain_tests.PlainTests(SimpleNamespace(), apart)
    for begun in ((first,), (last,), (first, last), ()):
        for solution in begun:
            tests.begin(solution)
        assert tests.awaited(last) == "last"
        tests.stop()


def test_where_a_full_step_makes_it_worse_a_damped_one_does_not():
    """The minimum of an arc tangent's square: from beyond 1.39 Newton's steps leave for ever."""
    key = keys.radius(0)

    def error(factor, values, jacobians):
        x = float(values.atVector(key)[0])
        if jacobians is not None:
            jacobians[0] = np.array([[1.0 / (1.0 + x * x)]])
        return np.array([np.arctan(x)])

    graph = gtsam.NonlinearFactorGraph()
    graph.add(gtsam.CustomFactor(sigmas([0.01]), [key], error))
    for start in (0.5, 3.0):
        values = gtsam.Values()
        values.insert(key, np.array([start]))
        found, iterations = optimum(graph, values)
        assert float(found.atVector(key)[0]) == pytest.approx(0.0, abs=1e-4)
        assert iterations > 1
