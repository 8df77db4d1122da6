"""The map of a result: what is next to a point, and the files that other programs open."""

import json

import gtsam
import numpy as np
import pytest
from report_results import make_result

from surecut.estimator.cli import main
from surecut.estimator.linear import LinearSystem
from surecut.estimator.result import PipeEstimate, PointEstimate, SurfaceMap
from surecut.estimator.result_json import from_json, to_json
from surecut.estimator.scene import build_scene
from surecut.estimator.surroundings import VOXEL_M, Surroundings, compact_map, map_rows, nearest_surface
from surecut.factors import keys
from surecut.factors.noise import sigmas
from surecut.io.point_files import pcd_bytes, ply_bytes

PIPE = PipeEstimate(
    "pipe0", "b", np.zeros(3), np.array([0.0, 1.0, 0.0]), 0.05, np.diag([1e-6] * 3 + [1e-8] * 3 + [1e-6])
)
POINT = PointEstimate("P1", "cut", "b", np.zeros(3), 4e-6 * np.eye(3), 0.005, 4, PIPE.axis, "pipe0")
POINT_SIGMA, LANDMARK_SIGMA = 0.002, 0.003


def world(landmarks):
    """{b} at the origin, the point there too, and landmarks, each known by itself."""
    values, graph = gtsam.Values(), gtsam.NonlinearFactorGraph()
    values.insert(keys.base(0), gtsam.Pose3())
    graph.add(gtsam.PriorFactorPose3(keys.base(0), gtsam.Pose3(), sigmas([1e-9] * 6)))
    values.insert(keys.DEPTH, np.zeros(2))
    graph.add(gtsam.PriorFactorVector(keys.DEPTH, np.zeros(2), sigmas([0.004, 1e-9])))
    values.insert(keys.DEPTH_RAYS, np.zeros(3))
    graph.add(gtsam.PriorFactorVector(keys.DEPTH_RAYS, np.zeros(3), sigmas([1e-9] * 3)))
    values.insert(keys.point(0), np.zeros(3))
    graph.add(gtsam.PriorFactorPoint3(keys.point(0), np.zeros(3), sigmas([POINT_SIGMA] * 3)))
    for i, place in enumerate(landmarks):
        values.insert(keys.landmark(i), place)
        graph.add(gtsam.PriorFactorPoint3(keys.landmark(i), place, sigmas([LANDMARK_SIGMA] * 3)))
    return values, LinearSystem(graph, values)


def around(landmarks, cloud=(), cloud_sigma=0.001):
    landmarks, cloud = np.reshape(landmarks, (-1, 3)).astype(float), np.reshape(cloud, (-1, 3)).astype(float)
    sigma = np.r_[np.full(len(landmarks), LANDMARK_SIGMA), np.full(len(cloud), cloud_sigma)]
    return Surroundings(np.vstack([landmarks, cloud]), sigma, tuple(map(keys.landmark, range(len(landmarks)))), cloud)


def test_a_wall_of_landmarks_beside_the_pipe():
    """The wall is 0.3 m away; landmarks on the pipe's mantle (0.05 m) and a lonely one do not count."""
    wall = [[0.3, 0.0, 0.0], [0.3, 0.03, 0.0], [0.3, 0.0, 0.03]]
    mantle = [[0.05, 0.0, 0.0], [0.0, 0.02, 0.055], [0.0, 0.0, -0.05]]
    lonely = [[0.0, 0.0, 0.2]]
    places = np.array(wall + mantle + lonely)
    values, system = world(places)
    found = nearest_surface(around(places), POINT, PIPE, keys.point(0), values, system)
    assert found.distance_m == pytest.approx(0.3)
    assert found.sigma_m == pytest.approx(np.hypot(POINT_SIGMA, LANDMARK_SIGMA), rel=1e-6)
    np.testing.assert_allclose(found.direction, [1, 0, 0], atol=1e-12)
    assert "landmark" in found.what


def test_what_the_blade_comes_nearest_to_counts():
    """A plate beside the next piece of pipe is 0.139 m from the point, but 0.114 m from the blade's rim; another is
    0.150 m from the point and 0.100 m from the rim."""
    places = np.array([[0.07, 0.12, 0.0], [0.07, 0.12, 0.01], [0.0, 0.0, 0.15], [0.0, 0.01, 0.15]])
    values, system = world(places)
    found = nearest_surface(around(places), POINT, PIPE, keys.point(0), values, system)
    assert found.distance_m == pytest.approx(0.15)


