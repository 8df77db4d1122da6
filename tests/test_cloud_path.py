"""{b} by the Kinect's cloud: registration of landmarks, a camera found in pictures, and a mount that is wrong."""

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from surecut.estimator.bundle import bundles
from surecut.estimator.engine import Engine
from surecut.estimator.landmark_map import landmark_map
from surecut.estimator.mount_check import held_part
from surecut.estimator.run import finish
from surecut.estimator.surfaces import lay_on_surfaces
from surecut.factors.camera import CameraModel
from surecut.factors.geometry import pose3
from surecut.factors.measurements import CloudFrame
from surecut.factors.rig import Pose
from surecut.frontends.cloud.point_registration import MapPoints, register_points
from surecut.frontends.cross_view import Features, MappedFeatures, features, find_view, mapped_features
from surecut.simulation.measurement_level import draw
from surecut.simulation.measurement_level_scenario import Clouds, Scenario, Tracks

DEPTH_SIGMAS = np.array([0.02, 0.01])


def pose(turn, shift):
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec(turn).as_matrix(), shift
    return T


def surfaces(names, count, rng):
    """Points and inward normals of walls of a room about a camera at the origin that looks along z."""
    points, normals = [], []
    for name in names:
        s, t = rng.uniform(-1.0, 1.0, (2, count))
        walls = {
            "front": (np.column_stack((s, t, np.full(count, 2.2))), (0, 0, -1)),
            "left": (np.column_stack((np.full(count, -0.9), 0.8 * s, 1.6 + 0.5 * t)), (1, 0, 0)),
            "floor": (np.column_stack((s, np.full(count, 0.8), 1.6 + 0.5 * t)), (0, -1, 0)),
        }
        points.append(walls[name][0])
        normals.append(np.tile(walls[name][1], (count, 1)))
    return np.vstack(points), np.vstack(normals).astype(float)


def scene(names, seed, sigma_m=0.008):
    """Landmarks of {o} and a cloud of the same surfaces in {b}."""
    rng = np.random.default_rng(seed)
    o_T_b = pose((0.2, -0.6, 0.1), (0.8, -0.1, 0.4))
    b_p, normals = surfaces(names, 1500, rng)
    b_p = b_p + rng.normal(0, 0.004, (len(b_p), 1)) * normals
    noise = np.full(len(b_p), 0.004)
    cloud = CloudFrame(0, b_p, normals, noise, noise, np.zeros(len(b_p)))
    landmarks, _ = surfaces(names, 60, rng)
    o_p = landmarks @ o_T_b[:3, :3].T + o_T_b[:3, 3] + rng.normal(0, sigma_m, landmarks.shape)
    eye = o_T_b[:3, :3] @ np.array([0.5, -0.2, 0.3]) + o_T_b[:3, 3]
    return MapPoints(o_p, np.full(len(o_p), sigma_m), np.tile(eye, (len(o_p), 1))), cloud, o_T_b


def tangent(a_T_b):
    return np.concatenate((Rotation.from_matrix(a_T_b[:3, :3]).as_rotvec(), a_T_b[:3, 3]))


def test_landmarks_on_three_walls_place_the_camera_within_its_covariance():
    scores = []
    for seed in range(6):
        points, cloud, true = scene(("front", "left", "floor"), seed)
        rng = np.random.default_rng(100 + seed)
        guess = true @ pose(rng.normal(0, 0.05, 3), rng.normal(0, 0.08, 3))
        found = register_points(points, cloud, guess, DEPTH_SIGMAS)
        assert found is not None
        assert found.plausible
        error = tangent(np.linalg.inv(true) @ found.o_T_b)
        assert np.linalg.norm(error[3:]) < 0.04
        scores.append(error @ np.linalg.solve(found.covariance, error) / 6)
    assert 0.02 < np.mean(scores) < 2.5


def test_a_bare_wall_leaves_its_own_directions_loose():
    points, cloud, true = scene(("front",), 1)
    found = register_points(points, cloud, true, DEPTH_SIGMAS)
    assert found is not None
    sigma = np.sqrt(np.diag(found.covariance))
    assert sigma[3] > 1.0 and sigma[4] > 1.0 and sigma[2] > 1.0  # noqa: PT018
    assert sigma[5] < 0.05 and sigma[0] < 0.02 and sigma[1] < 0.02  # noqa: PT018


