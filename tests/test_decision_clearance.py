"""Distances of the tool from what is beside the cut, against closed forms and samples."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from surecut.estimator.clearance import SweptDisc, box_gap, pipe_gap

ORIGIN = np.zeros(3)
UP = np.array([0.0, 0.0, 1.0])


def box(low, high):
    return np.array(low, dtype=float), np.array(high, dtype=float)


def test_faces_edges_and_corners_of_a_box_from_a_point():
    point = SweptDisc(ORIGIN, UP, 0.0, 0.0)
    assert box_gap(point, *box((2, -1, -1), (3, 1, 1)))[0] == pytest.approx(2.0)
    assert box_gap(point, *box((3, 4, -1), (9, 9, 1)))[0] == pytest.approx(5.0, rel=1e-5)
    corner, direction = box_gap(point, *box((1, 2, 2), (9, 9, 9)))
    assert corner == pytest.approx(3.0, rel=2e-3)
    assert corner <= 3.0
    assert direction == pytest.approx([1 / 3, 2 / 3, 2 / 3], abs=0.06)
    assert box_gap(point, *box((-1, -2, -3), (4, 5, 6)))[0] == pytest.approx(-1.0)


def test_a_disc_reaches_sideways_but_not_along_its_axis():
    disc = SweptDisc(ORIGIN, UP, 0.5, 0.1)
    assert box_gap(disc, *box((2, -1, -1), (3, 1, 1)))[0] == pytest.approx(1.5)
    assert box_gap(disc, *box((-1, -1, 2), (1, 1, 3)))[0] == pytest.approx(1.9)
    ball = SweptDisc(ORIGIN, None, 0.3, 0.4)
    assert box_gap(ball, *box((2, -1, -1), (3, 1, 1)))[0] == pytest.approx(1.5)


def test_pipes_parallel_crossed_and_through():
    disc = SweptDisc(ORIGIN, UP, 0.5, 0.1)
    assert pipe_gap(disc, np.array([2.0, 0, 7]), UP, 0.4)[0] == pytest.approx(1.1)
    assert pipe_gap(disc, np.array([0, 0, 2.0]), np.array([1.0, 0, 0]), 0.4)[0] == pytest.approx(1.5)
    assert pipe_gap(disc, np.array([0.1, 0, 0]), UP, 0.4)[0] == pytest.approx(-0.8)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_never_more_than_the_sampled_distance(seed):
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    disc = SweptDisc(rng.normal(size=3), axis, rng.uniform(0, 0.5), rng.uniform(0, 0.2))
    low = rng.normal(size=3) * 2
    high = low + rng.uniform(0.1, 2, 3)
    gap, direction = box_gap(disc, low, high)
    assert np.linalg.norm(direction) == pytest.approx(1)
    # Nearest pair by alternating projections between the two convex bodies.
    x = disc.centre_m.copy()
    for _ in range(1500):
        y = np.clip(x, low, high)
        offset = y - disc.centre_m
        along = offset @ axis
        across = offset - along * axis
        radius = np.linalg.norm(across)
        across *= min(1.0, disc.radius_m / radius) if radius > 0 else 1.0
        x = disc.centre_m + np.clip(along, -disc.half_width_m, disc.half_width_m) * axis + across
    distance = np.linalg.norm(x - np.clip(x, low, high))
    assert max(gap, 0.0) <= distance + 1e-3
    if distance > 0.05:
        assert gap == pytest.approx(distance, rel=5e-3, abs=2e-3)
