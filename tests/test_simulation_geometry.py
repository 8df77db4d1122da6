"""Rendered pixels against the truth that goes with them."""

from dataclasses import replace

import numpy as np
import pytest

from surecut.factors.camera import CameraModel
from surecut.simulation.page import PrintedMarker
from surecut.simulation.render_board import board_stage, render_light, render_view
from surecut.simulation.rigid import inverse, looking, rigid, transform
from surecut.simulation.scenario import Light
from surecut.simulation.sensor import directions, project, ray_grid
from surecut.simulation.session import prepare

from .simulation_helpers import edge_corners, small


def camera(focal: float, width: int, height: int, d=(0, 0, 0, 0, 0)) -> CameraModel:
    k = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1.0]])
    return CameraModel("m_left", width, height, k, "plumb_bob", np.array(d, dtype=float), np.eye(3), None)


FACING = np.diag([1.0, -1.0, -1.0, 1.0])
"""f_T_camera turned to look at the page, upright."""


@pytest.fixture(scope="module")
def page():
    marker = PrintedMarker(5, 5, (0.03, -0.02), 0.075, 0.1)
    stage = board_stage([marker])
    return marker, stage.view({"page": np.eye(4), "wall": np.eye(4)})


@pytest.mark.parametrize("d", [(0, 0, 0, 0, 0), (-0.25, 0.08, 0.001, -0.002, 0.0)])
def test_corners_lie_where_they_are_projected(page, d):
    marker, view = page
    lens = camera(1000.0, 900, 700, d)
    f_T_camera = rigid(None, (0.05, 0.02, 0.7)) @ FACING @ rigid((0.25, -0.3, 0.1)) @ rigid(None, (0, 0, -0.1))
    expected = project(lens, transform(inverse(f_T_camera), marker.corners_m()))
    image = render_light(view, ray_grid(lens), lambda _: f_T_camera)
    assert np.abs(edge_corners(image, expected, lens) - expected).max() < 0.1


def test_motion_blur_is_centred_on_the_stamp(page):
    marker, view = page
    lens = camera(600.0, 500, 400)
    f_T_camera = rigid(None, (0.0, 0.0, 0.6)) @ FACING

    def pose(time_s: float):
        return f_T_camera @ rigid((0.0, 0.5 * time_s, 0.3 * time_s), (0.3 * time_s, 0, 0))

    expected = project(lens, transform(inverse(f_T_camera), marker.corners_m()))
    blurred = render_light(view, ray_grid(lens), pose, 0.008)
    assert np.abs(edge_corners(blurred, expected, lens) - expected).max() < 0.1


def test_rays_and_projection_are_inverse():
    lens = camera(300.0, 320, 240, (-0.3, 0.1, 0.002, -0.001, 0.01))
    pixels = np.random.default_rng(0).uniform([0, 0], [319, 239], (200, 2))
    assert np.abs(project(lens, 2.5 * directions(lens, pixels)) - pixels).max() < 1e-4


def test_brightness_is_linear_in_gain_and_clipped(page):
    _, view = page
    lens = camera(100.0, 60, 40)
    pose = rigid(None, (0, 0, 0.6)) @ FACING
    quiet = Light(read_noise=0.0, full_well_electrons=1e9, gamma=1.0, vignetting=0.0)
    low = render_view(view, lens, pose, quiet, gain=0.1).astype(float)
    high = render_view(view, lens, pose, quiet, gain=0.2).astype(float)
    assert np.abs(high - 2 * low).max() <= 2.0
    assert render_view(view, lens, pose, quiet, gain=1e3).min() == 255


@pytest.fixture(scope="module")
def session():
    return prepare(small(mobile={"width": 720, "height": 480, "focal_px": 540.0, "rate_hz": 10.0}), 3)