def test_the_kinects_surface_has_the_depth_states_doubt():
    """Straight ahead at 0.5 m: the depth offset's sigma of 4 mm acts along the ray, with the point's and the noise."""
    cloud = np.array([[0.0, 0.0, 0.5], [0.02, 0.0, 0.5]])
    values, system = world([])
    found = nearest_surface(around([], cloud), POINT, PIPE, keys.point(0), values, system)
    assert found.distance_m == pytest.approx(0.5)
    assert found.sigma_m == pytest.approx(np.sqrt(POINT_SIGMA**2 + 0.004**2 + 0.001**2), rel=1e-4)
    assert "Kinect" in found.what


def test_nothing_but_the_pipe():
    places = np.array([[0.05, 0.0, 0.0], [0.05, 0.01, 0.0]])
    values, system = world(places)
    assert nearest_surface(around(places), POINT, PIPE, keys.point(0), values, system) is None


def test_compact_map_keeps_the_surest_of_a_voxel():
    points = np.array([[0.001, 0.001, 0.001], [0.002, 0.002, 0.002], [1.0, 1.0, 1.0], [0.003, 0.003, 0.003]])
    found = Surroundings(points, np.array([0.02, 0.01, 0.03, 0.005]), (0, 1, 2), points[3:])
    stored = compact_map(found)
    rows = map_rows(stored)
    # One landmark voxel with the second, the far one, and the Kinect's own voxel beside the landmarks'.
    assert stored.landmarks == 2
    np.testing.assert_allclose(rows[:, 3], [0.01, 0.03, 0.005])
    assert compact_map(None) is None
    assert VOXEL_M == 0.02


def mapped_result():
    rows = np.array([[0.1, 0.2, 1.0, 0.01], [0.3, 0.2, 1.5, 0.02]], "<f4")
    return make_result(surroundings=SurfaceMap("b", rows.tobytes(), 1))


def test_the_map_survives_the_json():
    result = mapped_result()
    assert from_json(to_json(result)).surroundings == result.surroundings


def test_scene_holds_what_the_result_knows():
    result = mapped_result()
    scene = build_scene(result)
    assert len(scene.points_m) == len(scene.colours) == len(scene.sigma_m)
    np.testing.assert_allclose(scene.points_m[:2], [[0.1, 0.2, 1.0], [0.3, 0.2, 1.5]])
    pipe = result.pipes[0]
    orange = scene.points_m[(scene.colours == (240, 150, 30)).all(1)] - pipe.point_m
    off = np.linalg.norm(orange - np.outer(orange @ pipe.axis, pipe.axis), axis=1)
    np.testing.assert_allclose(off, pipe.radius_m, atol=1e-6)
    red = scene.points_m[(scene.colours == (220, 30, 30)).all(1)][:600] - result.points[0].position_m
    squares = np.einsum("ni,ij,nj->n", red, np.linalg.inv(result.points[0].covariance_m2), red)
    np.testing.assert_allclose(squares, 7.815, rtol=1e-2)  # chi-square, 3 degrees of freedom, 95 %


def test_files_are_read_back():
    rng = np.random.default_rng(1)
    points = rng.normal(size=(7, 3)).astype(np.float32)
    colours = rng.integers(0, 255, (7, 3), dtype=np.uint8)
    sigma = rng.uniform(size=7).astype(np.float32)
    head, _, body = ply_bytes(points, colours, sigma).partition(b"end_header\n")
    assert b"element vertex 7" in head
    table = np.frombuffer(body, [("p", "<f4", 3), ("c", "u1", 3), ("s", "<f4")])
    np.testing.assert_array_equal(table["p"], points)
    np.testing.assert_array_equal(table["c"], colours)
    np.testing.assert_array_equal(table["s"], sigma)
    head, _, body = pcd_bytes(points, colours, sigma).partition(b"DATA binary\n")
    assert b"POINTS 7" in head
    rows = np.frombuffer(body, "<f4").reshape(7, 5)
    np.testing.assert_array_equal(rows[:, :3], points)
    packed = np.ascontiguousarray(rows[:, 3]).view("<u4")
    np.testing.assert_array_equal(np.column_stack([packed >> 16 & 255, packed >> 8 & 255, packed & 255]), colours)


def test_command(tmp_path, capsys):
    source = tmp_path / "result.json"
    source.write_text(to_json(mapped_result()), encoding="utf-8")
    for name, magic in (("scene.ply", b"ply\n"), ("scene.pcd", b"# .PCD v0.7")):
        with pytest.raises(SystemExit) as told:
            main(["map", str(source), "-o", str(tmp_path / name)])
        assert told.value.code in (0, None)
        assert (tmp_path / name).read_bytes().startswith(magic)
        assert "2 of them mapped" in capsys.readouterr().out
    with pytest.raises(SystemExit) as told:
        main(["map", str(source), "-o", str(tmp_path / "scene.txt")])
    assert told.value.code == 2
    assert json.loads(source.read_text())["surroundings"]["landmarks"] == 1
