"""Cylinders from points: known geometry, real clouds, and things that are no cylinder."""

import json

import numpy as np
import pytest
from realdata import real_data

from surecut.factors.measurements import CylinderSighting, Rejection
from surecut.frontends.cloud.noise import depth_noise
from surecut.frontends.open3d_loader import load_open3d
from surecut.frontends.pipe.cylinder import CylinderFit, fit_cylinder
from surecut.frontends.pipe.depth_cylinder import PredictedPipe, cylinder_near
from surecut.frontends.pipe.segment import kinect_cylinder

AXIS, POINT, RADIUS = np.array([0.1, 0.98, -0.17]), np.array([0.1, 0.0, 1.2]), 0.045
CONE_OR_TIN = {("mosd/learn34.pcd", 31)}
"""Listed as unstable; the halves of this pot's wall agree to 1.4 mm here, with the radius of the same pot elsewhere."""
SHORT_INSIDE = {("mosd/learn44.pcd", 41)}
"""The inside of a mug, 6 cm long: its upper and lower half lean 18 degrees apart, so it is refused."""


def visible_surface(rng, count=3000, noise=0.0015, half_arc=1.2):
    axis = AXIS / np.linalg.norm(AXIS)
    towards = -POINT + (POINT @ axis) * axis
    first = towards / np.linalg.norm(towards)
    angle, along = rng.uniform(-half_arc, half_arc, count), rng.uniform(-0.2, 0.2, count)
    normal = np.cos(angle)[:, None] * first + np.sin(angle)[:, None] * np.cross(axis, first)
    points = POINT + along[:, None] * axis + RADIUS * normal
    return points + rng.normal(0, noise, (count, 1)) * points / np.linalg.norm(points, axis=1, keepdims=True)


def parameters(fit):
    """Errors (two shifts, two tilts, radius) in the fit's own coordinates."""
    axis = AXIS / np.linalg.norm(AXIS) * np.sign(AXIS @ fit.axis)
    middle = 0.5 * (fit.point_a_m + fit.point_b_m)
    foot = POINT + ((middle - POINT) @ axis) * axis
    towards = middle - (middle @ fit.axis) * fit.axis
    first = towards / np.linalg.norm(towards)
    across = np.array([first, np.cross(fit.axis, first)])
    return np.concatenate((across @ (foot - middle), across @ (axis - fit.axis), [RADIUS - fit.radius_m]))


def test_recovers_a_cylinder_with_an_honest_covariance():
    scores = []
    for seed in range(12):
        points = visible_surface(np.random.default_rng(seed))
        fit = fit_cylinder(points, np.full(len(points), 0.0015))
        assert isinstance(fit, CylinderFit)
        error = parameters(fit)
        assert abs(error[4]) < 0.0015
        scores.append(error @ np.linalg.solve(fit.covariance, error) / 5)
    assert 0.1 < np.mean(scores) < 2.5


def test_radius_and_distance_along_the_view_are_correlated():
    points = visible_surface(np.random.default_rng(1), half_arc=0.6)
    fit = fit_cylinder(points, np.full(len(points), 0.0015))
    assert isinstance(fit, CylinderFit)
    sigma = np.sqrt(np.diag(fit.covariance))
    assert fit.covariance[0, 4] / (sigma[0] * sigma[4]) > 0.8
    information = fit.information
    slide = np.concatenate((fit.axis, np.zeros(4)))
    np.testing.assert_allclose(information @ slide, 0, atol=1e-6 * np.abs(information).max())


def test_a_neighbour_and_a_wall_do_not_capture_the_fit():
    rng = np.random.default_rng(2)
    pipe = visible_surface(rng)
    neighbour = visible_surface(rng, 1200) + np.array([0.14, 0.01, 0.05])
    wall = np.column_stack((rng.uniform(-0.2, 0.4, 800), rng.uniform(-0.2, 0.2, 800), np.full(800, 1.4)))
    points = np.vstack((pipe, neighbour, wall))
    fit = fit_cylinder(points, np.full(len(points), 0.0015), radius_prior_m=(0.045, 0.003))
    assert isinstance(fit, CylinderFit)
    assert np.abs(parameters(fit)[[0, 1, 4]]).max() < 0.004


def elbow(rng, count=900, bend_m=0.09):
    """A quarter bend at the end of the pipe, the half that the camera sees."""
    axis = AXIS / np.linalg.norm(AXIS)
    side = np.cross(axis, POINT / np.linalg.norm(POINT))
    side /= np.linalg.norm(side)
    turn, round_ = rng.uniform(0, np.pi / 2, count)[:, None], rng.uniform(0, 2 * np.pi, count)[:, None]
    centre = POINT + 0.2 * axis + bend_m * side
    outwards = -np.cos(turn) * side + np.sin(turn) * axis
    normal = np.cos(round_) * outwards + np.sin(round_) * np.cross(axis, side)
    points = centre + bend_m * outwards + RADIUS * normal
    return points[(normal * points).sum(axis=1) < 0] + rng.normal(0, 0.0015, 3)


def flange(rng, count=500, at_m=0.05):
    """A collar of 1.4 radii, 3 cm long: what of it the camera sees."""
    axis = AXIS / np.linalg.norm(AXIS)
    points = visible_surface(rng, count)
    along = (points - POINT) @ axis
    outwards = points - POINT - along[:, None] * axis
    return POINT + (at_m + 0.03 * rng.uniform(-0.5, 0.5, (count, 1))) * axis + 1.4 * outwards


