"""How well an axis is known across a view: closed forms."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from surecut.estimator.axis_spread import AxisSpread

START, END = np.array([0.0, -0.25, 1.0]), np.array([0.0, 0.25, 1.0])
PART = START + np.array([0.0, 0.1, 0.0]), END - np.array([0.0, 0.1, 0.0])


def test_ends_that_are_equally_unsure_from_all_sides():
    spread = AxisSpread(START, END, 0.01**2 * np.eye(6))
    expected = 0.01 / np.sqrt(2), 0.01 * np.sqrt(2) / 0.5
    assert spread.across(np.zeros(3), PART) == pytest.approx(expected)
    assert spread.across(np.array([1.0, 0.0, 1.0]), PART) == pytest.approx(expected)
    assert spread.worst(PART) == pytest.approx(expected)


def test_what_is_unsure_along_the_sight_is_unsure_across_it_from_elsewhere():
    """One click fixes a pipe across its ray, its depth stays open: the next view sees that from the side."""
    depth = np.diag([0.001, 0.001, 0.04] * 2) ** 2
    together = depth + np.kron(1 - np.eye(2), depth[:3, :3])  # both ends are wrong alike
    spread = AxisSpread(START, END, together)
    assert spread.across(np.zeros(3), PART) == pytest.approx((0.001, 0.0), abs=1e-9)
    aside = np.array([1.0, 0.0, 0.0])  # 45 degrees
    assert spread.across(aside, PART)[0] == pytest.approx(np.hypot(0.001, 0.04) / np.sqrt(2))
    assert spread.worst(PART) == pytest.approx((0.04, 0.0), abs=1e-9)


def test_beyond_the_ends_the_direction_counts():
    spread = AxisSpread(START, END, 0.01**2 * np.eye(6))
    far = START + np.array([0.0, 1.0, 0.0]), END + np.array([0.0, 1.0, 0.0])  # 2.5 and -1.5 times the ends
    assert spread.across(np.zeros(3), far)[0] == pytest.approx(0.01 * np.hypot(2.5, 1.5))


@given(st.integers(0, 10**6))
def test_no_side_is_worse_than_the_worst(seed):
    rng = np.random.default_rng(seed)
    root = rng.normal(0, 0.01, (6, 6))
    spread = AxisSpread(rng.normal(size=3), rng.normal(size=3), root @ root.T)
    part = spread.start, spread.end
    across, worst = spread.across(rng.normal(size=3), part), spread.worst(part)
    assert np.less_equal(across, np.array(worst) * (1 + 1e-9)).all()
