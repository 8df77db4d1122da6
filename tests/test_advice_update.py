"""Predicted factors change a covariance as closed forms say, and as rebuilding the graph with them does."""

import gtsam
import numpy as np
import pytest
from scipy.sparse import csr_matrix

from surecut.estimator.advice_update import Joint, Predicted, Rows, measured_again
from surecut.estimator.linear import LinearSystem
from surecut.factors.noise import sigmas


def scalar_prior(key, sigma):
    return gtsam.PriorFactorVector(key, np.zeros(1), sigmas([sigma]))


def difference(a, b, sigma):
    def error(factor, values, jacobians):
        if jacobians is not None:
            jacobians[0], jacobians[1] = -np.eye(1), np.eye(1)
        return values.atVector(b) - values.atVector(a)

    return gtsam.CustomFactor(sigmas([sigma]), [a, b], error)


ONE = [(1, np.eye(1))]
"""The variable 1 itself."""


def system_of(factors, keys):
    values = gtsam.Values()
    for key in keys:
        values.insert(key, np.zeros(1))
    graph = gtsam.NonlinearFactorGraph()
    for factor in factors:
        graph.add(factor)
    return LinearSystem(graph, values), values


def test_a_scalar_measured_again():
    """Sigma 3 measured once more with sigma 4: 1 / (1/9 + 1/16) = 5.76."""
    system, values = system_of([scalar_prior(1, 3.0)], [1])
    joint = Joint.of(system, [1])
    rows = joint.rows([Predicted(scalar_prior(1, 4.0))], values)
    assert joint.covariance[0, 0] == pytest.approx(9.0)
    assert joint.after(rows, ONE)[0, 0] == pytest.approx(5.76)


def test_a_new_variable_passes_on_what_is_known_of_it():
    """x (sigma 3) tied to a new y with sigma 2, and y known to sigma 1: x is measured with variance 4 + 1."""
    system, values = system_of([scalar_prior(1, 3.0)], [1])
    joint = Joint.of(system, [1])
    values.insert(2, np.zeros(1))
    rows = joint.rows([Predicted(difference(1, 2, 2.0)), Predicted(scalar_prior(2, 1.0))], values)
    assert rows.W.shape == (1, 1)
    assert joint.after(rows, ONE)[0, 0] == pytest.approx(1 / (1 / 9 + 1 / 5))


def test_a_new_variable_that_nothing_else_holds_says_nothing():
    system, values = system_of([scalar_prior(1, 3.0)], [1])
    joint = Joint.of(system, [1])
    values.insert(2, np.zeros(1))
    rows = joint.rows([Predicted(difference(1, 2, 2.0))], values)
    assert joint.after(rows, ONE)[0, 0] == pytest.approx(9.0)


def test_correlated_errors_keep_their_weights():
    """Two measurements of sigma 1 whose errors have twice the variance that the weights assume: mean has 1, not 1/2."""
    system, values = system_of([scalar_prior(1, 1.0), scalar_prior(1, 1.0)], [1])
    system.root = csr_matrix(np.sqrt(2.0) * np.eye(2))
    joint = Joint.of(system, [1])
    assert joint.covariance[0, 0] == pytest.approx(1.0)
    # A third, honest one is weighed with a third: 1/9 + (2 + 2)/9.
    honest = joint.rows([Predicted(scalar_prior(1, 1.0))], values)
    assert joint.after(honest, ONE)[0, 0] == pytest.approx(5 / 9)
    inflated = joint.rows([Predicted(scalar_prior(1, 1.0), 2.0)], values)
    assert joint.after(inflated, ONE)[0, 0] == pytest.approx(6 / 9)


def test_adding_equals_rebuilding():
    rng = np.random.default_rng(3)
    keys = list(range(1, 7))
    factors = [scalar_prior(1, 0.1)]
    factors += [difference(a, b, s) for a, b, s in zip(keys, keys[1:], rng.uniform(0.5, 2, 5), strict=False)]
    extra = [difference(2, 6, 0.7), difference(3, 5, 0.4), scalar_prior(6, 1.5)]
    system, values = system_of(factors, keys)
    whole, _ = system_of(factors + extra, keys)
    joint = Joint.of(system, [2, 3, 5, 6])
    rows = joint.rows([Predicted(f) for f in extra], values)
    all_of_it = [(key, np.eye(4)[:, i : i + 1]) for i, key in enumerate([2, 3, 5, 6])]
    np.testing.assert_allclose(joint.after(rows, all_of_it), whole.joint([2, 3, 5, 6]), rtol=1e-9)
    np.testing.assert_allclose(joint.covariance, system.joint([2, 3, 5, 6]), rtol=1e-9)
    J = rng.normal(size=(2, 1))
    np.testing.assert_allclose(joint.after(rows, [(3, J), (6, -J)]), whole.covariance([(3, J), (6, -J)]), rtol=1e-9)


def test_no_rows_change_nothing():
    system, _ = system_of([scalar_prior(1, 3.0)], [1])
    joint = Joint.of(system, [1])
    assert joint.after(Rows(np.zeros((0, 1)), np.zeros((0, 0))), ONE)[0, 0] == pytest.approx(9.0)


def test_measuring_rows_again_equals_rebuilding():
    """Four times the information in a row is half the sigma."""
    before, _ = system_of([scalar_prior(1, 0.5), difference(1, 2, 2.0)], [1, 2])
    after, _ = system_of([scalar_prior(1, 0.5), difference(1, 2, 1.0)], [1, 2])
    J = np.array([[1.0]])
    got = measured_again(before, np.array([False, True]), 4.0, [(2, J)])
    np.testing.assert_allclose(got, after.covariance([(2, J)]))
    assert got[0, 0] == pytest.approx(1.25)