def test_the_sigma_of_a_wall_is_the_one_known_by_hand():
    """N distances of sigma s: s / sqrt(N) along the normal, s / sqrt(sum of squared arms) about each axis in it."""
    rng = np.random.default_rng(7)
    sigma, count = 0.006, 400
    landmarks = np.column_stack((rng.uniform(-1, 1, (count, 2)), np.full(count, 2.0)))
    grid = np.stack(np.meshgrid(np.linspace(-1.1, 1.1, 90), np.linspace(-1.1, 1.1, 90)), axis=2).reshape(-1, 2)
    wall = np.column_stack((grid, np.full(len(grid), 2.0)))
    tiny = np.full(len(wall), 1e-4)
    cloud = CloudFrame(0, wall, np.tile([0.0, 0.0, -1.0], (len(wall), 1)), tiny, tiny, np.zeros(len(wall)))
    seen = landmarks + np.outer(rng.normal(0, sigma, count), [0, 0, 1])
    points = MapPoints(seen, np.full(count, sigma), np.zeros((count, 3)))
    found = register_points(points, cloud, np.eye(4), np.array([1e-6, 1e-6]))
    assert found is not None
    stated = np.sqrt(np.diag(found.covariance))
    about_x, about_y = (sigma / np.sqrt(((landmarks[:, i] - landmarks[:, i].mean()) ** 2).sum()) for i in (1, 0))
    # A turn about the camera moves the wall's middle too: the offset's own sigma is that with the turns known.
    known_turns = 1.0 / np.sqrt(np.linalg.inv(found.covariance)[5, 5])
    robust = 1.0 / 0.7  # what the kernel costs normal errors
    assert sigma / np.sqrt(count) < known_turns * 1.05 < 1.05 * robust * sigma / np.sqrt(count)
    for value, true in ((stated[0], about_x), (stated[1], about_y)):
        assert 0.95 * true < value < 1.05 * robust * true
    assert min(stated[2:5]) > 1.0  # turn about the normal, and both ways along the wall


def test_a_floor_leaves_both_ways_along_it_and_the_turn_about_its_normal_loose():
    points, cloud, true = scene(("floor",), 3)
    found = register_points(points, cloud, true, DEPTH_SIGMAS)
    assert found is not None
    sigma = np.sqrt(np.diag(found.covariance))
    assert min(sigma[3], sigma[5], sigma[1]) > 1.0
    assert max(sigma[4] / 0.05, sigma[0] / 0.03, sigma[2] / 0.03) < 1.0


def test_a_cylinder_leaves_its_own_axis_loose():
    """An upright pipe: free are the way along it and the turn about it."""
    rng = np.random.default_rng(9)
    radius, middle = 0.15, np.array([0.0, 0.0, 1.2])

    def mantle(count):
        angle, height = rng.uniform(-1.2, 1.2, count), rng.uniform(-0.5, 0.5, count)
        out = np.column_stack((np.sin(angle), np.zeros(count), -np.cos(angle)))
        return middle + radius * out + np.outer(height, [0, 1, 0]), out

    surface, normals = mantle(4000)
    small = np.full(len(surface), 0.002)
    cloud = CloudFrame(0, surface, normals, small, small, np.zeros(len(surface)))
    landmarks, _ = mantle(150)
    seen = landmarks + rng.normal(0, 0.003, landmarks.shape)
    found = register_points(MapPoints(seen, np.full(150, 0.003), np.zeros((150, 3))), cloud, np.eye(4), DEPTH_SIGMAS)
    assert found is not None
    # The tangent that turns about the pipe's own axis, which stands 1.2 m before the camera.
    about = np.concatenate(([0.0, 1.0, 0.0], -np.cross([0.0, 1.0, 0.0], middle)))
    along = np.array([0.0, 0.0, 0.0, 0.0, 1.0, 0.0])
    information = np.linalg.inv(found.covariance)
    held = [np.array([0, 0, 0, 1.0, 0, 0]), np.array([0, 0, 0, 0, 0, 1.0]), np.eye(6)[0], np.eye(6)[2]]
    for free in (about, along):
        assert free @ information @ free < 0.01 * min(h @ information @ h for h in held)
    assert np.sqrt(found.covariance[4, 4]) > 0.05
    assert np.sqrt(found.covariance[3, 3]) < 1.2  # with the turn about the pipe, not without


def test_a_disagreement_counts_along_the_held_directions_only():
    spread = np.diag([1e-6, 1e-6, 1.0, 1.0, 1.0, 1e-4])
    own = np.diag([1e-6] * 3 + [1e-6] * 3)
    held = held_part(np.array([0.002, 0.0, 0.5, 0.3, -0.4, 0.0]), spread, own)
    assert held is not None
    assert held.directions == 3
    assert held.total == pytest.approx(0.002**2 / 2e-6)
    np.testing.assert_allclose(held.residual, [0.002, 0, 0, 0, 0, 0], atol=1e-12)
    assert held_part(np.ones(6), np.eye(6), own) is None


