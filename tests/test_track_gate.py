"""Landmarks that come back: their covariances with the last pose come from one elimination, or one by one."""

import numpy as np

from surecut.estimator.graph import State
from surecut.estimator.observability import Undetermined
from surecut.estimator.track_gate import Gate, TrackGate
from surecut.factors import keys

POSE = keys.keyframe(3)


def test_joint_of_a_pose_with_each_of_several_landmarks():
    square = np.random.default_rng(1).normal(size=(15, 15))
    asked = []

    def joint(wanted):
        asked.append(list(wanted))
        if keys.landmark(9) in wanted:
            raise Undetermined(keys.landmark(9))
        own = [np.arange(6), *(6 + 3 * keys.index(key) + np.arange(3) for key in wanted[1:])]
        return (square @ square.T)[np.ix_(np.concatenate(own), np.concatenate(own))]

    gate = TrackGate(State(), Gate())
    gate.joint_covariance = joint
    landmarks = [keys.landmark(i) for i in (0, 2, 1)]
    together = gate._joints(POSE, landmarks)
    assert asked == [[POSE, *landmarks]]
    for landmark, found in zip(landmarks, together, strict=True):
        np.testing.assert_array_equal(found, joint([POSE, landmark]))

    one_by_one = gate._joints(POSE, [*landmarks, keys.landmark(9)])
    assert one_by_one[3] is None
    for a, b in zip(together, one_by_one, strict=False):
        np.testing.assert_array_equal(a, b)
