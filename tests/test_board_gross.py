"""Single corners that are grossly wrong are left out, and are not taken for a marker that came loose."""

from dataclasses import replace

import numpy as np
import pytest
from fiducial_scenes import a4_board, camera, pose, sightings_of

from surecut.frontends.board_check import suspicious_markers
from surecut.frontends.board_gross import without_gross_corners
from surecut.simulation.campaign_estimate import estimate_run
from surecut.simulation.measurement_level import draw
from surecut.simulation.measurement_level_scenario import Scenario

LENS = camera(360, 240, 270)
SIGMA, COMMON = 0.1, 0.05


def spoilt(seen, wrong):
    """Sightings with corners thrown elsewhere: {(place in the list, corner): (u, v)}."""
    seen = list(seen)
    for (k, corner), off in wrong.items():
        px = seen[k].corners_px.copy()
        px[corner] += off
        seen[k] = replace(seen[k], corners_px=px)
    return seen


def board_in_view(seed, **more):
    rng = np.random.default_rng(seed)
    return sightings_of(a4_board(), LENS, pose(25.0, 40.0 * seed, 3.0, [0.0, 0.0, 0.8]), rng, SIGMA, **more)


def named(kept):
    return {(s.marker, corner) for s in kept for corner in s.gross}


@pytest.mark.parametrize("side_free", [False, True])
def test_gross_corners_are_named_and_no_others(side_free):
    rng = np.random.default_rng(1)
    for seed in range(12):
        places = [(int(k), int(c)) for k, c in rng.permutation([(k, c) for k in range(4) for c in range(4)])[:3]]
        wrong = {place: rng.choice([-1.0, 1.0], 2) * rng.uniform(2.0, 30.0, 2) for place in places}
        # never three of one marker: that would leave too little of it
        wrong = {p: off for i, (p, off) in enumerate(wrong.items()) if [q[0] for q in places[:i]].count(p[0]) < 2}
        seen = spoilt(board_in_view(seed), wrong)
        start_m = 0.05 if side_free else 0.075
        kept, gross = without_gross_corners(seen, a4_board(), LENS, start_m, COMMON, side_free)
        assert named(kept) == {(seen[k].marker, c) for k, c in wrong}
        assert len(kept) == 4
        assert sorted((g.sighting.marker, g.corner) for g in gross) == sorted(named(kept))
        assert all(g.norm > g.limit for g in gross)
        assert suspicious_markers(kept, a4_board(), LENS, 0.075) == []


def test_a_clean_board_loses_nothing():
    for seed in range(12):
        kept, gross = without_gross_corners(board_in_view(seed), a4_board(), LENS, 0.075, COMMON)
        assert not gross
        assert not named(kept)


def test_a_marker_of_which_too_little_is_left_goes_as_a_whole():
    seen = spoilt(board_in_view(3), {(1, 0): (20.0, 3.0), (1, 1): (-7.0, 15.0), (1, 2): (12.0, -18.0)})
    kept, gross = without_gross_corners(seen, a4_board(), LENS, 0.075, COMMON)
    assert [s.marker for s in kept] == [0, 2, 3]
    assert [(g.sighting.marker, g.corner) for g in gross] == [(1, None)]


def test_a_moved_marker_stays_whole_beside_a_gross_corner():
    """What has moved takes all of its corners along: that is for the check of the board to tell."""
    seen = spoilt(board_in_view(4, moved={2: (0.006, -0.003)}), {(0, 3): (9.0, -14.0)})
    kept, gross = without_gross_corners(seen, a4_board(), LENS, 0.075, COMMON)
    assert named(kept) == {(0, 3)}
    assert len(gross) == 1
    found = suspicious_markers(kept, a4_board(), LENS, 0.075)
    assert [(s.marker, s.kind, s.explained) for s in found] == [(2, "moved", True)]


def test_what_no_shift_explains_is_no_moved_marker():
    seen = spoilt(board_in_view(5), {(1, 0): (12.0, 9.0), (1, 2): (10.0, -11.0)})
    found = suspicious_markers(seen, a4_board(), LENS, 0.075)
    assert [(s.marker, s.explained) for s in found] == [(1, False)]


def test_a_run_with_gross_corners_has_no_loose_marker_and_keeps_the_good_ones():
    short = {"motion": {"duration_s": 14.0, "board_share": 0.4}, "clouds": {"frames": 1, "points": 50}}
    clean = estimate_run(draw(Scenario.model_validate(short), 2))
    outliers = {"share": 0.1, "families": ("markers",)}
    spoilt_run = estimate_run(draw(Scenario.model_validate({**short, "outliers": outliers}), 2))
    assert not [e for e in spoilt_run.events if e.kind == "marker_loose"]
    lost = [r for r in spoilt_run.rejected if r.family == "marker corners"]
    assert lost
    assert all(" corner " in r.what for r in lost)
    for a, b in zip(clean.points, spoilt_run.points, strict=True):
        # a tenth of the corners: five per cent of their share of the radius, if only the bad ones are lost
        assert b.radius95_m < 1.08 * a.radius95_m
        assert np.linalg.norm(a.position_m - b.position_m) < a.radius95_m
