"""The two-step solution of the normal equations is the dense one."""

import gtsam
import numpy as np
import pytest
from scipy.sparse import csr_matrix

from surecut.estimator.linear import LinearSystem
from surecut.estimator.newton import Elimination, step_with
from surecut.estimator.newton import gain as newton_gain
from surecut.factors import keys
from surecut.factors.errors import ObservabilityError


def problem(landmarks: int, keyframes: int, chain: bool):
    """Keyframes that see landmarks or marker corners, with priors here and there."""
    rng = np.random.default_rng([landmarks, keyframes, chain])
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    K = gtsam.Cal3_S2(300, 300, 0, 180, 120)
    pixel = gtsam.noiseModel.Isotropic.Sigma(2, 0.5)
    points = [keys.landmark(3 * i) for i in range(landmarks)] + [keys.corner(0, i) for i in range(4)]
    for i, key in enumerate(points):
        point = np.array([*rng.uniform(-0.5, 0.5, 2), 2.0 + rng.random()])
        values.insert(key, point)
        if keys.kind(key) == "q" or i % 3 == 0:
            graph.add(gtsam.PriorFactorPoint3(key, point + 0.01, gtsam.noiseModel.Isotropic.Sigma(3, 0.1)))
    for k in range(keyframes):
        pose = gtsam.Pose3(gtsam.Rot3.Expmap(rng.normal(0, 0.05, 3)), rng.normal(0, 0.2, 3))
        values.insert(keys.keyframe(k), pose)
        for key in points:
            px = gtsam.PinholeCameraCal3_S2(pose, K).project(values.atPoint3(key)) + rng.normal(0, 0.5, 2)
            graph.add(gtsam.GenericProjectionFactorCal3_S2(px, pixel, keys.keyframe(k), key, K))
        if chain and k:
            earlier = values.atPose3(keys.keyframe(k - 1))
            noise = gtsam.noiseModel.Isotropic.Sigma(6, 0.1)
            graph.add(gtsam.BetweenFactorPose3(keys.keyframe(k - 1), keys.keyframe(k), earlier.between(pose), noise))
    return graph, values


def test_landmarks_that_know_of_each_other():
    """As those do that a joint prior of an earlier part of a run holds."""
    graph, values = problem(12, 4, True)
    tight = gtsam.noiseModel.Isotropic.Sigma(3, 0.001)
    for a, b in ((0, 1), (1, 2), (0, 5)):
        one, other = keys.landmark(3 * a), keys.landmark(3 * b)
        graph.add(gtsam.BetweenFactorPoint3(one, other, values.atPoint3(other) - values.atPoint3(one), tight))
    system = LinearSystem(graph, values)
    covariance = np.linalg.inv((system.A.T @ system.A).toarray())
    np.testing.assert_allclose(system.solve(np.eye(system.parameters)), covariance, rtol=1e-6, atol=1e-10)


@pytest.mark.parametrize(
    ("landmarks", "keyframes", "chain"), [(0, 5, False), (0, 5, True), (12, 4, False), (12, 4, True)]
)
def test_covariances_are_those_of_the_dense_inverse(landmarks, keyframes, chain):
    graph, values = problem(landmarks, keyframes, chain)
    system = LinearSystem(graph, values)
    covariance = np.linalg.inv((system.A.T @ system.A).toarray())
    np.testing.assert_allclose(system.solve(np.eye(system.parameters)), covariance, rtol=1e-6, atol=1e-10)
    every = list(system.columns)
    for key, found in zip(every, system.marginals(every), strict=True):
        np.testing.assert_allclose(found, covariance[system.columns[key], system.columns[key]], rtol=1e-6, atol=1e-10)
    wanted = gtsam.Marginals(graph, values).marginalCovariance(keys.keyframe(1))
    np.testing.assert_allclose(system.joint([keys.keyframe(1)]), wanted, rtol=1e-6, atol=1e-10)


def test_marginals_under_larger_errors_are_blocks_of_the_sandwich():
    system = LinearSystem(*problem(12, 4, True))
    rng, rows = np.random.default_rng(0), len(system.b)
    system.root = csr_matrix(np.diag(rng.uniform(1, 2, rows)) + np.diag(rng.uniform(-0.5, 0.5, rows - 1), -1))
    for key in system.columns:
        np.testing.assert_allclose(system.marginals([key])[0], system.joint([key]), rtol=1e-6, atol=1e-10)


def test_hat_matrix_and_standardised_residuals():
    graph, values = problem(12, 4, True)
    system = LinearSystem(graph, values)
    A = system.A.toarray()
    hat = A @ np.linalg.solve(A.T @ A, A.T)
    positions = list(range(0, graph.size(), 5))
    for position, block in zip(positions, system.hats(positions), strict=True):
        rows = slice(system.starts[position], system.starts[position + 1])
        np.testing.assert_allclose(block, hat[rows, rows], atol=1e-9)
    total, dof = system.standardised([positions[1]])[0]
    rows = slice(system.starts[positions[1]], system.starts[positions[1] + 1])
    spread = np.eye(dof) - hat[rows, rows]
    assert dof == rows.stop - rows.start
    assert total == pytest.approx(system.b[rows] @ np.linalg.solve(spread, system.b[rows]), rel=1e-6)


