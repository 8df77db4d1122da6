"""A recording of more keyframes than the graph holds: the whole path, and nearly the answer of the whole graph."""

import numpy as np
import pytest

from surecut.estimator.bundle import bundles
from surecut.estimator.engine import Engine
from surecut.estimator.limits import Limits
from surecut.estimator.long_recording import LongRecording
from surecut.estimator.run import finish
from surecut.estimator.surfaces import lay_on_surfaces
from surecut.simulation.measurement_level import draw
from surecut.simulation.measurement_level_scenario import Scenario


def estimated(run, limits):
    engine = Engine(run.rig, run.cameras, lay_on_surfaces)
    long = LongRecording(engine, limits)
    for bundle in bundles(run.measurements):
        engine.add(bundle)
        long.tidy()
    return engine, long, finish(engine, memory=True, past=long.past)


@pytest.fixture(scope="module")
def results():
    scenario = {"motion": {"duration_s": 30.0, "returns": True}, "tracks": {"per_frame": 50}}
    run = draw(Scenario.model_validate(scenario), 2)
    engine, whole_past, whole = estimated(run, Limits(keyframes=1000))
    count = engine.odometry.last_keyframe + 1
    _, past, small = estimated(run, Limits(keyframes=count // 2, step=count // 6))
    assert not whole_past.past
    assert past.past
    return whole, small


def test_path_holds_every_frame_whether_its_keyframe_has_left_or_not(results):
    whole, small = results
    stamps = [pose.stamp_ns for pose in small.trajectory]
    assert stamps == [pose.stamp_ns for pose in whole.trajectory]
    for one, other in zip(small.trajectory, whole.trajectory, strict=True):
        np.testing.assert_allclose(one.matrix, other.matrix, atol=0.01)
    known = [pose.covariance is not None for pose in small.trajectory]
    assert sum(known) < sum(pose.covariance is not None for pose in whole.trajectory)
    assert known[-1] or any(known[-20:])
    assert not known[0]


def test_points_are_those_of_the_whole_graph(results):
    whole, small = results
    assert [p.id for p in small.points] == [p.id for p in whole.points]
    for one, other in zip(small.points, whole.points, strict=True):
        sigma = np.sqrt(np.diag(other.covariance_m2))
        assert (np.abs(one.position_m - other.position_m) < 0.5 * sigma).all()
        np.testing.assert_allclose(np.sqrt(np.diag(one.covariance_m2)), sigma, rtol=0.15)
        assert sum(one.budget.values()) == pytest.approx(one.covariance_m2, rel=1e-6, abs=1e-12)
    assert small.consistency.passed


def test_what_earlier_keyframes_said_has_its_place_in_the_budget(results):
    _, small = results
    assert all("earlier keyframes" in point.budget for point in small.points)
