"""Wrong rigs on rendered pixels, through detector and estimator: each is named with its size, and bends nothing."""

from functools import cache

import cv2
import numpy as np
import pytest
from board_scene import BASELINE_M, STEP_NS, board_before, page, pair, right_of
from scipy.stats import chi2

from surecut.estimator.bundle import bundles
from surecut.estimator.engine import Engine
from surecut.estimator.optimise import optimise
from surecut.estimator.run import finish
from surecut.estimator.surfaces import lay_on_surfaces
from surecut.factors.rig import Marker, Rig
from surecut.frontends.fiducials.detector import MarkerFrontEnd
from surecut.simulation.campaign_pixels import truth_of_log
from surecut.simulation.marker_images import Photography, project, render_board
from surecut.simulation.recording import simulate
from surecut.simulation.scenario import Scenario
from surecut.simulation.session import stamp_ns

pytestmark = pytest.mark.campaign

START_NS = 1_000_000_000
FRAMES = 20
"""Four seconds at 5 Hz."""
PAGE_M = (0.210, 0.297)
KNOCKED = {
    "name": "knocked",
    "place": "B",
    "duration_s": 20,
    "return_to_board": False,
    "mobile": {"rate_hz": 5},
    "kinect": {"rate_hz": 0.2, "width": 160, "height": 120, "depth_focal_px": 146.25, "rgb_focal_px": 131.25},
    "board": {"knock": {"at_s": 2.0}},
}
BOARD_EVENTS = {
    "side_length_wrong", "print_scale_wrong", "markers_swapped", "marker_duplicated", "marker_loose", "board_knocked",
    "corner_inset", "ambiguous_start",
}  # fmt: skip


def printed(board, scale=1.0, side_m=0.075, swapped=(), loose=None):
    """The page that was really printed."""
    shift = {} if loose is None else {loose[0]: np.array(loose[1])}
    turn = 0.0 if loose is None else loose[2]
    other = dict([swapped, swapped[::-1]]) if swapped else {}
    markers = tuple(
        Marker(
            id=other.get(m.id, m.id),
            centre_m=tuple(scale * np.array(m.centre_m) + shift.get(m.id, 0.0)),
            rotation_rad=turn if m.id in shift else 0.0,
        )
        for m in board.markers
    )
    return board.model_copy(update={"markers": markers, "side_m": scale * side_m})


def views():
    """`left_T_f` of a hand that moves the camera round the board, 0.6 to 1.3 m away."""
    for k in range(FRAMES):
        yield board_before(0.6 + 0.035 * k, 25.0 + 0.5 * k, 14.0 * k, 20.0 + 4.0 * k)


def pasted(image, camera, camera_T_f, marker_centre_m):
    """One marker of the page copied to a place beside the page."""
    reach = 0.05
    square = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * reach + [*marker_centre_m, 0.0]
    low, high = np.floor([(p := project(camera, camera_T_f, square)).min(0), p.max(0)]).astype(int)
    size, image = high - low, image.copy()
    image[5 : 5 + size[1], 5 : 5 + size[0]] = image[low[1] : high[1], low[0] : high[0]]
    return image


def shown(boards, poses, camera, rng):
    """Pages before a grey wall, the later ones in front."""
    photography = Photography(blur_px=0.7, noise=1.5, gamma=1.4, shading=(0.1, -0.1))
    image = np.full((camera.height, camera.width), 110, np.uint8)
    outline = np.array([[-0.5, -0.5, 0], [0.5, -0.5, 0], [0.5, 0.5, 0], [-0.5, 0.5, 0]]) * [*PAGE_M, 0]
    for board, camera_T_f in zip(boards, poses, strict=True):
        one = render_board(board, PAGE_M, camera, camera_T_f, photography, rng)
        mask = np.zeros(image.shape, np.uint8)
        cv2.fillConvexPoly(mask, np.rint(project(camera, camera_T_f, outline)).astype(np.int32), 1)
        image = np.where(cv2.dilate(mask, np.ones((7, 7), np.uint8)) > 0, one, image)
    return image


def run(rig, true, moved=lambda k: np.eye(4), doubled=None, size=(640, 480, 500.0), fixed=()):
    """Result of a recording: `true` is the first board as printed, `fixed` others with their places in {f} of the
    first one before it was moved."""
    cameras = pair(width=size[0], height=size[1], focal=size[2])
    eyes = {name: MarkerFrontEnd(rig, camera, name) for name, camera in cameras.items()}
    rng, measurements, rejections, poses = np.random.default_rng(1), [], [], {}
    for k, left_T_f in enumerate(views()):
        stamp_ns = START_NS + k * STEP_NS
        poses[stamp_ns] = left_T_f
        for name, camera in cameras.items():
            eye_T_f = left_T_f if name == "m_left" else right_of(left_T_f)
            places = [eye_T_f @ f_T_other for _, f_T_other in fixed] + [eye_T_f @ moved(k)]
            image = shown([*(board for board, _ in fixed), true], places, camera, rng)
            if doubled is not None:
                image = pasted(image, camera, eye_T_f, true.markers[doubled].centre_m)
            sightings, refused = eyes[name].process(stamp_ns, image)
            measurements += sightings
            rejections += refused
    engine = Engine(rig, cameras, lay_on_surfaces)
    for bundle in bundles(measurements):
        engine.add(bundle)
    result = finish(engine, rejected=rejections)
    return result, rejections, poses