def test_landmarks_before_the_surfaces_contradict():
    points, cloud, true = scene(("front", "left", "floor"), 2)
    middle = true[:3, 3] + true[:3, :3] @ np.array([0.0, 0.0, 1.0])
    crowd = np.random.default_rng(0).normal(0, 0.12, (400, 3)) + middle
    more = MapPoints(
        np.vstack((points.points_m, crowd)), np.full(len(points.points_m) + 400, 0.008),
        np.vstack((points.seen_from_m, np.tile(points.seen_from_m[0], (400, 1)))),
    )  # fmt: skip
    found = register_points(more, cloud, true, DEPTH_SIGMAS)
    assert found is not None
    assert found.contradictions > 100
    assert not found.plausible


def camera(name, width, height, focal):
    K = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1.0]])
    return CameraModel(name, width, height, K, "none", np.zeros(5), np.eye(3), None)


def photograph(model, texture, w_T_c, scale):
    """A textured wall z = 0 of {w}, `scale` pixels per metre, (0, 0) in its middle."""
    c_T_w = np.linalg.inv(w_T_c)
    H = model.K @ np.column_stack((c_T_w[:3, 0], c_T_w[:3, 1], c_T_w[:3, 3]))
    half = 0.5 * np.array(texture.shape[::-1])
    from_texture = np.array([[1 / scale, 0, -half[0] / scale], [0, 1 / scale, -half[1] / scale], [0, 0, 1]])
    return cv2.warpPerspective(texture, H @ from_texture, (model.width, model.height), flags=cv2.INTER_AREA)


def test_a_camera_is_found_among_stereo_features():
    rng = np.random.default_rng(4)
    fine = rng.integers(0, 255, (300, 400)).astype(np.float32)
    texture = cv2.resize(cv2.GaussianBlur(fine, (0, 0), 1.2), (1600, 1200), interpolation=cv2.INTER_CUBIC)
    texture = np.clip((texture - texture.mean()) * 3 + 128, 0, 255).astype(np.uint8)
    left, right = camera("m_left", 360, 240, 270.0), camera("m_right", 360, 240, 270.0)
    other = camera("b_rgb", 640, 480, 525.0)
    o_T_w = pose((0.05, -0.25, 0.02), (0.1, 0.05, 1.6))
    left_T_right, o_T_c = pose((0, 0, 0), (0.15, 0, 0)), pose((0.02, 0.22, -0.05), (-0.5, 0.05, -0.1))
    w_T_o = np.linalg.inv(o_T_w)
    views = [
        photograph(m, texture, w_T_o @ T, 400.0) for m, T in ((left, np.eye(4)), (right, left_T_right), (other, o_T_c))
    ]
    mapped = mapped_features(features(views[0], left), features(views[1], right), left, right, left_T_right)
    depth = (mapped.points_m - o_T_w[:3, 3]) @ o_T_w[:3, 2]
    assert np.median(np.abs(depth)) < 0.03
    found = find_view([mapped], features(views[2], other), other)
    assert found is not None
    error = tangent(np.linalg.inv(o_T_c) @ found.o_T_c)
    assert np.linalg.norm(error[:3]) < 0.02
    assert np.linalg.norm(error[3:]) < 0.05
    blank = np.full((480, 640), 90, np.uint8)
    assert find_view([mapped], features(blank, other), other) is None


def found_among_points(seed, lens_sigmas=(0.0, 0.0)):
    """A camera at 2 m from points that two keyframes mapped, seen with 1 px noise: error and covariance."""
    rng, model = np.random.default_rng(seed), camera("b_rgb", 640, 480, 525.0)
    c_p = np.column_stack((rng.uniform(-1.0, 1.0, 150), rng.uniform(-0.7, 0.7, 150), rng.uniform(1.6, 2.6, 150)))
    px = c_p[:, :2] / c_p[:, 2:] * 525.0 + (model.cx, model.cy) + rng.normal(0, 1.0, (150, 2))
    names, o_T_c = rng.normal(0, 1, (150, 128)).astype(np.float32), pose((0.1, 0.4, -0.2), (0.5, 0.1, -0.3))
    mapped = MappedFeatures(names, c_p @ o_T_c[:3, :3].T + o_T_c[:3, 3])
    found = find_view([mapped, mapped], Features(names, px), model, lens_sigmas)
    assert found is not None
    return tangent(np.linalg.inv(o_T_c) @ found.o_T_c), found.covariance


def test_the_covariance_of_a_camera_among_points_is_that_of_its_errors():
    scores = [
        error @ np.linalg.solve(covariance, error) / 6 for error, covariance in map(found_among_points, range(20))
    ]
    assert 0.7 < np.mean(scores) < 1.4


