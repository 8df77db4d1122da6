"""Tracks on a named pipe are left out; where there is hardly anything else they stay."""

import numpy as np
import pytest

from surecut.estimator.bundle import bundles
from surecut.estimator.engine import Engine
from surecut.estimator.pipe_tracks import REACH, leave_out_pipe_tracks
from surecut.estimator.surfaces import lay_on_surfaces
from surecut.factors import keys
from surecut.simulation.measurement_level import draw
from surecut.simulation.measurement_level_scenario import Scenario

SHORT = Scenario.model_validate({"motion": {"duration_s": 10.0}, "clouds": {"points": 5000}})


@pytest.fixture
def engine():
    run = draw(SHORT, 3)
    engine = Engine(run.rig, run.cameras, lay_on_surfaces, advises=False)
    for bundle in bundles(run.measurements):
        engine.add(bundle)
    engine.flush()
    return engine


def landmarks(engine):
    return {key: engine.state.point(key) for key in engine.state.values.keys() if keys.kind(key) == "l"}


def with_pipe(engine, radius_m):
    """A pipe through two landmarks that many keyframes see."""
    most = sorted(engine.odometry.observations, key=lambda t: -engine.odometry.observations[t])[:2]
    a, b = (engine.state.point(keys.landmark(t)) for t in most)
    engine.pipes.named = lambda: ["pipe0"]
    engine.pipes.axis = lambda pipe: (a, b, radius_m)
    return a, (b - a) / np.linalg.norm(b - a)


def test_what_seems_a_point_on_a_pipe_is_left_out(engine):
    before = landmarks(engine)
    start, along = with_pipe(engine, 0.03)
    leave_out_pipe_tracks(engine)
    left = landmarks(engine)
    gone = before.keys() - left.keys()
    radii = {key: np.linalg.norm(np.cross(point - start, along)) / 0.03 for key, point in before.items()}
    assert gone == {key for key, r in radii.items() if r < REACH}
    assert len(gone) >= 2
    assert not [f for _, f, _ in engine.solver.log.active() if gone.intersection(f.keys())]
    told = {r.what: r.value for r in engine.rejected if "on a named pipe" in r.reason}
    assert told == pytest.approx({keys.words(key): radii[key] for key in gone})
    settled = engine.solver.settle(3)
    assert all(settled.exists(key) for key in left)
    assert not any(settled.exists(key) for key in gone)


def test_they_stay_where_there_is_hardly_anything_else(engine):
    before = landmarks(engine)
    with_pipe(engine, 20.0)
    leave_out_pipe_tracks(engine)
    assert landmarks(engine).keys() == before.keys()
    assert not any("on a named pipe" in r.reason for r in engine.rejected)
