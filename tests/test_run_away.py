"""Landmarks that nothing holds any more are found, and blamed for what they do to others."""

import gtsam
import numpy as np
import pytest

from surecut.estimator.graph import State
from surecut.estimator.run_away import DISPARITY_PX, NOWHERE_M, blamed, run_away
from surecut.factors import keys

FOCAL_PX, BASELINE_M = 300.0, 0.1


@pytest.fixture
def state():
    """Two keyframes, a metre apart, and three landmarks before them."""
    state = State()
    for i in range(2):
        state.values.insert(keys.keyframe(i), gtsam.Pose3(gtsam.Rot3(), np.array([1.0 * i, 0.0, 0.0])))
    for i in range(3):
        state.values.insert(keys.landmark(i), np.array([0.2 * i, 0.0, 3.0]))
    lens = gtsam.Cal3DS2(FOCAL_PX, FOCAL_PX, 0, 180, 120, 0, 0, 0, 0)
    state.values.insert(keys.intrinsics("m_left"), lens)
    right = gtsam.Pose3(gtsam.Rot3(), np.array([BASELINE_M, 0.0, 0.0]))
    state.values.insert(keys.extrinsics("m_right"), right)
    return state


def test_reach_is_where_a_pair_tells_depth_from_none(state):
    reach_m = FOCAL_PX * BASELINE_M / DISPARITY_PX
    state.values.update(keys.landmark(1), np.array([0.0, 0.0, 0.999 * reach_m]))
    assert run_away(state) == set()
    state.values.update(keys.landmark(1), np.array([0.5, 0.0, 1.001 * reach_m]))
    assert run_away(state) == {keys.landmark(1)}
    far = gtsam.Pose3(gtsam.Rot3(), np.array([0.0, 0.0, 0.5 * reach_m]))
    state.values.insert(keys.keyframe(2), far)  # from here it is near
    assert run_away(state) == set()


def test_what_is_no_number_has_run_away_too(state):
    state.values.update(keys.landmark(2), np.array([0.0, np.nan, 3.0]))
    assert run_away(state) == {keys.landmark(2)}
    assert blamed(keys.landmark(0), state.values) == keys.landmark(2)


def test_nothing_is_told_without_a_pair(state):
    state.values.update(keys.landmark(1), np.array([0.0, 0.0, 1e9]))
    state.values.erase(keys.extrinsics("m_right"))
    assert run_away(state) == set()
    assert run_away(State()) == set()


def test_the_farthest_of_those_that_are_nowhere_is_blamed_first(state):
    innocent = keys.keyframe(1)
    assert blamed(innocent, state.values) == innocent
    state.values.update(keys.landmark(0), np.array([0.0, 0.0, 2 * NOWHERE_M]))
    state.values.update(keys.landmark(1), np.array([0.0, 0.0, -3 * NOWHERE_M]))
    assert blamed(innocent, state.values) == keys.landmark(1)
    assert blamed(innocent, state.values, {keys.landmark(1)}) == keys.landmark(0)
    assert blamed(innocent, state.values, {keys.landmark(0), keys.landmark(1)}) == innocent
