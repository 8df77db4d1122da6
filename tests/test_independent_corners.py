"""Independent corners that know as much as a marker's fit does."""

import numpy as np
import pytest

from surecut.frontends.fiducials.independent_corners import independent_scale

SQUARE = np.array([[10.0, 10.0], [40.0, 12.0], [38.0, 41.0], [11.0, 39.0]])


def joined(blocks):
    whole = np.zeros((8, 8))
    for k, block in enumerate(blocks):
        whole[2 * k : 2 * k + 2, 2 * k : 2 * k + 2] = block
    return whole


def test_corners_that_are_independent_stay_as_they_are():
    A = np.random.default_rng(1).normal(size=(4, 2, 2))
    blocks = A @ A.transpose(0, 2, 1) + 0.1 * np.eye(2)
    assert independent_scale(joined(blocks), SQUARE) == pytest.approx(1.0)


def test_the_scale_is_that_of_the_affine_modes_in_closed_form():
    """On a parallelogram six affine modes of variance a and the two others of variance b: blocks have (3 a + b) / 4,
    and a is what the six modes have."""
    parallelogram = np.array([[0.0, 0.0], [20.0, 4.0], [23.0, 25.0], [3.0, 21.0]])
    bend = np.array([1.0, -1.0, 1.0, -1.0]) / 2.0
    P = np.kron(np.outer(bend, bend), np.eye(2))
    a, b = 4e-4, 9e-4
    covariance = a * (np.eye(8) - P) + b * P
    np.testing.assert_allclose(covariance[:2, :2], (3 * a + b) / 4 * np.eye(2), atol=1e-12)
    assert independent_scale(covariance, parallelogram) == pytest.approx(4 * a / (3 * a + b))


@pytest.mark.parametrize("seed", range(5))
def test_units_and_order_of_the_image_do_not_matter(seed):
    A = np.random.default_rng(seed).normal(size=(8, 8))
    covariance = A @ A.T + 0.1 * np.eye(8)
    scale = independent_scale(covariance, SQUARE)
    assert independent_scale(9.0 * covariance, 3.0 * SQUARE + 7.0) == pytest.approx(scale)
    turned = np.roll(np.arange(8), 2)
    assert independent_scale(covariance[np.ix_(turned, turned)], np.roll(SQUARE, 1, axis=0)) == pytest.approx(scale)
