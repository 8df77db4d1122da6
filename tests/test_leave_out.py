"""An estimate without one family: against closed forms, and against leaving it out."""

import gtsam
import numpy as np
import pytest

from surecut.estimator.graph import Record
from surecut.estimator.leave_out import without_families
from surecut.estimator.linear import LinearSystem, deviate


def prior(key: int, value: list[float], sigma: float) -> gtsam.NonlinearFactor:
    noise = gtsam.noiseModel.Isotropic.Sigma(len(value), sigma)
    return gtsam.PriorFactorVector(key, np.array(value), noise)


def solved(rows, dimension: int = 1):
    """The system of priors (family, value, sigma) on one variable, at its optimum."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    weights = np.array([1 / sigma**2 for _, _, sigma in rows])
    best = (weights[:, None] * np.array([value for _, value, _ in rows])).sum(axis=0) / weights.sum()
    values.insert(1, best)
    active = []
    for i, (family, value, sigma) in enumerate(rows):
        factor = prior(1, value, sigma)
        graph.add(factor)
        active.append((i, factor, Record(family, family, 0, family)))
    return active, LinearSystem(graph, values), {"P": [(1, np.eye(dimension))]}


def test_two_measurements_of_one_scalar():
    """0 +/- 1 and 3 +/- 2 differ by 3 / sqrt(5) sigmas, whichever is left out; a family that is alone has no answer."""
    active, system, blocks = solved([("a", [0.0], 1.0), ("b", [3.0], 2.0)])
    found = without_families(active, system, blocks, ["a", "b", "none"])
    assert found == {("P", "a"): pytest.approx(3 / np.sqrt(5)), ("P", "b"): pytest.approx(3 / np.sqrt(5))}
    alone, system, blocks = solved([("a", [0.0], 1.0)])
    assert without_families(alone, system, blocks, ["a"]) == {}


def test_it_is_the_difference_of_two_solutions():
    rng = np.random.default_rng(5)
    rows = [("ab"[i % 2], list(rng.normal(size=3)), float(rng.uniform(0.5, 2))) for i in range(8)]
    active, system, blocks = solved(rows, 3)
    (sigma,) = without_families(active, system, blocks, ["a"]).values()
    weight = {f: sum(1 / s**2 for g, _, s in rows if g == f) for f in "ab"}
    mean = {f: np.sum([np.array(v) / s**2 for g, v, s in rows if g == f], axis=0) / weight[f] for f in "ab"}
    difference = mean["a"] - mean["b"]
    expected = float(difference @ difference / (1 / weight["a"] + 1 / weight["b"]))
    assert sigma == pytest.approx(deviate(expected, 3))
