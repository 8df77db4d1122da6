"""The running solver gives up a landmark that nothing determines, and nothing else."""

import gtsam
import numpy as np
import pytest

from surecut.estimator.graph import Record, Update
from surecut.estimator.incremental import Incremental
from surecut.factors import keys
from surecut.factors.errors import ObservabilityError
from surecut.factors.links import gauge_prior
from surecut.factors.noise import sigmas

POSE, GOOD, LOST = keys.keyframe(0), keys.landmark(1), keys.landmark(2)


def record(what):
    return Record("stereo odometry", "tracks", 0, what, camera="m_left")


def point_prior(key, where):
    return gtsam.PriorFactorPoint3(key, np.asarray(where, float), sigmas([0.01] * 3))


def start(key, *factors):
    """A graph with a fixed pose, a well known landmark, and one more variable."""
    update = Update()
    update.guess(POSE, gtsam.Pose3())
    update.add(gauge_prior(POSE), Record("gauge", "gauge", 0, "origin", rejectable=False))
    update.guess(GOOD, np.array([0.0, 0.0, 2.0]))
    update.add(point_prior(GOOD, [0.0, 0.0, 2.0]), record("good"))
    update.guess(key, np.array([0.1, 0.0, 2.0]))
    for factor in factors:
        update.add(factor, record("distance"))
    return update


def distance(key):
    """One number about three, as a view from behind is none."""

    def error(factor, values, jacobians):
        if jacobians is not None:
            jacobians[0] = np.array([[1.0, 0.0, 0.0]])
        return values.atPoint3(key)[:1] - 0.1

    return gtsam.CustomFactor(sigmas([0.01]), [key], error)


def test_an_undetermined_landmark_is_given_up_and_the_rest_goes_on():
    solver = Incremental()
    values = solver.update(start(LOST, distance(LOST)))
    assert solver.dropped == [LOST]
    assert not values.exists(LOST)
    assert solver.log.off == {2}
    assert values.atPoint3(GOOD) == pytest.approx([0.0, 0.0, 2.0], abs=1e-6)
    more = Update()
    more.guess(LOST, np.array([0.2, 0.0, 2.0]))
    more.add(point_prior(LOST, [0.2, 0.0, 2.0]), record("seen again"))
    assert solver.update(more).atPoint3(LOST) == pytest.approx([0.2, 0.0, 2.0], abs=1e-6)
    assert solver.settle(3).size() == 3


def test_another_undetermined_variable_is_an_error():
    point = keys.point(0)
    with pytest.raises(ObservabilityError, match="pick the point again"):
        Incremental().update(start(point, distance(point)))


def test_after_settling_the_right_factor_is_switched_off():
    """Factors that are off have no place in the new graph: those behind them move up."""
    solver = Incremental()
    update = start(LOST, point_prior(LOST, [0.1, 0.0, 2.0]))
    for x in (0.3, 0.6):
        update.add(point_prior(GOOD, [x, 0.0, 2.0]), record(f"at {x}"))
    solver.update(update)
    solver.switch_off([1])
    assert solver.settle(3).atPoint3(GOOD)[0] == pytest.approx(0.45, abs=1e-6)
    assert solver.switch_off([3]).atPoint3(GOOD)[0] == pytest.approx(0.6, abs=1e-6)
    assert solver.values().atPoint3(LOST)[0] == pytest.approx(0.1, abs=1e-6)


def test_a_landmark_that_nothing_determines_is_passed_over_in_covariances():
    solver = Incremental()
    solver.update(start(LOST, point_prior(LOST, [0.1, 0.0, 2.0])))
    solver.log.replace(2, distance(LOST))
    np.testing.assert_allclose(solver.joint_covariance([GOOD]), 1e-4 * np.eye(3), rtol=1e-6)
    with pytest.raises(ObservabilityError, match="landmark 2"):
        solver.joint_covariance([GOOD, LOST])