def told(result, kind):
    assert {e.kind for e in result.events} & BOARD_EVENTS == {kind}, [e.text for e in result.events]
    (event,) = (e for e in result.events if e.kind == kind)
    return event


def depth_errors(result, poses):
    o_T_f = next(p.matrix for p in result.poses if p.name == "f0")
    return np.array([(np.linalg.inv(p.matrix) @ o_T_f)[2, 3] / poses[p.stamp_ns][2, 3] - 1 for p in result.trajectory])


@cache
def faultless():
    result, _, poses = run(Rig(boards=(page(),)), page())
    assert not {e.kind for e in result.events} & BOARD_EVENTS
    return depth_errors(result, poses)


def assert_not_bent(result, poses):
    """Depth of the board in every view: as without the fault, to a third of a per cent, and right to one half."""
    errors = depth_errors(result, poses)
    assert len(errors) == FRAMES
    assert np.abs(errors).max() < 0.005
    assert np.abs(errors - faultless()).max() < 0.0035


def test_clean_pixels_have_no_events():
    assert np.abs(faultless()).max() < 0.005


def test_side_typed_as_50_mm():
    result, _, poses = run(Rig(boards=(page(side_m=0.05),)), page())
    event = told(result, "side_length_wrong")
    assert 0.0 < event.values["sigma_m"] < 1e-3
    assert abs(event.values["seen_m"] - 0.075) < 3 * event.values["sigma_m"]
    assert_not_bent(result, poses)


def test_page_printed_at_97_per_cent():
    """The baseline is what tells: it has to be known better than the printer errs."""
    rig = Rig(boards=(page(),))
    stereo = rig.stereo.model_copy(update={"baseline_sigma_rel": 0.002})
    result, _, poses = run(rig.model_copy(update={"stereo": stereo}), printed(page(), scale=0.97))
    event = told(result, "print_scale_wrong")
    assert 0.0 < event.values["sigma"] < 0.01
    assert abs(event.values["scale"] - 0.97) < 3 * event.values["sigma"]
    assert np.abs(depth_errors(result, poses)).max() < 0.006


def test_two_ids_exchanged():
    result, _, poses = run(Rig(boards=(page(),)), printed(page(), swapped=(0, 3)))
    event = told(result, "markers_swapped")
    assert (event.values["marker"], event.values["other"]) == (0.0, 3.0)
    assert abs(event.values["shift_m"] - np.hypot(0.1, 0.18)) < 1e-3
    assert_not_bent(result, poses)


def test_one_id_twice():
    result, rejections, poses = run(Rig(boards=(page(),)), page(), doubled=2)
    event = told(result, "marker_duplicated")
    assert event.values["marker"] == 2.0
    assert 0.05 < event.values["shift_m"] < 1.5
    assert 0.0 < event.values["sigma_m"] < event.values["shift_m"]
    assert event.stamp_ns == min(r.stamp_ns for r in rejections if "more than once" in r.reason)
    assert any("more than once" in r.reason for r in rejections)
    assert_not_bent(result, poses)


@pytest.mark.parametrize("shift_m", [0.006, 0.002])
def test_marker_that_came_loose(shift_m):
    result, _, poses = run(Rig(boards=(page(),)), printed(page(), loose=(1, (shift_m, 0.0), 0.03)))
    event = told(result, "marker_loose")
    assert event.values["marker"] == 1.0
    assert 0.0 < event.values["sigma_m"] < 0.001
    assert abs(event.values["shift_m"] - shift_m) < 3 * event.values["sigma_m"]
    assert_not_bent(result, poses)


def test_the_pair_is_the_scenes():
    assert right_of(board_before(1.0))[0, 3] == pytest.approx(-BASELINE_M)


@pytest.mark.parametrize(
    "more",
    [
        {},
        # while the camera rests it makes no keyframe; a hand at 5 Hz would be lost by the tracks afterwards
        {"mobile": {"rate_hz": 12}, "timeline": {"still": [[2.0, 7.0]]}, "board": {"knock": {"at_s": 4.0}}},
    ],
    ids=["moving", "at rest"],
)
def test_board_that_is_knocked_in_the_cell(tmp_path, more):
    """With tracks: without anything but boards nobody could say what has moved."""
    log, scenario = tmp_path / "knocked.mcap", {**KNOCKED, **more}
    simulate(log, Scenario.model_validate(scenario), 3)
    result, truth = optimise(log), truth_of_log(log)
    event = told(result, "board_knocked")
    assert event.values["before_ns"] < stamp_ns(scenario["board"]["knock"]["at_s"]) <= event.stamp_ns
    assert abs(event.values["moved_m"] - np.hypot(0.02, 0.01)) < 3 * event.values["moved_sigma_m"] < 0.003
    assert abs(event.values["turned_rad"] - 0.06) < 3 * event.values["turned_sigma_rad"] < 0.02
    assert "mount (f_T_b) holds for the time before only" in event.text
    assert result.consistency.passed, result.consistency.reasons
    assert result.points
    for point in result.points:
        error = point.position_m - truth.points_b_m[point.id]
        assert error @ np.linalg.solve(point.covariance_m2, error) < chi2.isf(0.0027, 3)