def test_a_focal_length_that_is_off_is_a_distance_that_is_off():
    (_, sure), (_, unsure) = found_among_points(3), found_among_points(3, (0.02, 0.0))
    assert np.sqrt(unsure[5, 5] - sure[5, 5]) == pytest.approx(0.02 * 2.1, rel=0.5)


@pytest.fixture(scope="module")
def run():
    # no panel: Kinect and mobile camera see the same walls
    return draw(Scenario(panel=False, tracks=Tracks(per_frame=180), clouds=Clouds(points=8000)), 5)


def estimator(run, rig):
    engine = Engine(rig, run.cameras, lay_on_surfaces, False)
    for bundle in bundles(list(run.measurements)):
        engine.add(bundle)
    return engine


def told_of(run, turn_rad=0.0, shift_m=0.0):
    mount = run.rig.mount
    given = Rotation.from_rotvec(mount.f_T_b.rotation_vector_rad) * Rotation.from_rotvec((0, turn_rad, 0))
    moved = Pose(
        translation_m=tuple(np.array(mount.f_T_b.translation_m) + np.array([shift_m, 0, 0])),
        rotation_vector_rad=tuple(given.as_rotvec()),
    )
    rig = run.rig.model_copy(update={"mount": mount.model_copy(update={"f_T_b": moved})})
    result = finish(estimator(run, rig))
    way = next(v for k, v in result.consistency.paths.items() if "against the Kinect's cloud" in k)
    return way, [event for event in result.events if event.kind == "mount_wrong"]


def test_a_right_mount_agrees_with_the_cloud(run):
    sigma, told = told_of(run)
    assert sigma < 3.0
    assert told == []


def test_a_mount_off_by_20_mm_and_2_degrees_is_named(run):
    sigma, told = told_of(run, np.deg2rad(2.0), 0.02)
    assert sigma > 3.0
    assert told[0].values["turn_rad"] == pytest.approx(np.deg2rad(2.0), abs=np.deg2rad(1.0))
    assert "measure the mount again" in told[0].text


def test_without_a_board_the_cloud_alone_holds_the_point_in_its_region(run):
    engine = estimator(run, run.rig.model_copy(update={"mount": None, "boards": (), "distances": ()}))
    guess = run.truth.o_T_b @ pose((0.03, -0.02, 0.03), (0.05, -0.04, 0.05))
    placed = register_points(landmark_map(engine).points, engine.surfaces.cloud, guess, DEPTH_SIGMAS)
    assert placed is not None
    assert placed.plausible
    engine.machine.enter_by_surfaces(pose3(placed.o_T_b), (pose3(guess), np.eye(6) * 0.12**2), 0, "a guess")
    result = finish(engine)
    assert [event.kind for event in result.events if event.kind == "base_by_cloud"]
    for point in result.points:
        error = point.position_m - run.truth.points_b_m[point.id]
        assert error @ np.linalg.solve(point.covariance_m2, error) < chi2.ppf(0.999, 3)
        assert np.linalg.norm(error) < point.radius95_m * 1.3
        assert point.radius95_m < 0.3


def test_what_one_wall_leaves_loose_the_colours_hold(run):
    engine = estimator(run, run.rig.model_copy(update={"mount": None, "boards": (), "distances": (), "pipes": ()}))
    cloud = engine.surfaces.cloud
    main = cloud.normals[np.argmax((cloud.normals @ cloud.normals.T > 0.95).sum(axis=1))]
    wall = cloud.normals @ main > 0.95
    parts = (cloud.points_m, cloud.normals, cloud.sigma_m, cloud.planarity_m, cloud.bias_m)
    engine.surfaces.cloud = CloudFrame(cloud.stamp_ns, *(part[wall] for part in parts))
    spread = np.diag([0.04**2] * 3 + [0.12**2] * 3)
    off = pose((0.02, -0.02, 0.02), (0.03, -0.05, 0.04))
    engine.machine.enter_by_surfaces(pose3(run.truth.o_T_b), (pose3(run.truth.o_T_b @ off), spread), 0, "a guess")
    found = engine.state.pose(engine.base).matrix()
    error = tangent(np.linalg.inv(run.truth.o_T_b) @ found)
    assert (np.abs(error) < 3.0 * np.sqrt(np.diag(spread))).all()
    found = engine.solver.joint_covariance([engine.base])
    assert np.linalg.eigvalsh(spread - found).min() > -1e-3 * 0.12**2
    along = np.linalg.svd(main[None, :])[2][1:]
    across_m, along_m = main @ found[3:, 3:] @ main, np.diag(along @ found[3:, 3:] @ along.T)
    assert np.sqrt(along_m.min() / across_m) > 1.5  # a wall says less of the place along it
