"""Frames between keyframes: placed by the map, bridged where they saw nothing."""

import gtsam
import numpy as np
import pytest

from surecut.estimator.graph import State
from surecut.estimator.odometry import FramePose, Odometry, OdometrySettings, SeenTracks
from surecut.estimator.resection import Map, resected
from surecut.estimator.trajectory import trajectory, with_covariances
from surecut.factors import keys

K = (250.0, 252.0, 0.0, 180.0, 120.0, 0.01, -0.002, 1e-4, -2e-4)


def scene(rng: np.random.Generator, n: int = 60) -> tuple[gtsam.Values, gtsam.Cal3DS2]:
    values = gtsam.Values()
    calibration = gtsam.Cal3DS2(*K)
    values.insert(keys.intrinsics("m_left"), calibration)
    for i, point in enumerate(rng.uniform([-1.0, -0.7, 1.2], [1.0, 0.7, 3.0], (n, 3))):
        values.insert(keys.landmark(i), point)
    return values, calibration


def seen_from(values: gtsam.Values, calibration: gtsam.Cal3DS2, pose: gtsam.Pose3, n: int = 60) -> SeenTracks:
    camera = gtsam.PinholeCameraCal3DS2(pose, calibration)
    px = [camera.project(values.atPoint3(keys.landmark(i))) for i in range(n)]
    return SeenTracks(np.arange(n), np.array(px, np.float32))


POSE = gtsam.Pose3(gtsam.Rot3.RzRyRx(0.05, -0.1, 0.03), np.array([0.08, -0.03, 0.1]))


def test_resection_finds_the_pose_that_made_the_pixels_and_leaves_out_strays() -> None:
    values, calibration = scene(np.random.default_rng(1))
    tracks = seen_from(values, calibration, POSE)
    tracks.left_px[:9] += 25.0
    guess = POSE.retract(np.array([0.01, -0.02, 0.01, 0.02, 0.02, -0.03]))
    found, held = resected(np.array([guess.matrix(), POSE.matrix()]), [tracks, tracks], Map.of(values, tracks.ids))
    assert held.all()
    for pose in found:
        assert np.abs(gtsam.Pose3.Logmap(POSE.between(gtsam.Pose3(pose)))).max() < 1e-4


def test_too_few_landmarks_hold_nothing() -> None:
    values, calibration = scene(np.random.default_rng(2))
    tracks = seen_from(values, calibration, POSE)
    few = SeenTracks(tracks.ids[:8], tracks.left_px[:8])
    unknown = SeenTracks(tracks.ids + 1000, tracks.left_px)
    guesses = np.tile(gtsam.Pose3().matrix(), (3, 1, 1))
    found, held = resected(guesses, [few, unknown, tracks], Map.of(values, np.r_[tracks.ids, unknown.ids]))
    assert held.tolist() == [False, False, True]
    assert (found[:2] == guesses[:2]).all()
    assert not resected(guesses[:2], [unknown, unknown], Map.of(values, unknown.ids))[1].any()


def test_frames_lie_on_the_map_and_blind_ones_between_their_neighbours() -> None:
    values, calibration = scene(np.random.default_rng(3))
    values.insert(keys.keyframe(0), gtsam.Pose3())
    values.insert(keys.keyframe(1), gtsam.Pose3(gtsam.Rot3(), np.array([0.4, 0.0, 0.0])))
    odometry = Odometry(State(), OdometrySettings(), 1.5)
    odometry.keyframe_stamps += [0, 400]
    drifted = POSE.compose(gtsam.Pose3(gtsam.Rot3.Ry(0.02), np.array([0.02, 0.01, 0.0]))).matrix()
    odometry.frames += [
        FramePose(0, 0, np.eye(4)),
        FramePose(100, 0, drifted, seen_from(values, calibration, POSE)),
        FramePose(250, 0, drifted),
        FramePose(400, 1, np.eye(4)),
        FramePose(500, 1, np.eye(4)),
    ]
    path = with_covariances(trajectory(odometry, values), dict.fromkeys(odometry.keyframe_stamps, np.eye(6)))
    assert [p.stamp_ns for p in path] == [0, 100, 250, 400, 500]
    assert [p.covariance is not None for p in path] == [True, False, False, True, False]
    assert path[1].matrix == pytest.approx(POSE.matrix(), abs=1e-4)
    half = 0.5 * (path[1].matrix[:3, 3] + path[3].matrix[:3, 3])
    assert path[2].matrix[:3, 3] == pytest.approx(half, abs=0.01)
    assert path[4].matrix == pytest.approx(path[3].matrix)
