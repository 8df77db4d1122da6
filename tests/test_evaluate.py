"""The evaluation against distributions known beforehand."""

import gtsam
import numpy as np
import pytest
from scipy.stats import binomtest, chi2

from surecut.factors.geometry import ros_covariance
from surecut.simulation.evaluate import (
    normalised_square,
    point_quantity,
    pose_error,
    pose_quantity,
    scalar_quantity,
)
from surecut.simulation.evaluate_summary import clopper_pearson, nees_interval, summarise


def random_covariance(rng, n, sigma):
    A = rng.normal(0.0, 1.0, (n, n))
    return sigma**2 * (A @ A.T / n + 0.1 * np.eye(n))


def test_normalised_square_by_hand():
    assert normalised_square(np.array([3.0, 4.0]), np.diag([9.0, 4.0])) == pytest.approx(5.0)
    # [[2, 1], [1, 2]]^-1 = [[2, -1], [-1, 2]] / 3
    assert normalised_square(np.array([1.0, 1.0]), np.array([[2.0, 1.0], [1.0, 2.0]])) == pytest.approx(2.0 / 3.0)


@pytest.mark.parametrize("bad", [np.zeros((2, 2)), np.array([[1.0, 2.0], [2.0, 1.0]]), np.full((2, 2), np.nan)])
def test_unusable_covariance_is_not_a_number(bad):
    assert np.isnan(normalised_square(np.ones(2), bad))


def test_poses_drawn_in_gtsams_tangent_have_the_nees_of_the_ros_covariance():
    rng = np.random.default_rng(5)
    runs = []
    for _ in range(600):
        estimate = gtsam.Pose3(gtsam.Rot3.Expmap(rng.normal(0.0, 1.5, 3)), rng.normal(0.0, 2.0, 3))
        # Rotations and translations of very different size, and correlated: a wrong order or frame shows.
        scales = np.diag([0.004, 0.002, 0.009, 0.003, 0.02, 0.008])
        covariance = scales @ random_covariance(rng, 6, 1.0) @ scales
        xi = rng.multivariate_normal(np.zeros(6), covariance)
        true = estimate.compose(gtsam.Pose3.Expmap(xi))
        runs.append(
            [pose_quantity("pose_b", "b", estimate.matrix(), ros_covariance(estimate, covariance), true.matrix())]
        )
    (summary,) = summarise(runs)
    lower, upper = nees_interval(600, 6, 0.999)
    assert lower < summary.nees_per_dof < upper
    for coverage in summary.coverage:
        assert binomtest(round(coverage.share * 600), 600, coverage.level).pvalue > 1e-3


def test_a_covariance_in_the_wrong_order_is_seen():
    rng = np.random.default_rng(6)
    covariance = np.diag([0.004, 0.002, 0.009, 0.03, 0.02, 0.08]) ** 2
    runs = []
    for _ in range(100):
        estimate = gtsam.Pose3(gtsam.Rot3.Expmap(rng.normal(0.0, 1.5, 3)), rng.normal(0.0, 2.0, 3))
        true = estimate.compose(gtsam.Pose3.Expmap(rng.multivariate_normal(np.zeros(6), covariance)))
        runs.append([pose_quantity("pose_b", "b", estimate.matrix(), covariance, true.matrix())])
    (summary,) = summarise(runs)
    assert summary.nees_per_dof > 2.0


def test_pose_error_is_the_parents_rotation():
    estimate = gtsam.Pose3(gtsam.Rot3.Ry(np.pi / 2), np.array([1.0, 2.0, 3.0]))
    true = gtsam.Pose3(gtsam.Rot3.Rz(0.1) * gtsam.Rot3.Ry(np.pi / 2), np.array([1.0, 2.5, 3.0]))
    np.testing.assert_allclose(pose_error(estimate.matrix(), true.matrix()), [0, 0.5, 0, 0, 0, 0.1], atol=1e-12)


@pytest.mark.parametrize("told", [1.0, 0.5, 2.0])
def test_points_with_right_and_wrong_noise(told):
    rng = np.random.default_rng(7)
    runs = []
    for _ in range(1000):
        covariance = random_covariance(rng, 3, 0.01)
        true = rng.normal(0.0, 1.0, 3)
        position = true + rng.multivariate_normal(np.zeros(3), covariance)
        runs.append([point_quantity("P1", position, told**2 * covariance, true)])
    summary = next(one for one in summarise(runs) if one.name == "P1")
    expected = 1.0 / told**2
    assert summary.nees_per_dof == pytest.approx(expected, rel=0.08)
    assert (summary.nees_lower < summary.nees_per_dof < summary.nees_upper) == (told == 1.0)
    in95 = next(coverage for coverage in summary.coverage if coverage.level == 0.95)
    assert in95.share == pytest.approx(chi2.cdf(told**2 * chi2.ppf(0.95, 3), 3), abs=0.035)
    assert in95.accepted == (told == 1.0)
    assert summary.rms / summary.rms_sigma == pytest.approx(1.0 / told, rel=0.1)


def test_two_identical_points_of_a_run_do_not_narrow_the_interval():
    rng = np.random.default_rng(8)
    runs = []
    for _ in range(50):
        error = rng.normal(0.0, 1.0, 3)
        runs.append([point_quantity(name, error, np.eye(3), np.zeros(3)) for name in ("P1", "P2")])
    pooled = next(one for one in summarise(runs) if one.name == "all")
    assert (pooled.runs, pooled.values) == (50, 100)
    assert (pooled.nees_lower, pooled.nees_upper) == nees_interval(50, 3)


def test_clopper_pearson_against_scipy_and_at_the_ends():
    interval = binomtest(93, 100).proportion_ci(0.95, method="exact")
    assert clopper_pearson(93, 100) == pytest.approx((interval.low, interval.high))
    assert clopper_pearson(0, 20) == pytest.approx((0.0, 1.0 - 0.025 ** (1 / 20)))
    assert clopper_pearson(20, 20) == pytest.approx((0.025 ** (1 / 20), 1.0))


def test_nees_interval_is_a_chi_square_quantile():
    assert nees_interval(1, 3) == pytest.approx((0.2158 / 3, 9.3484 / 3), abs=1e-4)


def test_scalar_two_sigmas_off():
    quantity = scalar_quantity("calibration", "baseline", 0.15, 0.001, 0.152, "m")
    assert quantity.nees == pytest.approx(4.0)
    assert quantity.probability == pytest.approx(0.9545, abs=1e-4)
