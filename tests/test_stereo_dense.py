"""Dense depth of a region against the rendered room's depth, rectified and not."""

import cv2
import numpy as np
from stereo_scene import HEIGHT, WIDTH, Room, camera, expose, left_T_right, pose

from surecut.frontends.stereo.dense import dense_points

ROI = (100, 60, 160, 120)


def depth_errors(points, pixels, depth):
    columns, rows = np.rint(pixels).astype(int).T
    return points[:, 2] - depth[rows, columns]


def check(points, pixels, sigma, depth, region):
    assert len(points) > 0.8 * region[2] * region[3]
    assert np.allclose(pixels[:, 0], camera().fx * points[:, 0] / points[:, 2] + camera().cx)
    error = depth_errors(points, pixels, depth)
    assert np.abs(np.median(error)) < 0.02
    assert np.median(np.abs(error)) < 0.05
    assert 0.4 < 1.4826 * np.median(np.abs(error / sigma)) < 2.0


def test_depth_of_a_region():
    rng = np.random.default_rng(0)
    left, right, depth = Room().pair(pose(0.3, 0.1, 0, (0, 0, -0.5)))
    left, right = expose(left, rng), expose(right, rng)
    points, pixels, sigma = dense_points(left, right, camera(), camera("m_right"), left_T_right(), ROI)
    check(points, pixels, sigma, depth, ROI)
    assert pixels.min(axis=0).tolist() >= [ROI[0], ROI[1]]
    assert (pixels.max(axis=0) < [ROI[0] + ROI[2], ROI[1] + ROI[3]]).all()


def test_a_right_camera_that_is_turned_is_rectified():
    """The right camera looks 2 degrees inwards, 1 up and is rolled by 1: with that calibration depth stays right."""
    rng = np.random.default_rng(0)
    o_T_m = pose(0.3, 0.1, 0, (0, 0, -0.5))
    turned = left_T_right()
    turned[:3, :3] = cv2.Rodrigues(np.deg2rad([1.0, -2.0, 1.0]))[0]
    left, depth = Room().render(o_T_m)
    right = Room().render(o_T_m @ turned)[0]
    points, pixels, sigma = dense_points(
        expose(left, rng), expose(right, rng), camera(), camera("m_right"), turned, ROI
    )
    check(points, pixels, sigma, depth, ROI)


def test_nothing_to_match_gives_nothing():
    blank = np.full((HEIGHT, WIDTH), 128, np.uint8)
    points, pixels, sigma = dense_points(blank, blank, camera(), camera("m_right"), left_T_right(), ROI)
    assert points.shape[1:] == (3,)
    assert len(points) == len(pixels) == len(sigma)
    outside = dense_points(blank, blank, camera(), camera("m_right"), left_T_right(), (400, 300, 50, 50))
    assert [len(part) for part in outside] == [0, 0, 0]
