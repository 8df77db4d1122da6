"""Tracks on a named pipe get the variance of what slides over it, and nothing else changes."""

import gtsam
import numpy as np
import pytest

from surecut.estimator.bundle import bundles
from surecut.estimator.engine import Engine
from surecut.estimator.odometry import FAMILY
from surecut.estimator.pipe_tracks import REACH, widen_pipe_tracks
from surecut.estimator.surfaces import lay_on_surfaces
from surecut.factors import keys
from surecut.simulation.measurement_level import draw
from surecut.simulation.measurement_level_scenario import Scenario

SHORT = Scenario.model_validate({"motion": {"duration_s": 10.0}, "clouds": {"points": 5000}})
RADIUS_M = 0.03


@pytest.fixture
def engine():
    run = draw(SHORT, 3)
    engine = Engine(run.rig, run.cameras, lay_on_surfaces, advises=False)
    for bundle in bundles(run.measurements):
        engine.add(bundle)
    engine.flush()
    return engine


def with_pipe(engine, beside_m):
    """A pipe beside two landmarks that many keyframes see."""
    most = sorted(engine.odometry.observations, key=lambda t: -engine.odometry.observations[t])[:2]
    a, b = (engine.state.point(keys.landmark(t)) for t in most)
    aside = np.cross(b - a, [0.3, 1.0, 0.2])
    aside *= beside_m / np.linalg.norm(aside)
    engine.pipes.named = lambda: ["pipe0"]
    engine.pipes.axis = lambda pipe: (a + aside, b + aside, RADIUS_M)
    return a + aside, (b - a) / np.linalg.norm(b - a)


def views(engine):
    """Sigma in pixels of every view, by place in the log, with its landmark, keyframe and camera."""
    return {
        index: (
            float(np.linalg.inv(factor.noiseModel().noise().R())[0, 0]),
            keys.landmark_among(factor.keys()),
            factor.keys()[0],
            record.camera,
        )
        for index, factor, record in engine.solver.log.active()
        if record.family == FAMILY and record.camera is not None
    }


def test_views_of_what_slides_have_its_variance(engine):
    start, along = with_pipe(engine, RADIUS_M)
    before = views(engine)
    widen_pipe_tracks(engine)
    after = views(engine)

    def distance(landmark):
        return float(np.linalg.norm(np.cross(engine.state.point(landmark) - start, along)))

    near = {landmark for _, landmark, _, _ in before.values() if distance(landmark) < REACH * RADIUS_M}
    assert len(near) >= 2
    for index, (sigma, landmark, keyframe, camera) in before.items():
        if landmark not in near:
            assert after[index][0] == sigma
            continue
        seen_from = [k for _, m, k, _ in before.values() if m == landmark]
        rays = np.array([engine.state.point(landmark) - engine.state.pose(k).translation() for k in seen_from])
        units = rays / np.linalg.norm(rays, axis=1, keepdims=True)
        slide_m = distance(landmark) * (1.0 - min(units @ units[0]))
        ray_m = np.linalg.norm(engine.state.point(landmark) - engine.state.pose(keyframe).translation())
        slide_px = slide_m * engine.state.intrinsics(keys.intrinsics(camera)).fx() / ray_m
        together = sum(m in near and k == keyframe and c == camera for _, m, k, c in before.values())
        assert after[index][0] ** 2 == pytest.approx(sigma**2 + together * slide_px**2, rel=1e-6)


def test_both_ways_of_solving_have_it(engine):
    with_pipe(engine, RADIUS_M)
    before = {index: sigma for index, (sigma, *_) in views(engine).items()}
    widen_pipe_tracks(engine)
    wider = [index for index, (sigma, *_) in views(engine).items() if sigma > before[index]]
    assert wider
    settled = engine.solver.settle(3)
    graph = engine.solver.log.graph()
    assert isinstance(graph, gtsam.NonlinearFactorGraph)
    better = gtsam.LevenbergMarquardtOptimizer(graph, settled).optimize()
    assert graph.error(settled) - graph.error(better) < 1e-2


def test_without_a_pipe_nothing_changes(engine):
    engine.pipes.named = lambda: []
    before = list(engine.solver.log.factors)
    widen_pipe_tracks(engine)
    assert all(a is b for a, b in zip(before, engine.solver.log.factors, strict=True))
