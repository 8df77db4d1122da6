"""Landmarks that come back into view: taken where the drift can explain them, refused where it cannot."""

import gtsam
import numpy as np
import pytest

from surecut.estimator.bundle import Bundle
from surecut.estimator.engine import Engine
from surecut.estimator.surfaces import lay_on_surfaces
from surecut.factors import keys
from surecut.factors.camera import CameraModel
from surecut.factors.measurements import StereoFrame
from surecut.factors.rig import Rig

K = np.array([[270.0, 0.0, 179.5], [0.0, 270.0, 119.5], [0.0, 0.0, 1.0]])
BASELINE, SIGMA_PX = 0.15, 0.1
STEPS, STEP_M = 36, 0.2


def camera(name, baseline=None):
    return CameraModel(name, 360, 240, K, "none", np.zeros(0), np.eye(3), baseline)


def pixels(points):
    return points[:, :2] / points[:, 2:] * 270.0 + [179.5, 119.5]


def walk(shift_px=0.0):
    """Sideways along a wall and back; landmarks that come back are `shift_px` beside where they are."""
    rng = np.random.default_rng(5)
    wall = np.column_stack([rng.uniform(-2, 6, 500), rng.uniform(-1, 1, 500), rng.uniform(1.8, 2.6, 500)])
    engine = Engine(Rig(), {"m_left": camera("m_left"), "m_right": camera("m_right", BASELINE)}, lay_on_surfaces)
    last_seen: dict[int, int] = {}
    returned: set[int] = set()
    before = 0.0
    for step in range(STEPS):
        x = STEP_M * min(step, STEPS - 1 - step)
        left = pixels(wall - [x, 0, 0])
        right = pixels(wall - [x + BASELINE, 0, 0])
        ids = np.flatnonzero(((left > 5) & (left < [355, 235]) & (right > 5)).all(axis=1))
        returned |= {i for i in ids.tolist() if step - last_seen.get(i, step) > 4}
        last_seen |= dict.fromkeys(ids.tolist(), step)
        off = np.array([[shift_px * (i in returned), 0.0] for i in ids.tolist()])
        covariance = np.tile(SIGMA_PX**2 * np.eye(2), (len(ids), 1, 1))
        motion = np.eye(4)
        motion[0, 3] = x - before + rng.normal(0, 0.002)
        before = x
        noise = rng.normal(0, SIGMA_PX, (2, len(ids), 2))
        frame = StereoFrame(
            (step + 1) * 10**8, True, ids, left[ids] + off + noise[0], covariance, right[ids] + off + noise[1],
            covariance, motion, len(ids),
        )  # fmt: skip
        engine.add(Bundle(frame.stamp_ns, frame))
    engine.flush()
    return engine


def refused(engine):
    return [r for r in engine.rejected if r.reason.startswith("seen again")]


def error_m(engine, keyframe):
    pose = engine.state.pose(keys.keyframe(keyframe))
    assert isinstance(pose, gtsam.Pose3)
    return float(np.linalg.norm(pose.translation() - [STEP_M * min(keyframe, STEPS - 1 - keyframe), 0.0, 0.0]))


def test_landmarks_that_come_back_close_the_loop():
    engine = walk()
    assert not refused(engine)
    assert max(engine.odometry.observations.values()) > 8
    assert error_m(engine, STEPS - 1) < 0.004


@pytest.mark.parametrize("shift_px", [12.0, 60.0])
def test_a_false_closure_is_refused(shift_px):
    """One brick further along the wall looks the same: all that comes back is shifted alike."""
    engine = walk(shift_px)
    found = refused(engine)
    assert len(found) > 30
    assert all(r.value > r.limit for r in found)
    # Landmarks that have stayed in view hold the camera so far.
    assert error_m(engine, 28) < 0.01
