"""A board seen once more, and a second board: carried out in simulation, they leave the uncertainty that was predicted.

The prediction takes for granted that landmarks in view are recognised, so the new keyframe comes at the end and sees
tracks that other keyframes have seen.
"""

from dataclasses import replace

import numpy as np
import pytest

from surecut.estimator.advice import Planner
from surecut.estimator.advice_factors import colour_camera
from surecut.estimator.advice_scene import Surroundings
from surecut.estimator.batch import solve
from surecut.estimator.bundle import bundles
from surecut.estimator.engine import Engine
from surecut.estimator.run import estimate
from surecut.estimator.surfaces import lay_on_surfaces
from surecut.simulation import measurement_level_mobile as mobile
from surecut.simulation.measurement_level import _build_world, draw
from surecut.simulation.measurement_level_machine import clicks, cloud_frames
from surecut.simulation.measurement_level_scenario import Scenario
from surecut.simulation.measurement_level_truth import draw_board, invert, transform

SEED = 3
SCENARIO = Scenario.model_validate({"picks": {"roles": ["cut"]}})


@pytest.fixture(scope="module")
def first():
    """A run, its result, and the planner that gave its advice."""
    run = draw(SCENARIO, SEED)
    result = estimate(run.measurements, run.rig, run.cameras, lay_on_surfaces)
    engine = Engine(run.rig, run.cameras, lay_on_surfaces)
    for bundle in bundles(list(run.measurements)):
        engine.add(bundle)
    engine.state.values = engine.solver.settle()
    solution = solve(engine.solver.log, engine.state.values, run.rig.gates.robust_sigma)
    active = [row for row in engine.solver.log.active() if row[0] not in solution.outliers]
    return run, result, Planner(Surroundings(engine, solution.values, active), 1.0)


def world_of_the_run():
    return _build_world(SCENARIO, np.random.default_rng([SCENARIO.seed, SEED]), np.random.default_rng(0))


def with_one_more_keyframe(world, o_T_m, monkeypatch):
    """The world with a further keyframe, and all stereo frames; the last one sees landmarks that were tracked."""
    track_of = {}
    plain = mobile._stereo_frame

    def noted(world, stamp_ns, w_T_m, ids, left_px, rows, *rest):
        track_of.update(zip(rows.tolist(), ids.tolist(), strict=True))
        return plain(world, stamp_ns, w_T_m, ids, left_px, rows, *rest)

    monkeypatch.setattr(mobile, "_stereo_frame", noted)
    frames = mobile.stereo_frames(world)
    w_T_m = world.w_T_m[0] @ o_T_m
    stamp_ns = world.stamps_ns[-1] + 333_333_333
    px, seen = mobile._landmarks_in_view(world, w_T_m)
    rows = np.array([row for row in np.flatnonzero(seen) if row in track_of])
    rows = rows[world.rng.permutation(len(rows))[: SCENARIO.tracks.per_frame]]
    assert len(rows) > 20
    lives = np.zeros(len(seen), dtype=bool)
    lives[rows] = True
    ids = np.array([track_of[row] for row in rows.tolist()])
    motion = invert(world.w_T_m[-1]) @ w_T_m
    frames.append(plain(world, stamp_ns, w_T_m, ids, px[rows], rows, motion, lives))
    more = replace(world, w_T_m=np.concatenate([world.w_T_m, [w_T_m]]), stamps_ns=(*world.stamps_ns, stamp_ns))
    return more, frames


def advice_of(result, action):
    return next(a for a in result.advice["P1"] if a.action == action)


def test_the_board_seen_again_leaves_what_was_predicted(first, monkeypatch):
    run, result, planner = first
    advice = advice_of(result, "Look at board f0 again")
    assert advice.gain > 0.04  # what a pipe's finish hides of its width stays, whatever the board shows: 0.048
    place = next(p for p in planner.places.before_board(run.rig.boards[0]) if p.text == advice.detail)
    world, frames = with_one_more_keyframe(world_of_the_run(), place.view.o_T_m.matrix(), monkeypatch)
    sightings = mobile.marker_sightings(world)
    assert sum(s.stamp_ns == world.stamps_ns[-1] for s in sightings) == 8
    drawn = [*frames, *sightings, *cloud_frames(world), *clicks(world)]
    after = estimate(drawn, world.rig, run.cameras, lay_on_surfaces).points[0]
    assert after.radius95_m == pytest.approx(advice.predicted_radius95_m, rel=0.2)
    assert after.radius95_m < result.points[0].radius95_m


def test_a_second_board_leaves_what_was_predicted(first, monkeypatch):
    run, result, planner = first
    advice = advice_of(result, "Add a board that both cameras see")
    assert advice.gain > 0.05
    view, o_T_f1, _ = planner.places.between(colour_camera(planner.scene)[0])
    world, frames = with_one_more_keyframe(world_of_the_run(), view.o_T_m.matrix(), monkeypatch)
    page = world.rig.boards[0]
    markers = tuple(marker.model_copy(update={"id": marker.id + 10}) for marker in page.markers)
    second = page.model_copy(update={"id": "f1", "markers": markers})
    world = replace(world, rig=world.rig.model_copy(update={"boards": (page, second)}))
    world.true.boards["f1"] = draw_board(second, world.rng)
    world.w_T_f["f1"] = world.w_T_m[0] @ o_T_f1.matrix()
    stamp_ns = world.stamps_ns[-1]
    sightings = [s for s in mobile.marker_sightings(world) if s.board == "f0" or s.stamp_ns == stamp_ns]
    sightings += seen_by_the_kinect(world, stamp_ns)
    drawn = [*frames, *sightings, *cloud_frames(world), *clicks(world)]
    after = estimate(drawn, world.rig, run.cameras, lay_on_surfaces).points[0]
    assert after.radius95_m == pytest.approx(advice.predicted_radius95_m, rel=0.2)
    assert after.radius95_m < result.points[0].radius95_m


def seen_by_the_kinect(world, stamp_ns):
    """The second board in the Kinect's colour image."""
    board = world.true.boards["f1"]
    found = []
    for marker, corners_f in zip(board.markers, board.corners_m, strict=True):
        corners_w = transform(world.w_T_f["f1"], corners_f)
        exact_px = mobile._whole_marker(
            world, world.true.cameras["b_rgb"], world.scene.w_T_b @ world.true.b_T_rgb, corners_w
        )
        assert exact_px is not None
        found.append(mobile._sighting(world, stamp_ns, "b_rgb", "f1", marker, exact_px))
    return found
