"""What a wrong calibration does to tracks, to first order, and that gates hold the tracks of a turning camera."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from surecut.factors.camera import CameraModel
from surecut.frontends.stereo.calibration_error import of_calibration
from surecut.frontends.stereo.geometry import StereoGeometry, inverse, project, transform
from surecut.frontends.stereo.motion import estimate_motion
from surecut.frontends.stereo.settings import StereoSettings

FOCAL, CENTRE = 0.003, 1.0
SETTINGS = StereoSettings(focal_sigma_rel=FOCAL, centre_sigma_px=CENTRE)


def geometry(focal=270.0, cx=180.0, cy=120.0):
    K = np.array([[focal, 0.0, cx], [0.0, focal, cy], [0.0, 0.0, 1.0]])
    camera = CameraModel("m_left", 360, 240, K, "plumb_bob", np.zeros(5), np.eye(3), None)
    left_T_right = np.eye(4)
    left_T_right[0, 3] = 0.15
    return StereoGeometry(camera, replace(camera, name="m_right", baseline_m=0.15), left_T_right)


def moved(turn_deg, shift_m):
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("xyz", turn_deg, degrees=True).as_matrix()
    pose[:3, 3] = shift_m
    return pose


def points(n=40):
    rng = np.random.default_rng(4)
    return np.column_stack([rng.uniform(-0.6, 0.6, n), rng.uniform(-0.4, 0.4, n), rng.uniform(1.2, 3.0, n)])


def seen_with(rig, nominal, pixels, depths, pose):
    """Where a point that the reference shows at `pixels` lies in this image, for a calibration."""
    camera = rig.left
    rays = np.column_stack([(pixels - (camera.cx, camera.cy)) / camera.fx, np.ones(len(pixels))])
    return project(transform(inverse(pose), rays * depths[:, None]), camera)


def test_a_camera_that_stands_still_sees_nothing_of_it():
    rig, p = geometry(), points()
    px = rig.project(p)
    np.testing.assert_allclose(of_calibration(p, px, np.eye(4), rig, SETTINGS), 0.0, atol=1e-12)


@pytest.mark.parametrize(
    "pose", [moved((0, 15, 0), (0, 0, 0)), moved((3, -8, 20), (0.1, 0.05, 0.2))], ids=["turn", "all"]
)
def test_it_is_the_derivative_of_the_pixels(pose):
    rig, p = geometry(), points()
    pixels = project(p, rig.left)
    px = rig.project(transform(inverse(pose), p))
    covariance = of_calibration(p, px, pose, rig, SETTINGS)
    step, columns = 1e-4, []
    for sigma, changed in (
        (FOCAL * 270.0, geometry(focal=270.0 + step)),
        (CENTRE, geometry(cx=180.0 + step)),
        (CENTRE, geometry(cy=120.0 + step)),
    ):
        there = seen_with(changed, rig, pixels, p[:, 2], pose)
        columns.append(sigma * (there - px[:, :2]) / step)
    by = np.stack(columns, axis=2)
    np.testing.assert_allclose(covariance[:, :2, :2], by @ by.transpose(0, 2, 1), atol=2e-3)
    np.testing.assert_allclose(covariance[:, 2:, :2], covariance[:, :2, :2])


def test_tracks_of_a_turning_camera_are_within_their_gate_with_a_focal_length_two_sigma_off():
    true, nominal, pose = geometry(focal=270.0 * (1 - 2 * FOCAL)), geometry(), moved((0, 30, 0), (0.05, 0, 0))
    p = points(200)
    reference, px = true.project(p), true.project(transform(inverse(pose), p))
    inside = (np.abs(px[:, :2] - (180, 120)) < (175, 115)).all(axis=1)
    depth = 270.0 * 0.15 / (reference[:, 0] - reference[:, 2])
    believed = np.column_stack([(reference[:, :2] - (180, 120)) / 270.0, np.ones(len(p))]) * depth[:, None]
    believed, px = believed[inside], px[inside]
    covariance = np.broadcast_to(0.05**2 * np.eye(4), (len(px), 4, 4))
    points_covariance = np.broadcast_to(1e-8 * np.eye(3), (len(px), 3, 3))

    rng = np.random.default_rng(1)
    px = px + 0.05 * rng.normal(size=px.shape)

    def kept(shared):
        motion = estimate_motion(believed, points_covariance, px, covariance, [pose], nominal, 12, shared)
        assert motion is not None
        return motion.inliers.mean()

    assert kept(of_calibration(believed, px, pose, nominal, SETTINGS)) == 1.0
    assert kept(None) < 1.0
