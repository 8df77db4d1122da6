"""Surface samples against a plane and a step whose geometry is known by hand."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from surecut.factors.camera import CameraModel
from surecut.frontends.cloud.associate import associate
from surecut.frontends.cloud.base_motion import BaseMotion
from surecut.frontends.cloud.frontend import CloudFrontEnd, average_depth
from surecut.frontends.cloud.noise import depth_noise
from surecut.frontends.cloud.points import cloud_from_points
from surecut.frontends.cloud.registration import register

WIDTH, HEIGHT, FOCAL = 320, 240, 290.0
K = np.array([[FOCAL, 0, 159.5], [0, FOCAL, 119.5], [0, 0, 1]])
CAMERA = CameraModel("b_depth", WIDTH, HEIGHT, K, "none", np.zeros(5), np.eye(3), None)
IDENTITY = np.eye(4)
V, U = np.mgrid[0:HEIGHT, 0:WIDTH]
RAYS = np.dstack(((U - 159.5) / FOCAL, (V - 119.5) / FOCAL, np.ones((HEIGHT, WIDTH))))


def plane_depth(normal, distance):
    return distance / (RAYS @ (np.asarray(normal) / np.linalg.norm(normal)))


def corner(a_T_b=IDENTITY, seed=0, noise=True):
    """Depth of a room corner of three walls seen from a camera at a_T_b."""
    walls = [((0, 0.2, 1.0), 2.0), ((1.0, 0, 0.5), 1.2), ((-0.2, 1.0, 0.4), 1.1)]
    depth = np.full((HEIGHT, WIDTH), np.inf)
    for normal, distance in walls:
        normal = np.asarray(normal) / np.linalg.norm(normal)
        slope = RAYS @ (a_T_b[:3, :3].T @ normal)
        z = (distance - normal @ a_T_b[:3, 3]) / np.where(np.abs(slope) < 1e-6, 1e-6, slope)
        depth = np.where((z > 0) & (z < depth), z, depth)
    if noise:
        rng = np.random.default_rng(seed)
        depth = depth + rng.normal(size=depth.shape) * depth_noise("kinect_v1").axial(depth, 0.0)
    return depth.astype(np.float32)


@settings(deadline=None, max_examples=15)
@given(st.floats(-0.6, 0.6), st.floats(-0.6, 0.6), st.floats(0.8, 2.5))
def test_samples_of_a_plane_lie_on_it(nx, ny, distance):
    normal = np.array([nx, ny, 1.0]) / np.linalg.norm([nx, ny, 1.0])
    depth = plane_depth(normal, distance)
    depth = np.where((depth > 0.5) & (depth < 4), depth, np.nan).astype(np.float32)
    cloud = CloudFrontEnd(CAMERA, "kinect_v1").process(7, depth)
    assert cloud.stamp_ns == 7
    assert 0 < len(cloud.points_m) <= 4000
    np.testing.assert_allclose(cloud.points_m @ normal, distance, atol=2e-4)
    np.testing.assert_allclose(cloud.normals, np.broadcast_to(-normal, cloud.normals.shape), atol=5e-3)


def test_sigma_covers_the_scatter_of_noisy_planes():
    front_end, scores = CloudFrontEnd(CAMERA, "kinect_v1"), []
    for seed in range(4):
        cloud = front_end.process(0, corner(seed=seed))
        clean = front_end.process(0, corner(noise=False))
        distance = np.abs(cloud.points_m @ (np.array([0, 0.2, 1.0]) / np.hypot(0.2, 1)) - 2.0)
        on_wall = (distance < 0.03) & (cloud.normals @ clean.normals[len(clean.normals) // 2] > 0.95)
        scores.append((distance[on_wall] / cloud.sigma_m[on_wall]).std())
    # Quantisation is in the sigma and not in this noise, so samples scatter by less than their sigma.
    assert 0.1 < np.mean(scores) < 1.0
    assert (cloud.bias_m <= cloud.sigma_m).all()


def test_no_sample_stands_on_a_depth_edge_or_a_grazing_surface():
    depth = np.where(U < 160, 1.0, 1.6).astype(np.float32)
    cloud = CloudFrontEnd(CAMERA, "kinect_v1").process(0, depth)
    assert np.minimum(np.abs(cloud.points_m[:, 2] - 1.0), np.abs(cloud.points_m[:, 2] - 1.6)).max() < 1e-4
    grazing = plane_depth((1.0, 0, 0.12), 0.5)
    grazing = np.where((grazing > 0.4) & (grazing < 4), grazing, np.nan).astype(np.float32)
    cloud = CloudFrontEnd(CAMERA, "kinect_v1").process(0, grazing)
    rays = cloud.points_m / np.linalg.norm(cloud.points_m, axis=1, keepdims=True)
    assert (-(rays * cloud.normals).sum(axis=1) > np.cos(np.deg2rad(75.0)) - 1e-3).all()


def test_empty_and_wrong_images():
    front_end = CloudFrontEnd(CAMERA, "kinect_v1")
    assert len(front_end.process(0, np.full((HEIGHT, WIDTH), np.nan, np.float32)).points_m) == 0
    with pytest.raises(ValueError, match="depth image"):
        front_end.process(0, np.ones((10, 10), np.float32))


def test_average_of_frames_drops_flicker():
    stack = np.full((4, 2, 3), 1.0, np.float32)
    stack[:, 0, 0] = (1.0, 2.0, 1.0, 2.0)
    stack[:3, 0, 1] = np.nan
    mean = average_depth(stack)
    assert np.isnan(mean[0, :2]).all()
    np.testing.assert_allclose(mean[1], 1.0)


def test_points_without_image_give_the_same_surface():
    cloud = cloud_from_points(0, (RAYS * corner()[..., None]).reshape(-1, 3), "kinect_v1")
    wall = np.array([0, 0.2, 1.0]) / np.hypot(0.2, 1)
    on_wall = np.abs(cloud.points_m @ wall - 2.0) < 0.02
    assert on_wall.sum() > 200
    assert np.median(np.abs(cloud.normals[on_wall] @ wall)) > 0.93


def test_landmarks_find_their_surface_and_edges_are_refused():
    cloud = CloudFrontEnd(CAMERA, "kinect_v1").process(0, np.where(U < 160, 1.2, 1.5).astype(np.float32))
    on_left, on_right, at_step, behind = [-0.3, 0, 1.2], [0.3, 0, 1.5], [0.0, 0, 1.35], [-0.3, 0, 1.6]
    matches = associate(np.array([on_left, on_right, at_step, behind]), 0.005, cloud)
    assert matches.landmark.tolist() == [0, 1]
    np.testing.assert_allclose(matches.point_m[:, 2], (1.2, 1.5), atol=1e-3)
    np.testing.assert_allclose(matches.normal, [[0, 0, -1], [0, 0, -1]], atol=1e-3)
    assert matches.reasons[2] != ""
    assert matches.reasons[3] in ("no surface near", "off the surface", "few samples")


def test_residuals_of_noisy_landmarks_agree_with_their_sigma():
    cloud = CloudFrontEnd(CAMERA, "kinect_v1").process(0, corner(seed=1))
    rng = np.random.default_rng(3)
    rows, columns = rng.integers(20, 220, 400), rng.integers(20, 300, 400)
    truth = RAYS[rows, columns] * corner(noise=False)[rows, columns, None]
    sigma = 0.01
    matches = associate(truth + rng.normal(0, sigma, truth.shape), sigma, cloud)
    seen = truth[matches.landmark] - matches.point_m
    assert len(matches.landmark) > 150
    scale = np.hypot(matches.sigma_m, matches.bias_m)
    assert np.median(np.abs((seen * matches.normal).sum(axis=1)) / scale) < 1.5


def test_registration_recovers_a_known_pose_within_its_covariance():
    from scipy.spatial.transform import Rotation

    front_end = CloudFrontEnd(CAMERA, "kinect_v1")
    truth = np.eye(4)
    truth[:3, :3] = Rotation.from_rotvec([0.01, -0.03, 0.02]).as_matrix()
    truth[:3, 3] = (0.03, -0.02, 0.04)
    found = register(front_end.process(0, corner()), front_end.process(1, corner(truth, seed=5)), np.eye(4))
    error = np.linalg.inv(found.a_T_b) @ truth
    xi = np.concatenate((Rotation.from_matrix(error[:3, :3]).as_rotvec(), error[:3, 3]))
    assert np.linalg.norm(xi[3:]) < 0.004
    assert np.linalg.norm(xi[:3]) < 0.003
    assert xi @ np.linalg.solve(found.covariance, xi) < 22.5  # 99.9 % of chi-square with 6
    assert found.overlap > 0.7


def test_a_bare_wall_leaves_three_directions_free():
    depth = plane_depth((0, 0, 1.0), 1.5).astype(np.float32)
    front_end = CloudFrontEnd(CAMERA, "kinect_v1")
    found = register(front_end.process(0, depth), front_end.process(1, depth), np.eye(4))
    sigma = np.sqrt(np.diag(found.covariance))
    assert (sigma[[2, 3, 4]] > 0.5).all()  # turn about the wall's normal, slides along it
    assert (sigma[[0, 1, 5]] < 0.02).all()


def test_stations_are_told_apart_and_linked():
    front_end, motion = CloudFrontEnd(CAMERA, "kinect_v1"), BaseMotion()
    places = [0.0] * 12 + list(np.linspace(0.02, 0.16, 8)) + [0.16] * 14
    for step, x in enumerate(places):
        pose = np.eye(4)
        pose[0, 3], pose[2, 3] = x, 0.5 * x
        motion.add(front_end.process(step * 66_000_000, corner(pose, seed=step)))
    first, second = motion.stations
    assert first.end_ns is not None
    assert 11 * 66_000_000 <= first.end_ns <= 15 * 66_000_000
    assert second.previous_T_this is not None
    np.testing.assert_allclose(second.previous_T_this.a_T_b[:3, 3], (0.16, 0, 0.08), atol=0.006)
