"""The paper's chain: every equation against numbers known by hand, then the whole chain on exact measurements."""

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from surecut.estimator import baseline
from surecut.factors.camera import CameraModel
from surecut.factors.errors import ObservabilityError, RigError
from surecut.factors.measurements import MarkerSighting, Pick, StereoFrame
from surecut.factors.rig import Board, Marker, Mount, Pose, Rig
from surecut.frontends import paper_chain

A4 = Board(
    id="f0",
    markers=(
        Marker(id=0, centre_m=(-0.05, 0.08)),
        Marker(id=1, centre_m=(0.05, 0.08)),
        Marker(id=2, centre_m=(-0.05, -0.08)),
        Marker(id=3, centre_m=(0.05, -0.08), rotation_rad=0.3),
    ),
)
RIG = Rig(
    boards=(A4,),
    mount=Mount(board="f0", f_T_b=Pose(translation_m=(0.3, 0.1, -0.05), rotation_vector_rad=(0.0, 0.0, np.pi))),
)
CAMERA = CameraModel(
    name="m_left",
    width=360,
    height=240,
    K=np.array([[270.0, 0.0, 179.5], [0.0, 270.0, 119.5], [0.0, 0.0, 1.0]]),
    distortion_model="none",
    D=np.zeros(0),
    rectification=np.eye(3),
    baseline_m=None,
)


def pose(rotation_vector, translation):
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec(rotation_vector).as_matrix()
    matrix[:3, 3] = translation
    return matrix


def frame(stamp_ns, last_T_this, left_px=None, right_px=None):
    left_px = np.zeros((0, 2)) if left_px is None else left_px
    right_px = np.zeros((0, 2)) if right_px is None else right_px
    n = len(left_px)
    return StereoFrame(
        stamp_ns=stamp_ns,
        is_keyframe=True,
        track_ids=np.arange(n),
        left_px=left_px,
        left_covariance_px2=np.tile(np.eye(2), (n, 1, 1)),
        right_px=right_px,
        right_covariance_px2=np.tile(np.eye(2), (n, 1, 1)),
        last_T_this=last_T_this,
        motion_inliers=n,
    )


def pick(stamp_ns, px, role="other"):
    return Pick(stamp_ns, "m_left", "P1", role, np.array(px, dtype=float), np.array(px, dtype=float), np.eye(2))


def test_distances_of_a_three_four_five_triangle():
    centres_m = np.array([[0.0, 0.0], [3.0, 0.0], [0.0, 4.0]])
    expected = np.array([[0.0, 3.0, 4.0], [3.0, 0.0, 5.0], [4.0, 5.0, 0.0]])
    np.testing.assert_allclose(baseline.page_distances(centres_m), expected)
    np.testing.assert_allclose(baseline.measured_distances(np.c_[centres_m, [7.0, 7.0, 7.0]]), expected)


def test_scale_is_the_mean_of_the_off_diagonal_quotients():
    known_m = np.array([[0.0, 3.0, 4.0], [3.0, 0.0, 5.0], [4.0, 5.0, 0.0]])
    measured_m = np.array([[0.0, 2.0, 4.0], [2.0, 0.0, 4.0], [4.0, 4.0, 0.0]])
    factors = baseline.scale_factors(known_m, measured_m)
    np.testing.assert_allclose(factors, [[0.0, 1.5, 1.0], [1.5, 0.0, 1.25], [1.0, 1.25, 0.0]])
    assert baseline.scale(factors) == pytest.approx(1.25)


def test_one_marker_has_no_distance():
    assert baseline.scale(baseline.scale_factors(np.zeros((1, 1)), np.zeros((1, 1)))) == 1.0


@pytest.mark.parametrize("vector", [[0.0, 0.0, 0.0], [0.0, 0.0, np.pi / 2], [0.3, -1.2, 0.7], [np.pi, 0.0, 0.0]])
def test_rodrigues(vector):
    np.testing.assert_allclose(
        baseline.rodrigues(np.array(vector)), Rotation.from_rotvec(vector).as_matrix(), atol=1e-12
    )


def test_equation_13_undoes_the_fiducials_pose():
    o_T_f = pose([0.2, 1.1, -0.4], [0.5, -0.2, 1.3])
    f_point = np.array([0.1, 0.2, 0.3])
    o_point = o_T_f[:3, :3] @ f_point + o_T_f[:3, 3]
    np.testing.assert_allclose(baseline.fiducial_from_origin(o_T_f, o_point), f_point, atol=1e-12)


def test_mean_pose_of_opposite_turns_is_the_middle():
    poses = np.array([pose([0.0, 0.0, angle], [angle, 0.0, 1.0]) for angle in (-0.4, 0.4)])
    np.testing.assert_allclose(baseline.mean_pose(poses), pose([0.0, 0.0, 0.0], [0.0, 0.0, 1.0]), atol=1e-12)


def sightings_of(m_T_f, side_m):
    corners = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]]) * side_m
    for marker in A4.markers:
        m_T_marker = m_T_f @ baseline.marker_on_page(marker)
        points = m_T_marker[:3, :3] @ np.c_[corners, np.zeros(4)].T + m_T_marker[:3, 3:]
        pixels = (CAMERA.K @ points)[:2] / points[2]
        yield MarkerSighting(
            0, "m_left", "f0", marker.id, pixels.T.copy(), np.tile(0.01 * np.eye(2), (4, 1, 1)), pixels.T.copy()
        )


