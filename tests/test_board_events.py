"""What is wrong with a board is named, with size and sigma, and does not bend the estimate."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from board_scene import STEP_NS, board_before, lens, page, pair, right_of, seen, seen_by_pair
from scipy.stats import chi2

from surecut.estimator.bundle import bundles
from surecut.estimator.engine import Engine
from surecut.estimator.run import estimate
from surecut.estimator.surfaces import lay_on_surfaces
from surecut.estimator.view_cells import added_covariance
from surecut.factors.rig import Board, Marker, Rig
from surecut.simulation.campaign_estimate import estimate_run
from surecut.simulation.measurement_level import draw
from surecut.simulation.measurement_level_scenario import Scenario

START_NS = 1_000_000_000
SHORT = {"motion": {"duration_s": 14.0, "board_share": 0.4}, "clouds": {"frames": 1, "points": 50}}
CORNERS = {"noise": {"marker_common_px": 0.03}}
"""Corners of an ordinary detector: every place has an error of its own that does not average out."""
SINGLE = {"boards": [{"id": "f0", "markers": [{"id": 0, "centre_m": [0.0, 0.0]}]}]}
BOARD_EVENTS = {
    "side_length_wrong", "print_scale_wrong", "markers_swapped", "marker_duplicated", "marker_loose", "board_knocked",
    "corner_inset", "ambiguous_start",
}  # fmt: skip


def run_of(seed, **more):
    run = draw(Scenario.model_validate({**SHORT, **more, "rig": {**CORNERS, **more.get("rig", {})}}), seed)
    return run, estimate_run(run)


def told(result, kind):
    return [event for event in result.events if event.kind == kind]


def assert_only(result, kind):
    assert {e.kind for e in result.events} & BOARD_EVENTS == {kind}, [e.text for e in result.events]


@cache
def faultless(seed, single=False):
    """Errors of the points of a run in which nothing is wrong, m."""
    run, result = run_of(seed, **({"rig": SINGLE} if single else {}))
    return {p.id: float(np.linalg.norm(p.position_m - run.truth.points_b_m[p.id])) for p in result.points}


def assert_not_bent(run, result, single=False):
    """Every point within its own 3 sigma ellipsoid (as a chi-square of the same probability), and not farther off
    than without the fault by more than what the fault costs: its own one-sigma radius."""
    assert result.consistency.passed, result.consistency.reasons
    for point in result.points:
        error = point.position_m - run.truth.points_b_m[point.id]
        assert error @ np.linalg.solve(point.covariance_m2, error) < chi2.isf(0.0027, 3)
        assert np.linalg.norm(error) < faultless(2, single)[point.id] + np.sqrt(np.trace(point.covariance_m2))


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_clean_runs_have_no_events(seed):
    run, result = run_of(seed)
    assert not {e.kind for e in result.events} & BOARD_EVENTS
    assert_not_bent(run, result)


def test_side_length_typed_wrong():
    run, result = run_of(2, typed_side_m=0.05)
    assert_only(result, "side_length_wrong")
    (event,) = told(result, "side_length_wrong")
    assert event.text.startswith("board f0: the rig says side 50.0 mm, the log says 7")
    assert event.text.endswith("used the log's")
    true = run.truth.rig.boards["f0"].side_m
    assert 0.0 < event.values["sigma_m"] < 5e-4
    assert abs(event.values["seen_m"] - true) < 3 * event.values["sigma_m"]
    assert any(r.what == "side of board f0" for r in result.rejected)
    assert_not_bent(run, result)


def test_wrong_side_and_loose_marker_together():
    run, result = run_of(2, typed_side_m=0.05, board={"loose": 1})
    assert {e.kind for e in result.events} & BOARD_EVENTS == {"side_length_wrong", "marker_loose"}
    (side,), (loose,) = told(result, "side_length_wrong"), told(result, "marker_loose")
    assert abs(side.values["seen_m"] - run.truth.rig.boards["f0"].side_m) < 3 * side.values["sigma_m"]
    assert loose.values["marker"] == 1.0
    assert_not_bent(run, result)


def test_side_length_of_a_single_marker_comes_from_stereo():
    run, result = run_of(2, typed_side_m=0.05, rig=SINGLE)
    assert_only(result, "side_length_wrong")
    (event,) = told(result, "side_length_wrong")
    assert abs(event.values["seen_m"] - run.truth.rig.boards["f0"].side_m) < 3 * event.values["sigma_m"]
    assert_not_bent(run, result, single=True)


def test_page_printed_too_small():
    run, result = run_of(2, board={"page_scale": 0.97})
    assert_only(result, "print_scale_wrong")
    (event,) = told(result, "print_scale_wrong")
    assert abs(event.values["scale"] - run.truth.rig.boards["f0"].print_scale) < 3 * event.values["sigma"]
    assert_not_bent(run, result)


def test_two_markers_in_each_others_place():
    run, result = run_of(2, board={"swapped": [0, 3]})
    assert_only(result, "markers_swapped")
    (event,) = told(result, "markers_swapped")
    assert (event.values["marker"], event.values["other"]) == (0.0, 3.0)
    assert abs(event.values["shift_m"] - np.hypot(0.1, 0.18)) < 1e-3
    assert_not_bent(run, result)


@pytest.mark.parametrize(("at_s", "shift_m"), [(0.0, 0.006), (2.0, 0.006), (0.0, 0.002)])
def test_marker_out_of_place(at_s, shift_m):
    board = {"loose": 1, "loose_at_s": at_s, "loose_shift_m": [shift_m, 0.0], "loose_turn_rad": 0.0}
    run, result = run_of(2, board=board)
    assert_only(result, "marker_loose")
    (event,) = told(result, "marker_loose")
    assert event.values["marker"] == 1.0
    assert abs(event.values["shift_m"] - shift_m) < 3 * event.values["sigma_m"]
    assert event.stamp_ns >= run.truth.stamps_ns[0] + 1e9 * at_s
    assert_not_bent(run, result)


def test_knock_while_the_board_is_in_view():
    run, result = run_of(2, board={"knock_at_s": 2.0})
    assert_only(result, "board_knocked")
    (event,) = told(result, "board_knocked")
    assert event.values["before_ns"] - run.truth.stamps_ns[0] < 2e9 <= event.stamp_ns - run.truth.stamps_ns[0]
    assert event.stamp_ns - event.values["before_ns"] <= 1e9  # keyframes at rest are a second apart
    assert abs(event.values["moved_m"] - np.hypot(0.02, 0.01)) < 3 * event.values["moved_sigma_m"]
    assert abs(event.values["turned_rad"] - 0.06) < 3 * event.values["turned_sigma_rad"]
    assert "mount (f_T_b) holds for the time before only" in event.text
    assert_not_bent(run, result)


def test_an_id_twice_in_one_image():
    run = draw(Scenario.model_validate(SHORT), 2)
    others = [m for m in run.measurements if getattr(m, "marker", None) == 2]
    away = [replace(m, corners_px=m.corners_px + np.array([60.0, 0.0])) for m in others]
    doubled = replace(run, measurements=(*run.measurements, *away))
    result = estimate_run(doubled)
    assert_only(result, "marker_duplicated")
    (event,) = told(result, "marker_duplicated")
    # 60 px aside is another length on the page in every view
    assert 0.02 < event.values["shift_m"] < 0.5
    assert 0.0 < event.values["sigma_m"] < event.values["shift_m"]
    assert event.stamp_ns == min(m.stamp_ns for m in others)
    assert len([r for r in result.rejected if "more than once" in r.reason]) >= len(others)
    assert_not_bent(run, result)


# Corner inset ---------------------------------------------------------------------------------------------------


def boards_alone(inset_px, distances_m, seed):
    """One board before a stereo pair at several distances: the result, and relative depth errors."""
    rng, board, cameras, measurements, true = np.random.default_rng(seed), page(), pair(), [], {}
    for k, distance_m in enumerate(distances_m):
        stamp_ns = START_NS + k * STEP_NS
        true[stamp_ns] = board_before(distance_m, rng.uniform(10, 40), rng.uniform(0, 360), rng.uniform(0, 360))
        measurements += seen_by_pair(board, cameras, true[stamp_ns], stamp_ns, rng, sigma_px=0.3, inset_px=inset_px)
    result = estimate(measurements, Rig(boards=(board,)), cameras, lay_on_surfaces)
    o_T_f = next(p.matrix for p in result.poses if p.name == "f0")
    o_T_m = {p.stamp_ns: p.matrix for p in result.trajectory}
    assert len(o_T_m) == len(true)
    errors = [(np.linalg.inv(o_T_m[t]) @ o_T_f)[2, 3] / pose[2, 3] - 1 for t, pose in true.items()]
    insets = {c.name: c for c in result.calibration if c.name.endswith("corner_inset")}
    return result, np.array(errors), insets


def test_corner_inset_is_told_from_the_side_by_views_of_different_size():
    result, errors, insets = boards_alone(0.3, np.geomspace(0.56, 3.3, 12), 0)
    assert_only(result, "corner_inset")
    assert np.abs(errors).max() < 0.005
    for camera in ("m_left", "m_right"):
        row = insets[f"f0.{camera}.corner_inset"]
        assert not row.frozen
        assert abs(row.value - 0.3) < 3 * row.sigma < 0.15


def test_corner_inset_stays_frozen_where_all_views_have_one_size():
    result, errors, insets = boards_alone(0.3, np.full(12, 1.5), 0)
    assert not {e.kind for e in result.events} & BOARD_EVENTS
    assert all(row.frozen for row in insets.values())
    assert np.abs(errors).max() < 0.005


# First pose -----------------------------------------------------------------------------------------------------


def test_nothing_starts_from_a_single_frontal_marker():
    board = Board(id="f0", markers=(Marker(id=0, centre_m=(0.0, 0.0)),))
    cameras, rng = pair(width=360, height=240, focal=270.0), np.random.default_rng(4)
    engine = Engine(Rig(boards=(board,)), cameras, lay_on_surfaces)
    measurements = []
    for k in range(4):
        measurements += seen(board, cameras["m_left"], board_before(1.2, 5.0, 50.0), START_NS + k * STEP_NS, rng)
    for bundle in bundles(measurements):
        engine.add(bundle)
    assert not engine.boards.known("f0")
    assert engine.odometry.last_keyframe < 0
    near = board_before(0.3, 35.0, 50.0)
    for bundle in bundles(seen(board, cameras["m_left"], near, START_NS + 5 * STEP_NS, rng)):
        engine.add(bundle)
    assert engine.boards.known("f0")
    got = engine.state.pose(engine.boards.key("f0")).matrix()
    assert np.arccos(got[:3, 2] @ near[:3, 2]) < np.deg2rad(3.0)
    assert not engine.boards.events


def test_a_page_does_not_start_from_one_of_its_markers():
    board, cameras, rng = page(), pair(), np.random.default_rng(5)
    engine = Engine(Rig(boards=(board,)), cameras, lay_on_surfaces)
    tilted = board_before(0.8, 35.0, 20.0)
    for bundle in bundles(seen(board, cameras["m_left"], tilted, START_NS, rng, only={2})):
        engine.add(bundle)
    assert not engine.boards.known("f0")
    for bundle in bundles(seen(board, cameras["m_left"], tilted, START_NS + STEP_NS, rng)):
        engine.add(bundle)
    assert engine.boards.known("f0")


# The machine's colour camera ------------------------------------------------------------------------------------


@pytest.mark.parametrize("machine_first", [True, False])
def test_a_board_in_the_colour_image_places_the_machine(machine_first):
    """No mount: {b} hangs on a board that both cameras see, whoever sees it first."""
    board, rng = page(attached_to="world"), np.random.default_rng(6)
    cameras = {**pair(), "b_rgb": lens("b_rgb", 640, 480, 525.0)}
    rgb_T_f, measurements, views = board_before(1.4, 25.0, 120.0), [], []
    for k in range(6):
        stamp_ns = START_NS + k * STEP_NS
        views.append(board_before(0.9 + 0.1 * k, 20.0, 60.0 * k))
        measurements += seen_by_pair(board, cameras, views[-1], stamp_ns, rng)
    for k in range(3):
        stamp_ns = START_NS + (-3 + k if machine_first else 10 + k) * STEP_NS
        measurements += seen(board, cameras["b_rgb"], rgb_T_f, stamp_ns, rng)
    result = estimate(measurements, Rig(boards=(board,)), cameras, lay_on_surfaces)
    base = next(p for p in result.poses if p.name == "b")
    true = views[0] @ np.linalg.inv(rgb_T_f)
    error = base.matrix[:3, 3] - true[:3, 3]
    assert error @ np.linalg.solve(base.covariance[:3, :3], error) < chi2.isf(0.0027, 3)
    assert np.sqrt(np.diag(base.covariance[:3, :3])).max() < 0.05
    assert not {e.kind for e in result.events} & BOARD_EVENTS


def test_a_board_that_only_the_machine_sees_is_placed_by_it():
    near, far = page("f0"), page("f1", ids=(4, 5, 6, 7), attached_to="world")
    cameras, rng = {**pair(), "b_rgb": lens("b_rgb", 640, 480, 525.0)}, np.random.default_rng(7)
    rgb_T_f0, rgb_T_f1 = (
        board_before(1.4, 25.0, 120.0, aside_m=(-0.3, 0.0)),
        board_before(1.2, 20.0, 40.0, aside_m=(0.3, 0.0)),
    )
    measurements, left_T_f0 = [], board_before(0.9, 20.0, 10.0)
    for k in range(3):
        stamp_ns = START_NS + k * STEP_NS
        measurements += seen_by_pair(near, cameras, left_T_f0, stamp_ns, rng)
        measurements += seen(near, cameras["b_rgb"], rgb_T_f0, stamp_ns, rng)
        measurements += seen(far, cameras["b_rgb"], rgb_T_f1, stamp_ns, rng)
    result = estimate(measurements, Rig(boards=(near, far)), cameras, lay_on_surfaces)
    placed = next(p for p in result.poses if p.name == "f1")
    true = left_T_f0 @ np.linalg.inv(rgb_T_f0) @ rgb_T_f1
    error = placed.matrix[:3, 3] - true[:3, 3]
    assert error @ np.linalg.solve(placed.covariance[:3, :3], error) < chi2.isf(0.0027, 3)


def test_right_camera_helper_agrees_with_the_baseline():
    assert right_of(board_before(1.0))[0, 3] == pytest.approx(-0.15)


# Views from one place -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("own", "common"), [(0.02, 0.01), (0.01, 0.03), (0.1, 0.001)])
def test_views_from_one_place_add_up_to_what_their_mean_knows(own, common):
    """n views with own part s and common part c: the mean has the variance c^2 + s^2 / n, in closed form."""
    s2, c2 = own**2, common**2
    total = np.tile((s2 + c2) * np.eye(2), (4, 1, 1))
    added = [added_covariance(total, common, n) for n in range(1, 9)]
    for n, covariance in enumerate(added, start=1):
        closed = (s2 + n * c2) * (s2 + (n - 1) * c2) / s2
        np.testing.assert_allclose(covariance, np.tile(closed * np.eye(2), (4, 1, 1)), rtol=1e-9)
        information = sum(1.0 / a[0, 0, 0] for a in added[:n])
        assert 1.0 / information == pytest.approx(c2 + s2 / n, rel=1e-9)


def test_oblique_covariances_of_views_add_up_too():
    rng = np.random.default_rng(0)
    A = rng.normal(size=(4, 2, 2))
    total = A @ A.transpose(0, 2, 1) * 1e-4 + 4e-4 * np.eye(2)
    S, C = total - 1e-4 * np.eye(2), 1e-4 * np.eye(2)
    information = sum(np.linalg.inv(added_covariance(total, 0.01, n)) for n in range(1, 7))
    np.testing.assert_allclose(np.linalg.inv(information), S / 6 + C, rtol=1e-9)


def test_a_common_part_that_is_nearly_all_leaves_the_view_a_tenth():
    total = 1e-4 * np.eye(2)[None]
    np.testing.assert_allclose(added_covariance(total, 0.01, 1), total)
    np.testing.assert_allclose(added_covariance(total, 0.01, 2), 1.9 * total / 0.1 * 1.0, rtol=1e-9)
