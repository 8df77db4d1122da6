"""A near feature that wanders holds the motion by itself, and its own residuals hide it: its weight has to go."""

import gtsam
import numpy as np
import pytest
from scipy.stats import f as fisher

from surecut.estimator.batch import solve
from surecut.estimator.graph import FactorLog, Record, Update
from surecut.estimator.linearised import linearise
from surecut.estimator.odometry import FAMILY
from surecut.estimator.track_weights import spread_of_variances, track_weights
from surecut.factors import keys
from surecut.factors.links import gauge_prior
from surecut.factors.noise import gaussian, robust, sigmas
from surecut.factors.projection import mobile_projection

SIGMA_PX, ROBUST, VIEWS, BASELINE_M = 0.05, 2.0, 8, 0.15
LENS = gtsam.Cal3DS2(270.0, 270.0, 0.0, 179.5, 119.5, 0.0, 0.0, 0.0, 0.0)


def scene(wander_px, seed=0):
    """Eighty points 2 to 5 m away and a near one, that slides upwards by so much per keyframe; the camera drifts."""
    rng = np.random.default_rng(seed)
    wall = np.column_stack([rng.uniform(-1.5, 1.5, 80), rng.uniform(-1.0, 1.0, 80), rng.uniform(2.0, 5.0, 80)])
    points = np.vstack([[0.05, 0.1, 0.6], wall])
    truth = [gtsam.Pose3(gtsam.Rot3(), np.array([0.02 * k, 0.01 * k, 0.0])) for k in range(VIEWS)]
    right = gtsam.Pose3(gtsam.Rot3(), np.array([BASELINE_M, 0.0, 0.0]))
    update = Update()
    update.guess(keys.extrinsics("m_right"), right)
    held = gtsam.PriorFactorPose3(keys.extrinsics("m_right"), right, sigmas([1e-7] * 6))
    update.add(held, Record("calibration priors", "right", 0, "right", rejectable=False))
    for camera in ("m_left", "m_right"):
        update.guess(keys.intrinsics(camera), LENS)
        known = gtsam.PriorFactorCal3DS2(keys.intrinsics(camera), LENS, sigmas([1e-7] * 9))
        update.add(known, Record("calibration priors", camera, 0, camera, rejectable=False))
    update.add(gauge_prior(keys.keyframe(0)), Record("gauge", "gauge", 0, "origin", rejectable=False))
    for k, pose in enumerate(truth):
        update.guess(keys.keyframe(k), pose)
    for i, point in enumerate(points):
        update.guess(keys.landmark(i), point)
        for k, pose in enumerate(truth):
            for camera, o_T_c in (("m_left", pose), ("m_right", pose.compose(right))):
                px = gtsam.PinholeCameraCal3DS2(o_T_c, LENS).project(point) + rng.normal(0, SIGMA_PX, 2)
                px = px + (i == 0) * np.array([0.0, wander_px * k])
                model = robust(gaussian(SIGMA_PX**2 * np.eye(2)), ROBUST)
                record = Record(FAMILY, "tracks", 10**9 * k // 4, f"track {i} in {camera}", camera=camera)
                update.add(mobile_projection(camera, px, model, keys.keyframe(k), keys.landmark(i)), record)
    log = FactorLog()
    log.append(update)
    return log, update.values, truth


def weights_of(log, values):
    """By track."""
    at = linearise(log, set(), values, ROBUST)
    found = track_weights(at.active, at.system, FAMILY).by_position
    return {at.active[p][2].what.split(" in ")[0]: w for p, w in found.items()}


def test_a_near_feature_that_wanders_counts_for_little():
    log, start, truth = scene(wander_px=0.25)
    solution = solve(log, start, ROBUST)
    weights = weights_of(log, gtsam.LevenbergMarquardtOptimizer(log.graph(), start).optimize())
    assert weights["track 0"] < 0.2
    assert np.median(list(weights.values())) > 0.8
    last = solution.values.atPose3(keys.keyframe(VIEWS - 1)).translation() - truth[-1].translation()
    naive = gtsam.LevenbergMarquardtOptimizer(log.graph(), start).optimize().atPose3(keys.keyframe(VIEWS - 1))
    off = np.linalg.norm(naive.translation() - truth[-1].translation())
    assert np.linalg.norm(last) < 0.5 * off


def test_tracks_that_are_alike_keep_their_weights():
    log, start, _ = scene(wander_px=0.0)
    weights = weights_of(log, gtsam.LevenbergMarquardtOptimizer(log.graph(), start).optimize())
    assert all(w > 0.5 for w in weights.values())


@pytest.mark.parametrize("width", [3.0, 9.0])
def test_the_spread_of_variances_is_found(width):
    rng = np.random.default_rng(1)
    dof = rng.integers(3, 40, 2000).astype(float)
    chi2 = 0.6 * dof * fisher.rvs(dof, width, random_state=rng)
    found, scale = spread_of_variances(chi2, dof)
    assert 0.6 * width < found < 1.7 * width
    assert scale == pytest.approx(0.6, rel=0.1)
