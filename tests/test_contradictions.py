"""An estimate that agrees with itself because of what was taken out of it is not consistent."""

from surecut.estimator.consistency import (
    CONTRADICTING,
    FEWEST_CONTRADICTING,
    contradicted_points,
    contradictions,
    judge,
)
from surecut.estimator.result import FamilyConsistency
from surecut.factors.measurements import Rejection


def family(residuals: int) -> FamilyConsistency:
    return FamilyConsistency("pipe outline", float(residuals), float(residuals), 0.1, 3.0, residuals, 0)


def rejected(number: int) -> list[Rejection]:
    return [Rejection(i, "pipe outline", f"edge {i}", "whitened residual", 9.0, 4.9) for i in range(number)]


def clicks(point: str, number: int) -> list[Rejection]:
    return [Rejection(i, "picks", f"pick {point} in m_left", "whitened residual", 9.0, 4.9) for i in range(number)]


def test_a_family_of_which_half_contradicts_the_rest():
    told = contradictions([family(10)], rejected(10))
    assert told == ["pipe outline: 10 of 20 measurements contradict the rest (limit a third)"]
    verdict = judge((family(10),), [], {}, told)
    assert not verdict.passed
    assert verdict.reasons == tuple(told)


def test_a_few_gross_errors_are_outliers():
    assert not contradictions([family(10)], rejected(5))
    assert 6 / 16 > CONTRADICTING
    assert contradictions([family(10)], rejected(6))
    assert not contradictions([family(1)], rejected(FEWEST_CONTRADICTING - 1))
    assert not contradictions([family(10)], clicks("P1", 9))


def test_a_point_that_half_of_its_clicks_contradict():
    """One of three is an outlier; of one of two nobody knows which."""
    assert contradicted_points({"P1": 3, "P2": 3}, clicks("P1", 3)) == [
        "P1: 3 of 3 clicks contradict the rest (limit half)"
    ]
    assert contradicted_points({"P1": 2}, clicks("P1", 1))
    assert not contradicted_points({"P1": 3}, clicks("P1", 1))
    assert not contradicted_points({"P1": 1, "P10": 3}, clicks("P10", 1))
    depth = [Rejection(0, "picks", "stereo depth under pick P1", "whitened residual", 9.0, 4.9)]
    assert not contradicted_points({"P1": 1}, depth)
