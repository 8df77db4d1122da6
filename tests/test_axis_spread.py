"""How well an axis is known across a view, and families that had to be taken apart: closed forms."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from surecut.estimator.axis_spread import AxisSpread
from surecut.estimator.consistency import CONTRADICTING, FEWEST_CONTRADICTING, judge
from surecut.estimator.result import FamilyConsistency
from surecut.factors.measurements import Rejection

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


def family(residuals: int) -> FamilyConsistency:
    return FamilyConsistency("pipe outline", float(residuals), float(residuals), 0.1, 3.0, residuals, 0)


def rejected(number: int) -> list[Rejection]:
    return [Rejection(i, "pipe outline", f"edge {i}", "whitened residual", 9.0, 4.9) for i in range(number)]


def test_a_family_of_which_half_contradicts_the_rest_is_not_consistent():
    """What is left agrees with itself, because the rest was taken out."""
    verdict = judge((family(10),), [], {}, rejected(10))
    assert not verdict.passed
    assert verdict.reasons == ("pipe outline: 10 of 20 measurements contradict the rest (limit a third)",)


def test_a_few_gross_errors_are_outliers():
    assert judge((family(10),), [], {}, rejected(5)).passed
    assert 6 / 16 > CONTRADICTING
    assert not judge((family(10),), [], {}, rejected(6)).passed
    assert judge((family(1),), [], {}, rejected(FEWEST_CONTRADICTING - 1)).passed
    assert judge((family(10),), [], {}, [Rejection(0, "picks", "P1", "whitened residual", 9.0, 4.9)] * 9).passed
