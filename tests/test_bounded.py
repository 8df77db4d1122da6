"""Keyframes that leave the graph leave what they said: the same answer, at a cost that does not grow."""

import gtsam
import numpy as np
import pytest

from surecut.estimator.bounded import Bounded
from surecut.estimator.bundle import bundles
from surecut.estimator.engine import Engine
from surecut.estimator.graph import Record, Update
from surecut.estimator.incremental import Cut, Incremental
from surecut.estimator.limits import Limits
from surecut.estimator.marginal import FAMILY, carried, gaussian_of, joint_of, marginal, renamed, without
from surecut.estimator.observability import Undetermined
from surecut.estimator.points_in_base import point_blocks
from surecut.estimator.run_away import run_away
from surecut.estimator.surfaces import lay_on_surfaces
from surecut.factors import keys
from surecut.simulation.measurement_level import draw
from surecut.simulation.measurement_level_scenario import Scenario


def linear_graph():
    """Eight points, each tied to each: linear, so that elimination is exact."""
    rng = np.random.default_rng(5)
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    points = [keys.landmark(i) for i in range(8)]
    for i, key in enumerate(points):
        values.insert(key, rng.normal(size=3))
        for j, other in enumerate(points[:i]):
            noise = gtsam.noiseModel.Isotropic.Sigma(3, 0.1 + 0.1 * (i + j))
            graph.add(gtsam.BetweenFactorPoint3(other, key, rng.normal(size=3), noise))
    graph.add(gtsam.PriorFactorPoint3(points[0], np.ones(3), gtsam.noiseModel.Isotropic.Sigma(3, 0.2)))
    return graph, values, points


def optimum(graph, values):
    found = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    return found, gtsam.Marginals(graph, found)


def rest_of(graph, gone):
    return [graph.at(i) for i in range(graph.size()) if not gone.intersection(graph.at(i).keys())]


def test_elimination_is_exact_where_the_problem_is_linear():
    graph, values, points = linear_graph()
    gone = set(points[:4])
    rest = rest_of(graph, gone)
    touched = [graph.at(i) for i in range(graph.size()) if gone.intersection(graph.at(i).keys())]
    small = gtsam.NonlinearFactorGraph()
    small.add(marginal(touched, values, gone).factor())
    start = gtsam.Values()
    for factor in rest:
        small.add(factor)
    for key in points[4:]:
        start.insert(key, values.atPoint3(key) + 0.7)
    whole, whole_covariance = optimum(graph, values)
    part, part_covariance = optimum(small, start)
    for key in points[4:]:
        np.testing.assert_allclose(part.atPoint3(key), whole.atPoint3(key), atol=1e-7)
        np.testing.assert_allclose(
            part_covariance.marginalCovariance(key), whole_covariance.marginalCovariance(key), atol=1e-9
        )


def test_joint_gaussian_of_some_variables_as_one_factor_again():
    graph, values, points = linear_graph()
    prior = gaussian_of(graph, values, points[5:])
    assert prior.H.shape == (9, 9)
    small = gtsam.NonlinearFactorGraph()
    small.add(prior.factor())
    start = gtsam.Values()
    for key in points[5:]:
        start.insert(key, np.zeros(3))
    whole, _ = optimum(graph, values)
    part, covariance = optimum(small, start)
    joint = gtsam.Marginals(graph, whole)
    for key in points[5:]:
        np.testing.assert_allclose(part.atPoint3(key), whole.atPoint3(key), atol=1e-6)
        np.testing.assert_allclose(
            covariance.marginalCovariance(key), joint.marginalCovariance(key), rtol=1e-6, atol=1e-9
        )


def points_in_base(engine):
    """Positions and covariances in {b}, from the joint."""
    found = {}
    for point in engine.pipes.points.values():
        position, blocks = point_blocks(engine.state.values, keys.base(0), keys.point(point.index))
        joint = engine.solver.joint_covariance([key for key, _ in blocks])
        jacobian = np.hstack([block for _, block in blocks])
        found[point.id] = position, jacobian @ joint @ jacobian.T
    return found


@pytest.fixture(scope="module")
def run():
    scenario = {"motion": {"duration_s": 30.0, "returns": True}, "tracks": {"per_frame": 50}}
    return draw(Scenario.model_validate(scenario), 2)