def test_covariances_together_are_those_of_each_alone():
    system = LinearSystem(*problem(12, 4, True))
    rows = len(system.b)
    for root in (None, csr_matrix(np.diag(np.linspace(1, 2, rows)) + np.diag(np.full(rows - 1, 0.3), -1))):
        system.root = root
        blocks = [[(keys.keyframe(k), np.eye(6)), (keys.landmark(3 * k), np.ones((6, 3)))] for k in range(4)]
        for one, found in zip(blocks, system.covariances(blocks), strict=True):
            np.testing.assert_allclose(found, system.covariance(one), rtol=1e-9, atol=1e-12)
        X = system.solve(np.hstack([system.selector(one) for one in blocks]))
        np.testing.assert_allclose(system.spread(X)[:6, :6], system.covariance(blocks[0]), rtol=1e-9, atol=1e-12)


def test_one_step_on_is_the_least_squares_solution():
    graph, values = problem(12, 4, True)
    system = LinearSystem(graph, values)
    settled, step, gain = system.settled()
    wanted, squares = np.linalg.lstsq(system.A.toarray(), system.b, rcond=None)[:2]
    np.testing.assert_allclose(step, wanted, rtol=1e-6, atol=1e-9)
    assert settled.b @ settled.b == pytest.approx(squares[0], rel=1e-9)
    assert gain == pytest.approx(0.5 * (system.b @ system.b - squares[0]), rel=1e-9)
    linear = graph.linearize(values)
    assert newton_gain(linear, linear.optimize()) == pytest.approx(gain, rel=1e-6)
    key = keys.keyframe(2)
    moved = system.moved(values, step).atPose3(key).localCoordinates(values.atPose3(key))
    np.testing.assert_allclose(-moved, step[system.columns[key]], atol=1e-3)


def test_factors_exchanged_are_as_if_they_had_been_there():
    graph, values = problem(12, 4, True)
    removed = [graph.size() - 1, 3]
    tight = gtsam.noiseModel.Isotropic.Sigma(3, 0.01)
    new = gtsam.NonlinearFactorGraph()
    new.add(gtsam.PriorFactorPoint3(keys.landmark(3), values.atPoint3(keys.landmark(3)) + 0.1, tight))
    wanted = gtsam.NonlinearFactorGraph()
    for i in range(graph.size()):
        if i not in removed:
            wanted.add(graph.at(i))
    wanted.add(new.at(0))
    before = LinearSystem(graph, values)
    rows = len(before.b)
    before.root = csr_matrix(np.diag(np.linspace(1, 2, rows)))
    found, fresh = before.exchanged(removed, new, values), LinearSystem(wanted, values)
    np.testing.assert_allclose(found.A.toarray(), fresh.A.toarray())
    np.testing.assert_allclose(found.b, fresh.b)
    assert found.rows.tolist() == fresh.rows.tolist()
    fresh.root = found.root
    np.testing.assert_allclose(found.joint([keys.keyframe(3)]), fresh.joint([keys.keyframe(3)]), rtol=1e-8, atol=1e-12)
    assert found.error_covariance(np.array([len(found.b) - 1]))[0, 0] == 1.0
    assert before.b is not found.b
    assert len(before.b) == rows


def test_the_order_of_elimination_outlives_variables():
    graph, values = problem(12, 4, True)
    linear, elimination = graph.linearize(values), Elimination()
    whole = linear.optimize()
    np.testing.assert_allclose(elimination.solved(linear).at(keys.keyframe(1)), whole.at(keys.keyframe(1)), atol=1e-9)
    gone = keys.landmark(6)
    kept = [i for i in range(graph.size()) if gone not in graph.at(i).keys()]
    moved = step_with(linear, kept, values, elimination)
    part = gtsam.GaussianFactorGraph()
    for i in kept:
        part.push_back(linear.at(i))
    assert moved is not None
    np.testing.assert_array_equal(moved.atPoint3(gone), values.atPoint3(gone))
    wanted = values.atPoint3(keys.landmark(0)) + part.optimize().at(keys.landmark(0))
    np.testing.assert_allclose(moved.atPoint3(keys.landmark(0)), wanted, atol=1e-9)
    again = elimination.solved(linear)  # with the variable that was gone
    np.testing.assert_allclose(again.at(gone), whole.at(gone), atol=1e-9)


@pytest.mark.parametrize(
    ("key", "value", "words"),
    [(keys.landmark(99), np.array([0.0, 0, 1]), "landmark 99"), (keys.point(2), np.array([0.0, 0, 1]), "pipe point 2")],
)
def test_what_nothing_determines_is_named(key, value, words):
    graph, values = problem(3, 3, False)
    values.insert(key, value)
    graph.add(gtsam.RangeFactor3(key, keys.corner(0, 0), 1.0, gtsam.noiseModel.Isotropic.Sigma(1, 0.1)))
    with pytest.raises(ObservabilityError, match=f"{words} is not observable"):
        LinearSystem(graph, values).joint([keys.landmark(0)])
