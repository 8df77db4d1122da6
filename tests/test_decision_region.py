"""The probability that a cut lies within its tolerance, against closed forms and Monte Carlo."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import ndtr
from scipy.stats import chi, chi2, ncx2

from surecut.estimator.region_probability import axis_frame, ball_probability, cylinder_probability


def random_covariance(rng, spread=1.0):
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    return turn @ np.diag(np.exp(rng.normal(0, spread, 3)) ** 2) @ turn.T


def sampled(covariance, axis, along, across, count, rng):
    error = rng.multivariate_normal(np.zeros(3), covariance, count, method="cholesky")
    a = error @ axis
    return np.mean((np.abs(a) <= along) & (np.sum(error**2, 1) - a**2 <= across**2))


def test_closed_form_independent_axis_round_disc():
    axis = np.array([1.0, 2.0, -2.0]) / 3
    covariance = 0.7**2 * np.outer(axis, axis) + 1.3**2 * (np.eye(3) - np.outer(axis, axis))
    expected = (2 * ndtr(1.1 / 0.7) - 1) * (1 - np.exp(-0.5 * (2.0 / 1.3) ** 2))
    assert cylinder_probability(covariance, axis, 1.1, 2.0) == pytest.approx(expected, abs=1e-12)


def test_wide_interval_leaves_the_disc_and_wide_disc_the_interval():
    covariance = np.array([[4.0, 1.0, 0.5], [1.0, 2.0, -0.3], [0.5, -0.3, 1.0]])
    assert cylinder_probability(covariance, np.eye(3)[0], 2.5, 1e3) == pytest.approx(2 * ndtr(1.25) - 1, abs=1e-12)
    # Sum of two scaled chi-squares: condition on one, the other is a non-central chi-square; here both are equal.
    disc = cylinder_probability(np.diag([1.0, 2.25, 2.25]), np.eye(3)[0], 1e3, 2.0)
    assert disc == pytest.approx(chi2.cdf(4 / 2.25, 2), abs=1e-12)


def test_hoyt_distribution_in_the_disc():
    # P(x^2/4 + ... ) by one-dimensional sums over the non-central chi-square, an independent route.
    s1, s2, r = 2.0, 0.5, 1.7
    x = np.linspace(-r, r, 400_001)
    inner = chi2.cdf((r**2 - x**2) / s2**2, 1) * np.exp(-0.5 * (x / s1) ** 2) / (s1 * np.sqrt(2 * np.pi))
    assert cylinder_probability(np.diag([1.0, s1**2, s2**2]), np.eye(3)[0], 50.0, r) == pytest.approx(
        np.trapezoid(inner, x), abs=1e-7
    )


@pytest.mark.parametrize("seed", range(12))
def test_against_monte_carlo(seed):
    rng = np.random.default_rng(seed)
    covariance = random_covariance(rng, 1.0)
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    along, across = np.exp(rng.normal(0.5, 0.8, 2))
    exact = cylinder_probability(covariance, axis, along, across)
    count = 1_000_000
    estimate = sampled(covariance, axis, along, across, count, rng)
    assert exact == pytest.approx(estimate, abs=4.5 * np.sqrt(exact * (1 - exact) / count) + 1e-6)
    radius = np.exp(rng.normal(0.5, 0.8))
    error = rng.multivariate_normal(np.zeros(3), covariance, count, method="cholesky")
    inside = np.mean(np.sum(error**2, 1) <= radius**2)
    exact = ball_probability(covariance, radius)
    assert exact == pytest.approx(inside, abs=4.5 * np.sqrt(exact * (1 - exact) / count) + 1e-6)


@pytest.mark.parametrize("ratio", [1.0, 30.0, 1e3, 1e5])
def test_needles_and_pancakes_against_a_fine_grid(ratio):
    """Nearly singular errors, turned by 37 degrees between axis and side: a steep step in the integrand."""
    c, s = np.cos(0.65), np.sin(0.65)
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
    covariance = turn @ np.diag([1.0, ratio**-2, 0.25]) @ turn.T
    exact = cylinder_probability(covariance, np.eye(3)[0], 0.8, 1.1)
    # In principal axes: for each point of (u, w) the narrow direction is a closed interval.
    u, w = np.meshgrid((np.arange(12_000) + 0.5) * 1e-3 - 6, (np.arange(240) + 0.5) * 0.025 - 3, indexing="ij")
    weight = np.exp(-0.5 * u**2 - 2 * w**2) / np.pi * (1e-3 * 0.025)
    half = np.sqrt(np.maximum(1.21 - w**2, 0))
    low = np.maximum((c * u - 0.8) / s, (-half - s * u) / c)
    high = np.minimum((c * u + 0.8) / s, (half - s * u) / c)
    inner = np.where((high > low) & (np.abs(w) < 1.1), ndtr(high * ratio) - ndtr(low * ratio), 0.0)
    assert exact == pytest.approx(np.sum(weight * inner), abs=3e-4)


def test_ball_of_a_round_gaussian_and_its_coverage_factor():
    for factor in (0.3, 1.0, 2.796, 5.0):
        assert ball_probability(np.eye(3) * 0.01**2, factor * 0.01) == pytest.approx(chi.cdf(factor, 3), abs=1e-10)
    assert ball_probability(np.diag([1.0, 1.0, 1e-12]), 1.5) == pytest.approx(chi2.cdf(2.25, 2), abs=1e-6)
    assert ball_probability(np.diag([1.0, 1e-12, 1e-12]), 1.5) == pytest.approx(ncx2.cdf(2.25, 1, 0), abs=1e-6)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(0.05, 20), st.floats(0.05, 20))
def test_bounds_monotony_and_invariance(seed, along, across):
    rng = np.random.default_rng(seed)
    covariance = random_covariance(rng, 1.5)
    axis = rng.normal(size=3)
    p = cylinder_probability(covariance, axis, along, across)
    assert 0.0 <= p <= 1.0
    assert p <= cylinder_probability(covariance, axis, along * 1.1, across) + 1e-9
    assert p <= cylinder_probability(covariance, axis, along, across * 1.1) + 1e-9
    assert p == pytest.approx(cylinder_probability(covariance, -3.0 * axis, along, across), abs=1e-9)
    assert p == pytest.approx(cylinder_probability(1e-6 * covariance, axis, 1e-3 * along, 1e-3 * across), abs=1e-9)
    assert ball_probability(covariance, min(along, across)) <= p + 1e-7
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    assert p == pytest.approx(cylinder_probability(turn @ covariance @ turn.T, turn @ axis, along, across), abs=1e-8)


def test_no_room_no_probability():
    assert cylinder_probability(np.eye(3), np.eye(3)[2], 0.0, 1.0) == 0.0
    assert cylinder_probability(np.eye(3), np.eye(3)[2], 1.0, -1.0) == 0.0
    assert ball_probability(np.eye(3), 0.0) == 0.0


def test_axis_frame_is_a_rotation():
    frame = axis_frame(np.array([0.0, 0.0, 5.0]))
    assert frame @ frame.T == pytest.approx(np.eye(3))
    assert frame[0] == pytest.approx([0, 0, 1])