def estimated(run, limits):
    engine = Engine(run.rig, run.cameras, lay_on_surfaces)
    bounded = Bounded(engine, limits)
    for bundle in bundles(run.measurements):
        engine.add(bundle)
        bounded.tidy()
    engine.revisit()
    engine.flush()
    engine.state.values = engine.solver.settle(10)
    return engine, bounded


def test_window_gives_the_answer_of_the_whole_graph(run):
    whole, untouched = estimated(run, Limits())
    count = whole.odometry.last_keyframe + 1
    small, bounded = estimated(run, Limits(keyframes=2 * count // 3, step=count // 6, map_landmarks=20))
    assert untouched.rebuilt == 0
    assert bounded.rebuilt >= 2
    expected, found = points_in_base(whole), points_in_base(small)
    assert found.keys() == expected.keys()
    assert found
    for name, (position, covariance) in expected.items():
        sigma = np.sqrt(np.diag(covariance))
        assert np.abs(found[name][0] - position).max() < 0.1 * sigma.min(), name
        np.testing.assert_allclose(np.sqrt(np.diag(found[name][1])), sigma, rtol=0.03)
    nothing_hangs_on_what_has_left(small, bounded)


def nothing_hangs_on_what_has_left(engine, bounded):
    records = [record.family for _, _, record in engine.solver.log.active()]
    assert records.count(FAMILY) == 1
    poses = [key for key in engine.state.values.keys() if keys.kind(key) == "x"]
    assert len(poses) <= bounded.limits.keyframes + 1
    assert {keys.index(key) for key in poses} == set(engine.keyframe_at.values())
    assert bounded.first > 0
    marks = {keys.index(key) for key in engine.state.values.keys() if keys.kind(key) == "l"}
    assert set(engine.odometry.observations) <= marks


def test_landmark_that_is_given_up_takes_nothing_else_with_it():
    """What earlier keyframes said about everything else stays, whether or not the landmark is in the graph still."""
    graph, values, points = linear_graph()
    prior = gaussian_of(graph, values, points[4:])
    expected = gaussian_of(graph, values, points[5:])
    left = without(prior, {points[4]})
    assert left is not None
    assert left.keys == expected.keys
    np.testing.assert_allclose(left.H, expected.H, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(left.g, expected.g, rtol=1e-9, atol=1e-9)
    assert without(prior, points[4:]) is None


def test_renaming_leaves_the_factor_that_it_is_taken_from():
    graph, values, points = linear_graph()
    factor = gaussian_of(graph, values, points[4:]).factor()
    before = keys.landmark_before(4)
    torn = renamed(joint_of(factor, values), {points[4]: before}).factor()
    assert set(torn.keys()) == {before, *points[5:]}
    assert set(factor.keys()) == set(points[4:])
    again = joint_of(factor, values)  # of its own variables still
    assert set(again.keys) == set(points[4:])
    moved = gtsam.Values()
    for key in again.keys:
        moved.insert(before if key == points[4] else key, values.atPoint3(key) + 0.1)
    assert torn.error(moved) == pytest.approx(factor.error(shifted(values, again.keys)), rel=1e-9)


def test_what_is_known_of_a_moved_part_goes_along():
    """Of a pose and points in {o}, seen and moved together: their shape is as well known as before."""
    _, values, points = linear_graph()
    graph, camera, pixels = gtsam.NonlinearFactorGraph(), keys.keyframe(0), gtsam.noiseModel.Isotropic.Sigma(2, 0.5)
    values.insert(camera, gtsam.Pose3(gtsam.Rot3.Rodrigues(0.3, -0.4, 0.2), np.array([0.1, -0.2, -6.0])))
    for key in points:
        px = np.random.default_rng(key % 97).normal(0, 30, 2)
        graph.add(gtsam.GenericProjectionFactorCal3_S2(px, pixels, camera, key, gtsam.Cal3_S2(200, 200, 0, 0, 0)))
        graph.add(gtsam.PriorFactorPoint3(key, np.ones(3), gtsam.noiseModel.Isotropic.Sigma(3, 0.2)))
    factor = gaussian_of(graph, values, [camera, *points[:5]]).factor()
    part = {camera, *points[:3]}
    correction = gtsam.Pose3(gtsam.Rot3.Rodrigues(0.5, 1.1, -0.7), np.array([1.0, -2.0, 0.5]))

    def off(rng, moved):
        found = gtsam.Values()
        steps = rng.normal(0, 0.1, (6, 6))
        for key, step in zip((camera, *points[:5]), steps, strict=True):
            if key == camera:
                pose = values.atPose3(key).retract(step)
                found.insert(key, correction.compose(pose) if moved else pose)
            else:
                point = values.atPoint3(key) + step[:3]
                found.insert(key, correction.transformFrom(point) if moved and key in part else point)
        return found

    again = carried(joint_of(factor, values), part, correction).factor()
    for seed in range(3):
        here, there = (off(np.random.default_rng(seed), moved) for moved in (False, True))
        assert again.error(there) == pytest.approx(factor.error(here), rel=1e-6)


def shifted(values, wanted):
    found = gtsam.Values()
    for key in wanted:
        found.insert(key, values.atPoint3(key) + 0.1)
    return found


def test_landmark_with_one_view_left_is_named_and_can_be_given_up():
    """Getting across it by Levenberg-Marquardt takes seconds; the cut goes on without it instead."""
    update, noise = Update(), gtsam.noiseModel.Isotropic.Sigma(2, 0.1)
    lens = gtsam.Cal3DS2(300, 300, 0, 180, 120, 0, 0, 0, 0)
    held = gtsam.noiseModel.Isotropic.Sigma(6, 1e-3)
    for i in range(2):
        pose = gtsam.Pose3(gtsam.Rot3(), np.array([0.2 * i, 0.0, 0.0]))
        update.guess(keys.keyframe(i), pose)
        update.add(gtsam.PriorFactorPose3(keys.keyframe(i), pose, held), Record("gauge", "gauge", i, "pose"))
        for mark in range(2):
            seen = gtsam.PinholeCameraCal3DS2(pose, lens).project(np.array([0.1, 0.3 * mark, 2.0]))
            args = seen, noise, keys.keyframe(i), keys.landmark(mark), lens
            view = gtsam.GenericProjectionFactorCal3DS2(*args)
            update.add(view, Record("stereo odometry", "m_left", i, f"track {mark}", camera="m_left"))
    for mark in range(2):
        update.guess(keys.landmark(mark), np.array([0.1, 0.3 * mark, 2.0]))
    solver = Incremental()
    solver.update(update)
    solver.log.off.add(5)  # the second keyframe's view of landmark 1 was an outlier
    cut = Cut({keys.keyframe(0)}, set(), set())
    with pytest.raises(Undetermined, match="landmark 1"):
        solver.reduce(cut, 2)
    left = solver.reduce(cut.giving_up(keys.landmark(1)), 2)
    assert set(left.keys()) == {keys.keyframe(1), keys.landmark(0)}
    np.testing.assert_allclose(left.atPoint3(keys.landmark(0)), [0.1, 0.0, 2.0], atol=1e-6)


def test_cut_is_of_what_there_is():
    """A landmark that the solver gave up meanwhile is not asked for."""
    graph, values, points = linear_graph()
    update = Update(values=values)
    for i in range(graph.size()):
        update.add(graph.at(i), Record("stereo odometry", "m_left", 0, "link"))
    solver = Incremental()
    solver.update(update)
    left = solver.reduce(Cut({points[0], keys.landmark(99)}, {keys.landmark(98)}, {keys.landmark(97)}), 0)
    assert set(left.keys()) == set(points[1:])


def test_landmark_that_has_run_away_leaves_with_all_that_is_said_of_it(run):
    """Where the images of a pair no longer differ nothing holds a landmark; its prior would cost all others theirs."""
    whole, _ = estimated(run, Limits())
    count = whole.odometry.last_keyframe + 1
    engine, bounded = estimated(run, Limits(keyframes=2 * count // 3, step=count // 6, map_landmarks=20))
    prior = next(f for _, f, r in engine.solver.log.active() if r.family == FAMILY)
    mark = next(key for key in prior.keys() if keys.kind(key) == "l")
    told, gone = len(engine.rejected), bounded.rebuilt
    engine.state.values.update(mark, np.array([0.0, 0.0, 1e3]))
    assert run_away(engine.state) == {mark}
    bounded._forget(bounded.first + count // 6)
    assert bounded.rebuilt == gone + 1
    assert not engine.state.has(mark)
    assert all(mark not in factor.keys() for _, factor, _ in engine.solver.log.active())
    assert len(engine.rejected) == told + 1
    expected, found = points_in_base(whole), points_in_base(engine)
    for name, (position, covariance) in expected.items():
        sigma = np.sqrt(np.diag(covariance))
        assert np.abs(found[name][0] - position).max() < 0.3 * sigma.min(), name
