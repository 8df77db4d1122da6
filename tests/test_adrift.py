"""The lens is covered for three seconds: the map goes on in the same {o}, and knows how little it knows until it is
found again."""

import numpy as np
from scipy.spatial.transform import Rotation

from surecut.estimator.bundle import Bundle
from surecut.estimator.engine import Engine
from surecut.estimator.surfaces import lay_on_surfaces
from surecut.factors import keys
from surecut.factors.camera import CameraModel
from surecut.factors.measurements import StereoFrame
from surecut.factors.rig import Rig

K = np.array([[270.0, 0.0, 179.5], [0.0, 270.0, 119.5], [0.0, 0.0, 1.0]])
BASELINE, SIGMA_PX = 0.15, 0.1
BEFORE, APART, BACK = 6, 12, 20
"""Keyframes up to the gap, up to the return, and in all."""


def camera(name, baseline=None):
    return CameraModel(name, 360, 240, K, "none", np.zeros(0), np.eye(3), baseline)


def true_pose(step):
    """Along the wall; during the gap 0.9 m on and half a radian round; then slowly back to where it began."""
    pose = np.eye(4)
    if step < BEFORE:
        pose[0, 3] = 0.05 * step
        return pose
    share = max(0.0, 1 - (step - BEFORE) / (APART - BEFORE))
    pose[:3, :3] = Rotation.from_rotvec([0, 0.5 * share, 0]).as_matrix()
    pose[0, 3] = 0.25 + 0.9 * share
    return pose


def seen(points, pose, rng):
    here = (points - pose[:3, 3]) @ pose[:3, :3]
    left, right = ((here[:, :2] - [b, 0]) / here[:, 2:] * 270.0 + [179.5, 119.5] for b in (0.0, BASELINE))
    inside = ((left > 5) & (left < [355, 235]) & (right > 5) & (right < [355, 235])).all(axis=1) & (here[:, 2] > 0.3)
    ids = np.flatnonzero(inside)
    noise = rng.normal(0, SIGMA_PX, (2, len(ids), 2))
    return ids, left[ids] + noise[0], right[ids] + noise[1]


def run(until):
    rng = np.random.default_rng(4)
    wall = np.column_stack([rng.uniform(-3, 5, 900), rng.uniform(-1.2, 1.2, 900), rng.uniform(1.8, 2.8, 900)])
    engine = Engine(Rig(), {"m_left": camera("m_left"), "m_right": camera("m_right", BASELINE)}, lay_on_surfaces)
    stamp_ns, last, adrift = 0, np.eye(4), []
    for step in range(until):
        pose = true_pose(step)
        if step == BEFORE:
            for _ in range(30):
                stamp_ns += 10**8
                none = np.zeros((0, 2))
                dark = StereoFrame(
                    stamp_ns, False, np.zeros(0, np.int64), none, np.zeros((0, 2, 2)), none, np.zeros((0, 2, 2)),
                    np.eye(4), 0, lost=True,
                )  # fmt: skip
                engine.add(Bundle(stamp_ns, dark))
        stamp_ns += 10**8
        ids, left, right = seen(wall, pose, rng)
        # Until it is back, the front end knows none of the old landmarks again; then it goes on with both names.
        names = ids + (1000 if step >= BEFORE else 0)
        if step >= APART:
            again = seen(wall, pose, rng)
            names = np.concatenate((names, again[0]))
            left, right = np.concatenate((left, again[1])), np.concatenate((right, again[2]))
        covariance = np.tile(SIGMA_PX**2 * np.eye(2), (len(names), 1, 1))
        motion = np.eye(4) if step == BEFORE else np.linalg.inv(last) @ pose
        lost, last = step == BEFORE, pose
        frame = StereoFrame(stamp_ns, True, names, left, covariance, right, covariance, motion, len(names), lost=lost)
        engine.add(Bundle(stamp_ns, frame))
        adrift.append(bool(engine.adrift))
    engine.flush()
    return engine, adrift


def errors(engine, step):
    true, found = true_pose(step), engine.state.pose(keys.keyframe(step)).matrix()
    turn = Rotation.from_matrix(true[:3, :3].T @ found[:3, :3]).magnitude()
    return float(np.linalg.norm(true[:3, 3] - found[:3, 3])), float(turn)


def test_a_gap_is_as_uncertain_as_a_hand_is_free():
    engine, adrift = run(APART)
    assert adrift == [False] * BEFORE + [True] * (APART - BEFORE)
    off_m, off_rad = errors(engine, BEFORE)
    assert off_m > 0.5
    key = keys.keyframe(BEFORE)
    sigma = np.sqrt(np.diag(engine.solver.joint_covariance([key])))
    assert off_m < 2.5 * np.linalg.norm(sigma[3:])
    assert off_rad < 2.5 * np.linalg.norm(sigma[:3])
    # What was seen since hangs together as well as ever.
    later = np.linalg.inv(engine.state.pose(key).matrix()) @ engine.state.pose(keys.keyframe(APART - 1)).matrix()
    true = np.linalg.inv(true_pose(BEFORE)) @ true_pose(APART - 1)
    assert np.linalg.norm(later[:3, 3] - true[:3, 3]) < 0.01


def test_landmarks_of_before_bring_the_whole_map_back():
    engine, adrift = run(BACK)
    assert not any(adrift[APART:])
    for step in range(BACK):
        off_m, off_rad = errors(engine, step)
        assert off_m < 0.01
        assert off_rad < 0.005