@pytest.mark.parametrize("what", ["elbow", "flange", "nearly parallel neighbour"])
def test_what_is_normal_beside_a_pipe_does_not_bend_it(what):
    rng = np.random.default_rng(5)
    pipe, axis = visible_surface(rng), AXIS / np.linalg.norm(AXIS)
    if what == "elbow":
        other = elbow(rng)
    elif what == "flange":
        other = flange(rng)
    else:  # two degrees off, its wall 6 cm beside
        other = visible_surface(rng, 2000)
        lean = np.deg2rad(2.0) * ((other - POINT) @ axis)[:, None] * np.array([1.0, 0.0, 0.0])
        other = other + np.array([2 * RADIUS + 0.06, 0.0, 0.02]) + lean
    off = np.array([0.006, 0.0, -0.006])
    predicted = PredictedPipe(POINT - 0.3 * axis + off, POINT + 0.3 * axis + off, RADIUS + 0.003, 0.01)
    found = cylinder_near(1, "pipe0", np.vstack((pipe, other)), "kinect_v1", predicted)
    assert isinstance(found, CylinderSighting), found
    way = found.point_b_m - found.point_a_m
    assert found.radius_m == pytest.approx(RADIUS, abs=0.003)
    assert abs(way @ axis) > np.cos(np.deg2rad(1.0)) * np.linalg.norm(way)
    assert np.linalg.norm(np.cross(found.point_a_m - POINT, axis)) < 0.004


def test_sphere_plane_and_noise_are_refused():
    rng = np.random.default_rng(3)
    direction = rng.normal(size=(2500, 3))
    direction = direction[direction[:, 2] < -0.2]
    sphere = np.array([0, 0, 1.0]) + 0.09 * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    plane = np.column_stack((rng.uniform(-0.2, 0.2, (2000, 2)), 1.0 + rng.normal(0, 0.001, 2000)))
    cloud = rng.uniform(-0.2, 0.2, (2000, 3)) + np.array([0, 0, 1.0])
    for points in (sphere, plane, cloud, sphere[:20]):
        fit = fit_cylinder(points, np.full(len(points), 0.0012))
        assert isinstance(fit, Rejection), fit
        assert fit.reason


def test_real_clouds_against_measured_cylinders():
    folder = real_data("clouds")
    golden = json.loads((folder / "golden.json").read_text())["mosd"]
    open3d, noise = load_open3d(), depth_noise("kinect_v1")
    for name, entry in golden.items():
        cloud = open3d.t.io.read_point_cloud(str(folder / name))
        points, labels = cloud.point.positions.numpy().astype(float), cloud.point["label"].numpy()[:, 0]
        good = np.isfinite(points).all(axis=1)
        for known in entry["cylinders"]:
            if (name, known["label"]) in SHORT_INSIDE:
                continue
            part = points[good & (labels == known["label"])]
            fit = fit_cylinder(part, noise.axial(part[:, 2], 0.0))
            assert isinstance(fit, CylinderFit), (name, known["label"], fit)
            assert fit.radius_m == pytest.approx(known["radius_m"], abs=0.0015)
            cosine = abs(fit.axis @ np.array(known["axis"])) / np.linalg.norm(known["axis"])
            assert np.arccos(min(cosine, 1.0)) < np.deg2rad(1.0)
            assert fit.rms_m < known["rms_m"] + 0.0004
            assert abs(fit.radius_m - known["radius_m"]) < 4 * np.sqrt(fit.covariance[4, 4]) + known["spread_radius_m"]
        for label in entry["no_stable_cylinder"]:
            if (name, label) in CONE_OR_TIN:
                continue
            part = points[good & (labels == label)]
            assert isinstance(fit_cylinder(part, noise.axial(part[:, 2], 0.0)), Rejection), (name, label)


def test_the_pipe_under_a_pick_in_a_depth_image():
    from cylinder_scene import Cylinder, camera_model, hit

    camera = camera_model(320, 240, 290.0)
    pipe = Cylinder(POINT, AXIS, RADIUS)
    v, u = np.mgrid[0:240, 0:320]
    rays = np.dstack(((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape))).reshape(-1, 3)
    depth = np.minimum(hit(pipe, rays)[0], 2.0).reshape(240, 320)
    rng = np.random.default_rng(0)
    depth = (depth + rng.normal(size=depth.shape) * depth_noise("kinect_v1").axial(depth, 0.0)).astype(np.float32)
    pick = camera.K @ POINT
    found = kinect_cylinder(5, "pipe0", depth, camera, "kinect_v1", pick[:2] / pick[2])
    assert isinstance(found, CylinderSighting), found
    axis = (found.point_b_m - found.point_a_m) / np.linalg.norm(found.point_b_m - found.point_a_m)
    assert np.linalg.norm(np.cross(found.point_a_m - POINT, axis)) < 0.006
    assert found.radius_m == pytest.approx(RADIUS, abs=0.004)
    nothing = kinect_cylinder(5, "pipe0", np.full_like(depth, np.nan), camera, "kinect_v1", np.array([160.0, 120.0]))
    assert isinstance(nothing, Rejection)
