"""A pipe that is known roughly, in a depth image: found near its predicted place, or refused with a reason."""

import numpy as np
import pytest
from cylinder_scene import Cylinder, camera_model, hit

from surecut.estimator.depth_sensor import DEPTH_FRAMES, DepthSensor
from surecut.factors.cloud import corrected
from surecut.factors.measurements import CylinderSighting, Rejection
from surecut.factors.pipe import across_axis, cylinder_covariance
from surecut.factors.rig import Kinect
from surecut.frontends.cloud.noise import depth_noise
from surecut.frontends.pipe.depth_cylinder import DepthImages, PredictedPipe, cylinder_near

AXIS, POINT, RADIUS = np.array([0.12, 0.97, -0.2]), np.array([0.1, 0.0, 1.4]), 0.04
CAMERA = camera_model(640, 480, 585.0)
WALL_M = 2.2


def image(pipes, seed=0, hidden=False):
    v, u = np.mgrid[0 : CAMERA.height, 0 : CAMERA.width]
    rays = np.dstack(((u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(u.shape))).reshape(-1, 3)
    z = np.min([hit(pipe, rays)[0] for pipe in pipes], axis=0)
    z = np.minimum(z, 1.0 if hidden else WALL_M).reshape(u.shape)
    rng = np.random.default_rng(seed)
    z = z + rng.normal(size=z.shape) * depth_noise("kinect_v1").axial(z, 0.0)
    step = depth_noise("kinect_v1").step(z)
    return (np.round(z / step) * step).astype(np.float32)


def predicted(shift=(0.0, 0.0, 0.0), sigma=0.015, radius=RADIUS):
    axis = AXIS / np.linalg.norm(AXIS)
    middle = POINT + np.asarray(shift)
    return PredictedPipe(middle - 0.4 * axis, middle + 0.4 * axis, radius, sigma)


def search(pipes, prediction, **kind):
    sensor = DepthSensor(Kinect())
    views = [sensor.image(i, image(pipes, i, **kind), CAMERA) for i in range(DEPTH_FRAMES)]
    assert [view is not None for view in views] == [False] * (DEPTH_FRAMES - 1) + [True]
    points = DepthImages(CAMERA, "kinect_v1").points_near(views[-1].depth_m, prediction)
    return cylinder_near(0, "pipe0", points, "kinect_v1", prediction)


def error(found):
    """Offsets of the true axis from both ends, and the radius, as `cylinder_factor` orders them."""
    axis = (found.point_b_m - found.point_a_m) / np.linalg.norm(found.point_b_m - found.point_a_m)
    true = AXIS / np.linalg.norm(AXIS)
    E = across_axis(axis)
    feet = [
        POINT + float(axis @ (end - POINT)) / float(axis @ true) * true for end in (found.point_a_m, found.point_b_m)
    ]
    parts = [E @ (foot - end) for foot, end in zip(feet, (found.point_a_m, found.point_b_m), strict=True)]
    return np.concatenate([*parts, [RADIUS - found.radius_m]])


@pytest.mark.parametrize("shift", [(0.0, 0.0, 0.0), (0.012, 0.0, -0.025), (-0.01, 0.0, 0.03)])
def test_found_from_a_prediction_that_is_off_with_a_neighbour_beside_it(shift):
    neighbour = Cylinder(POINT + np.array([0.16, 0.0, 0.03]), AXIS + np.array([0.03, 0.0, 0.02]), 0.045)
    found = search([Cylinder(POINT, AXIS, RADIUS), neighbour], predicted(shift, radius=RADIUS + 0.003))
    assert isinstance(found, CylinderSighting), found
    off = error(found)
    covariance = cylinder_covariance(found)
    assert off @ np.linalg.solve(covariance, off) < 20.0
    assert abs(off[4]) < 0.003
    length = np.linalg.norm(found.point_b_m - found.point_a_m)
    assert np.linalg.norm(off[:2] - off[2:4]) / length < np.deg2rad(1.0)
    assert np.sqrt(np.linalg.eigvalsh(covariance[:2, :2])[-1]) > 0.004  # depth errors that all points share


def test_a_hidden_pipe_is_not_found():
    found = search([Cylinder(POINT, AXIS, RADIUS)], predicted(), hidden=True)
    assert isinstance(found, Rejection)
    assert found.family == "pipe cylinder"


def test_the_fit_follows_the_depth_camera_as_it_says():
    axis = AXIS / np.linalg.norm(AXIS)
    rng = np.random.default_rng(5)
    towards = -POINT + (POINT @ axis) * axis
    first = towards / np.linalg.norm(towards)
    angle, along = rng.uniform(-1.1, 1.1, 2500), rng.uniform(-0.3, 0.3, 2500)
    normal = np.cos(angle)[:, None] * first + np.sin(angle)[:, None] * np.cross(axis, first)
    points = POINT + along[:, None] * axis + RADIUS * normal
    base = cylinder_near(0, "pipe0", points, "kinect_v1", predicted())
    assert isinstance(base, CylinderSighting)
    assert base.by_depth is not None
    E = across_axis((base.point_b_m - base.point_a_m) / np.linalg.norm(base.point_b_m - base.point_a_m))
    for column, size in enumerate((0.002, 0.002, 0.001, 0.001, 0.002)):
        states = np.zeros(5)
        states[column] = size
        moved = cylinder_near(0, "pipe0", corrected(points, states[0], states[1], states[2:]), "kinect_v1", predicted())
        assert isinstance(moved, CylinderSighting)
        for name, rows in (("point_a_m", slice(0, 3)), ("point_b_m", slice(3, 6))):
            told = E @ base.by_depth[rows, column] * size
            np.testing.assert_allclose(E @ (getattr(moved, name) - getattr(base, name)), told, atol=0.06 * size + 1e-5)
        assert moved.radius_m - base.radius_m == pytest.approx(base.by_depth[6, column] * size, abs=2e-5)


def test_a_point_cloud_serves_where_no_image_comes():
    sensor = DepthSensor(Kinect())
    z = image([Cylinder(POINT, AXIS, RADIUS)]).astype(float)
    v, u = np.mgrid[0 : CAMERA.height, 0 : CAMERA.width]
    points = np.dstack(((u - CAMERA.cx) / CAMERA.fx * z, (v - CAMERA.cy) / CAMERA.fy * z, z))[::2, ::2].reshape(-1, 3)
    assert sensor.cloud_due(0)
    view = sensor.cloud(0, points)
    assert len(view.cloud.points_m) > 500
    assert not sensor.cloud_due(1)
    found = cylinder_near(0, "pipe0", view.points_m, "kinect_v1", predicted())
    assert isinstance(found, CylinderSighting)
    assert found.radius_m == pytest.approx(RADIUS, abs=0.004)
