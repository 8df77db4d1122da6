"""The missing variance of given distances: closed forms, and a graph whose distances disagree."""

import gtsam
import numpy as np
import pytest

from surecut.estimator.dark_uncertainty import left_out, missing_variance, of_distances
from surecut.estimator.linear import LinearSystem


def test_equal_variances_give_the_mean_square_minus_the_variance():
    errors = np.array([3.0, -4.0, 5.0, 0.0])
    assert missing_variance(errors, np.full(4, 2.0)) == pytest.approx(50 / 4 - 2.0)


def test_errors_within_their_sigmas_miss_nothing():
    assert missing_variance(np.array([1.0, -1.0, 0.5]), np.ones(3)) == 0.0
    assert missing_variance(np.zeros(0), np.zeros(0)) == 0.0


def test_two_variances_by_hand():
    # 8 / (1 + t) + 10 / (4 + t) = 2: 2 t^2 - 8 t - 34 = 0 divided out
    tau2 = missing_variance(np.sqrt([8.0, 10.0]), np.array([1.0, 4.0]))
    assert 8 / (1 + tau2) + 10 / (4 + tau2) == pytest.approx(2.0)
    assert tau2 == pytest.approx(2.0 + np.sqrt(21.0))


def test_it_recovers_what_was_drawn():
    rng = np.random.default_rng(0)
    variances = rng.uniform(1.0, 9.0, 4000)
    errors = rng.normal(0, np.sqrt(variances + 16.0))
    assert missing_variance(errors, variances) == pytest.approx(16.0, rel=0.1)


def system(measured, sigmas):
    """Measurements of one and the same length, along x."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    mean = np.average(measured, weights=np.asarray(sigmas) ** -2.0)
    values.insert(0, np.zeros(3))
    values.insert(1, np.array([mean, 0.0, 0.0]))
    graph.add(gtsam.PriorFactorPoint3(0, np.zeros(3), gtsam.noiseModel.Isotropic.Sigma(3, 1e-6)))
    across = gtsam.noiseModel.Diagonal.Sigmas(np.array([1e6, 1e-6, 1e-6]))
    graph.add(gtsam.PriorFactorPoint3(1, np.array([mean, 0, 0]), across))
    for length, sigma in zip(measured, sigmas, strict=True):
        graph.add(gtsam.RangeFactor3(0, 1, length, gtsam.noiseModel.Isotropic.Sigma(1, sigma)))
    return LinearSystem(graph, values), list(range(2, 2 + len(measured)))


def test_left_out_errors_are_those_of_really_leaving_out():
    measured, sigmas = np.array([5.0, 5.01, 4.98, 5.002, 5.03]), np.array([1, 2, 3, 1, 2]) * 1e-3
    errors, variances = left_out(*system(measured, sigmas), sigmas)
    for i in range(5):
        rest = np.arange(5) != i
        weights = sigmas[rest] ** -2.0
        expected = measured[i] - np.average(measured[rest], weights=weights)
        assert abs(errors[i]) == pytest.approx(abs(expected), rel=1e-4)
        assert variances[i] == pytest.approx(sigmas[i] ** 2 + 1 / weights.sum(), rel=1e-4)


def test_three_distances_are_too_few():
    measured, sigmas = np.array([5.0, 5.1, 4.9]), np.full(3, 1e-3)
    assert of_distances(*system(measured, sigmas), sigmas) == 0.0


def test_a_distance_that_nothing_else_predicts_does_not_count():
    linear, positions = system(np.array([5.0]), np.array([1e-3]))
    errors, _ = left_out(linear, positions, np.array([1e-3]))
    assert len(errors) == 0
