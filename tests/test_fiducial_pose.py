"""Poses of a board in one image, the side that it shows, and markers that are not where they should be."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from fiducial_scenes import a4_board, camera, pose, sightings_of, turn_between_deg

from surecut.factors.errors import ObservabilityError
from surecut.factors.rig import Board, Marker
from surecut.frontends.board_check import suspicious_markers
from surecut.frontends.board_pose import apparent_side, board_pose_candidates

LENS = camera(360, 240, 270)
SIGMA = 0.1


def normalised_error(candidate, true):
    """Squared error of the pose in the tangent of the estimate, against its covariance."""
    apart = np.linalg.inv(candidate.camera_T_f) @ true
    vector = np.concatenate([cv2.Rodrigues(apart[:3, :3])[0].ravel(), apart[:3, 3]])
    return vector @ np.linalg.solve(candidate.covariance, vector)


def test_board_pose_and_its_covariance():
    rng = np.random.default_rng(1)
    errors = []
    for k in range(200):
        true = pose(30.0, 9.0 * k, 5.0 * k, [0.05, -0.02, 0.9])
        seen = sightings_of(a4_board(), LENS, true, rng, SIGMA)
        best = board_pose_candidates(seen, a4_board(), LENS, 0.075, common_px=0.0)[0]
        assert not best.ambiguous
        errors.append(normalised_error(best, true) / 6)
    assert 0.8 < np.mean(errors) < 1.25


def test_one_frontal_marker_is_ambiguous_and_a_tilted_near_one_is_not():
    board = Board(id="f0", markers=(Marker(id=0, centre_m=(0.0, 0.0)),))
    rng = np.random.default_rng(2)
    far = pose(8.0, 40.0, 10.0, [0.0, 0.0, 1.5])
    both = board_pose_candidates(sightings_of(board, LENS, far, rng, SIGMA), board, LENS, 0.075)
    assert len(both) == 2
    assert all(c.ambiguous for c in both)
    assert min(normalised_error(c, far) for c in both) < 40.0
    near = pose(40.0, 40.0, 10.0, [0.0, 0.0, 0.25])
    one = board_pose_candidates(sightings_of(board, LENS, near, rng, SIGMA), board, LENS, 0.075)
    assert len(one) == 1
    assert not one[0].ambiguous
    assert turn_between_deg(one[0].camera_T_f, near) < 2.0


def test_the_true_pose_is_always_among_the_candidates():
    board = Board(id="f0", markers=(Marker(id=0, centre_m=(0.0, 0.0)),))
    rng = np.random.default_rng(3)
    for _ in range(100):
        tilt, about, roll = rng.uniform(0, 60), rng.uniform(0, 360), rng.uniform(0, 360)
        true = pose(tilt, about, roll, [0.0, 0.0, rng.uniform(0.3, 2.0)])
        candidates = board_pose_candidates(
            sightings_of(board, LENS, true, rng, SIGMA), board, LENS, 0.075, common_px=0.0
        )
        assert min(normalised_error(c, true) for c in candidates) < 60.0


@pytest.mark.parametrize("typed", [0.05, 0.075, 0.11])
def test_the_side_that_the_image_shows(typed):
    rng = np.random.default_rng(4)
    board = a4_board(side_m=typed)
    normalised = []
    for k in range(40):
        true = pose(20.0, 11.0 * k, 7.0 * k, [0.0, 0.0, 0.8])
        side, sigma = apparent_side(
            sightings_of(board, LENS, true, rng, SIGMA, side_m=0.075), board, LENS, common_px=0.0
        )
        normalised.append((side - 0.075) / sigma)
        assert side == pytest.approx(0.075, abs=0.002)
    assert 0.6 < np.mean(np.square(normalised)) < 1.6


def test_one_marker_shows_no_side():
    board = Board(id="f0", markers=(Marker(id=0, centre_m=(0.0, 0.0)),))
    with pytest.raises(ObservabilityError, match="f0"):
        apparent_side(
            sightings_of(board, LENS, pose(20, 0, 0, [0, 0, 1]), np.random.default_rng(0), SIGMA), board, LENS
        )


def test_an_honest_board_raises_no_suspicion():
    rng = np.random.default_rng(5)
    for k in range(40):
        true = pose(25.0, 9.0 * k, 3.0 * k, [0.0, 0.0, 0.8])
        assert suspicious_markers(sightings_of(a4_board(), LENS, true, rng, SIGMA), a4_board(), LENS, 0.075) == []


def test_a_loose_marker_is_named_with_its_shift():
    rng = np.random.default_rng(6)
    true = pose(25.0, 40.0, 3.0, [0.0, 0.0, 0.6])
    found = suspicious_markers(
        sightings_of(a4_board(), LENS, true, rng, SIGMA, moved={2: (0.006, -0.003)}), a4_board(), LENS, 0.075
    )
    assert [(s.marker, s.kind) for s in found] == [(2, "moved")]
    np.testing.assert_allclose(found[0].shift_m, (0.006, -0.003), atol=4 * found[0].shift_sigma_m)
    assert found[0].shift_sigma_m < 0.001
    assert found[0].chi2 > found[0].limit


def test_exchanged_ids_are_named():
    rng = np.random.default_rng(7)
    seen = sightings_of(a4_board(), LENS, pose(25.0, 40.0, 3.0, [0.0, 0.0, 0.6]), rng, SIGMA)
    exchanged = {1: 3, 3: 1}
    seen = [replace(s, marker=exchanged.get(s.marker, s.marker)) for s in seen]
    found = suspicious_markers(seen, a4_board(), LENS, 0.075)
    assert sorted((s.marker, s.kind, s.other) for s in found) == [(1, "swapped", 3), (3, "swapped", 1)]


def test_an_id_that_is_there_twice():
    rng = np.random.default_rng(8)
    seen = sightings_of(a4_board(), LENS, pose(25.0, 40.0, 3.0, [0.0, 0.0, 0.6]), rng, SIGMA)
    seen[3] = replace(seen[3], marker=0)
    found = suspicious_markers(seen, a4_board(), LENS, 0.075)
    assert [(s.marker, s.kind) for s in found] == [(0, "duplicate")]


def test_two_markers_cannot_tell_which_is_wrong():
    rng = np.random.default_rng(9)
    true = pose(25.0, 40.0, 3.0, [0.0, 0.0, 0.6])
    seen = sightings_of(a4_board(), LENS, true, rng, SIGMA, moved={0: (0.01, 0.0)})[:2]
    assert {(s.marker, s.kind) for s in suspicious_markers(seen, a4_board(), LENS, 0.075)} == {
        (0, "inconsistent"),
        (1, "inconsistent"),
    }