@pytest.mark.parametrize("choice", ["one_marker", "mean"])
@pytest.mark.parametrize("typed_side_m", [0.075, 0.05])
def test_exact_corners_give_the_exact_board_also_with_the_side_typed_wrong(choice, typed_side_m):
    # The page seen from its front: its y axis up in the image, its z axis towards the camera.
    m_T_f = pose([0.0, 0.3, 0.0], [0.1, -0.05, 1.1]) @ pose([np.pi, 0.0, 0.0], [0.0, 0.0, 0.0])
    poses = [paper_chain.marker_pose(sighting, CAMERA, typed_side_m) for sighting in sightings_of(m_T_f, 0.075)]
    view = baseline.BoardView(0, "f0", (0, 1, 2, 3), np.array(poses))
    factor = baseline.board_scale(view, A4)
    assert factor == pytest.approx(0.075 / typed_side_m, rel=1e-6)
    np.testing.assert_allclose(baseline.board_pose(view, A4, factor, choice), m_T_f, atol=1e-5)


def test_the_whole_chain_returns_the_point_when_every_measurement_is_exact():
    o_T_f = pose([0.0, 0.3, 0.0], [0.1, -0.05, 1.1]) @ pose([np.pi, 0.0, 0.0], [0.0, 0.0, 0.0])
    f_T_b = baseline.pose_matrix(RIG.mount.f_T_b)
    view = baseline.BoardView(0, "f0", (1,), (o_T_f @ baseline.marker_on_page(A4.markers[1]))[None])
    steps = [np.eye(4), pose([0.0, 0.4, 0.0], [0.3, 0.0, 0.1]), pose([0.1, 0.4, 0.0], [0.3, 0.1, -0.2])]
    frames = [frame(index * 50, step) for index, step in enumerate(steps)]
    o_T_m = steps[1] @ steps[2]
    b_point = np.array([0.2, 0.1, 1.7])
    m_point = (baseline.invert(o_T_m) @ o_T_f @ f_T_b @ np.r_[b_point, 1.0])[:3]
    click = baseline.ClickedPoint(pick(100, [0.0, 0.0]), m_point)
    (answer,) = baseline.paper_chain(view, frames, [click], RIG)
    np.testing.assert_allclose(answer.position_b_m, b_point, atol=1e-9)


def test_click_from_tracks_takes_the_median_disparity_of_the_nearest():
    left_px = np.array([[180.0, 120.0], [182.0, 121.0], [178.0, 119.0], [20.0, 20.0]])
    right_px = left_px - [[27.0, 0.0], [27.0, 0.0], [100.0, 0.0], [3.0, 0.0]]
    click = baseline.click_from_tracks(
        pick(0, [179.5, 119.5]), frame(0, np.eye(4), left_px, right_px), CAMERA.K, 0.15, 3
    )
    np.testing.assert_allclose(click.position_m, [0.0, 0.0, 1.5], atol=1e-9)


def test_click_without_depth_is_an_answer_with_a_reason():
    click = baseline.click_from_tracks(pick(0, [179.5, 119.5]), frame(0, np.eye(4)), CAMERA.K, 0.15)
    view = baseline.BoardView(0, "f0", (0,), pose([np.pi, 0.0, 0.0], [0.0, 0.0, 1.0])[None])
    (answer,) = baseline.paper_chain(view, [frame(0, np.eye(4))], [click], RIG)
    assert answer.position_b_m is None
    assert "no stereo depth" in answer.reason


def test_the_axis_lies_one_radius_behind_the_surface():
    click = baseline.ClickedPoint(pick(0, [0.0, 0.0], role="cut"), np.array([0.0, 0.6, 0.8]))
    np.testing.assert_allclose(baseline.behind_surface(click, 0.05).position_m, [0.0, 0.63, 0.84])
    surface = baseline.ClickedPoint(pick(0, [0.0, 0.0]), np.array([0.0, 0.6, 0.8]))
    assert baseline.behind_surface(surface, 0.05) is surface


def test_missing_links_are_named():
    with pytest.raises(ObservabilityError, match="board was never seen"):
        baseline.paper_chain(None, [], [], RIG)
    view = baseline.BoardView(0, "f0", (0,), np.eye(4)[None])
    with pytest.raises(ObservabilityError, match="no stereo odometry"):
        baseline.paper_chain(view, [], [], RIG)
    with pytest.raises(RigError, match="mount"):
        baseline.paper_chain(view, [frame(0, np.eye(4))], [], Rig(boards=(A4,)))


@pytest.mark.parametrize("depth_m", [0.9, 1.8])
def test_clicked_depth_of_a_textured_wall(depth_m):
    rng = np.random.default_rng(1)
    coarse = rng.integers(0, 255, (60, 130), dtype=np.uint8)
    texture = cv2.resize(coarse, (520, 240), interpolation=cv2.INTER_CUBIC)
    disparity_px = 270.0 * 0.15 / depth_m
    columns = np.arange(360, dtype=np.float32)[None].repeat(240, 0)
    rows = np.arange(240, dtype=np.float32)[:, None].repeat(360, 1)
    left = cv2.remap(texture, columns + 80, rows, cv2.INTER_LINEAR)
    right = cv2.remap(texture, columns + np.float32(80 + disparity_px), rows, cv2.INTER_LINEAR)
    right_camera = CameraModel("m_right", 360, 240, CAMERA.K, "none", np.zeros(0), np.eye(3), 0.15)
    point = paper_chain.clicked_point(left, right, CAMERA, right_camera, np.array([179.5, 119.5]))
    np.testing.assert_allclose(point, [0.0, 0.0, depth_m], atol=0.01 * depth_m)
    blank = np.full((240, 360), 128, dtype=np.uint8)
    assert paper_chain.clicked_point(blank, blank, CAMERA, right_camera, np.array([179.5, 119.5])) is None