def test_board_in_the_cell_lies_where_the_truth_says(session):
    lens = session.rig.truth.cameras["m_left"]
    w_T_m = session.trajectory.pose(0.05)
    image = render_light(session.still_view, ray_grid(lens), lambda _: w_T_m)
    m_T_f = inverse(w_T_m) @ session.motion.page(0.05)
    for marker in session.rig.truth.markers:
        expected = project(lens, transform(m_T_f, marker.corners_m()))
        assert np.abs(edge_corners(image, expected, lens) - expected).max() < 0.1


def test_true_mount_holds_between_page_and_kinect(session):
    f_T_b = inverse(session.motion.page(0.0)) @ session.motion.kinect(0.0)
    assert np.allclose(f_T_b, session.rig.truth.f_T_b, atol=1e-9)


def test_clicks_halve_the_visible_outline(session):
    """Across the pipe, the two silhouette rays lie evenly about the ray through the true point."""
    assert session.picks
    pipe = session.stage.body_index("pipe")
    lens = session.rig.truth.cameras["m_left"]
    for frame, clicks in session.picks.items():
        w_T_m = session.camera_pose("m_left", frame / session.scenario.mobile.rate_hz)
        for click in (c for c in clicks if c.camera == "m_left"):
            place = session.cell.points[click.point_id][1]
            ends = [place - 0.01 * session.cell.pipe.axis, place, place + 0.01 * session.cell.pipe.axis]
            low, centre, high = project(lens, transform(inverse(w_T_m), ends))
            across = np.array([-(high - low)[1], (high - low)[0]]) / np.linalg.norm(high - low)
            steps = np.linspace(-60, 60, 2401)
            rays = directions(lens, centre + steps[:, None] * across) @ w_T_m[:3, :3].T
            rays = np.concatenate([np.broadcast_to(w_T_m[:3, 3], rays.shape), rays], axis=1).astype(np.float32)
            on_pipe = steps[session.still_view.cast(rays).body == pipe]
            assert abs(on_pipe[0] + on_pipe[-1]) / 2 < 0.02 * (on_pipe[-1] - on_pipe[0])
            assert np.linalg.norm(np.subtract(click.uv_px, centre)) < 5 * session.scenario.picks.sigma_px


def test_panel_hides_the_pipe_from_both_kinect_cameras(session):
    pipe = session.stage.body_index("pipe")
    for name in ("b_depth", "b_rgb"):
        lens, pose = session.rig.truth.cameras[name], session.camera_pose(name, 0.0)
        rays = ray_grid(lens).directions[0] @ pose[:3, :3].T
        rays = np.concatenate([np.broadcast_to(pose[:3, 3], rays.shape), rays], axis=1).astype(np.float32)
        assert not np.any(session.still_view.cast(rays).body == pipe)


def test_orientation_of_a_looking_camera():
    pose = looking((1, 2, 3), 0.0, 0.0)
    assert np.allclose(pose[:3, 2], [0, 1, 0])
    assert np.allclose(pose[:3, 1], [0, 0, -1])
    assert np.allclose(looking((0, 0, 0), np.pi / 2, 0.0)[:3, 2], [-1, 0, 0])
    assert looking((0, 0, 0), 0.0, 0.3)[2, 2] > 0


def test_higher_resolution_shows_the_same_scene(page):
    _, view = page
    pose = rigid(None, (0, 0, 0.6)) @ FACING
    coarse = camera(150.0, 100, 80)
    k = coarse.K * 4
    k[:2, 2] += 1.5
    k[2, 2] = 1
    fine = replace(coarse, K=k, width=400, height=320)
    small_image = render_light(view, ray_grid(coarse), lambda _: pose)
    large_image = render_light(view, ray_grid(fine), lambda _: pose).reshape(80, 4, 100, 4).mean(axis=(1, 3))
    assert np.corrcoef(small_image.ravel(), large_image.ravel())[0, 1] > 0.99
    assert abs(small_image.mean() - large_image.mean()) < 0.01 * large_image.mean()
