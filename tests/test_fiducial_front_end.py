"""The front end over several images: what it refuses, what it keeps, and where it looks."""

import numpy as np
import pytest
from fiducial_scenes import PAGE_M, a4_board, camera, pose

from surecut.factors.errors import RigError
from surecut.factors.rig import Board, Marker, Rig
from surecut.frontends.fiducials.detector import MarkerFrontEnd
from surecut.frontends.fiducials.messages import sightings_from_messages
from surecut.simulation.marker_images import Photography, marker_corners, project, render_board

LENS = camera(360, 240, 270)
AT = pose(20.0, 30.0, 5.0, [0.0, 0.0, 0.6])


def picture(board, at=AT, lens=LENS, seed=0, **taken):
    return render_board(board, PAGE_M, lens, at, Photography(**taken), np.random.default_rng(seed))


def test_finds_the_board_and_names_it():
    board = a4_board(id="page")
    sightings, rejections = MarkerFrontEnd(Rig(boards=(board,)), LENS, "m_right").process(17, picture(board))
    assert {s.marker for s in sightings} == {0, 1, 2, 3}
    assert {(s.board, s.camera, s.stamp_ns) for s in sightings} == {("page", "m_right", 17)}
    assert not rejections
    for s in sightings:
        assert (np.linalg.eigvalsh(s.covariance_px2) > 0).all()
        np.testing.assert_allclose(s.raw_px, s.corners_px)


def test_colour_images():
    board = a4_board()
    grey = picture(board)
    sightings, _ = MarkerFrontEnd(Rig(boards=(board,)), LENS, "m_left").process(0, np.repeat(grey[..., None], 3, 2))
    assert len(sightings) == 4


def test_unknown_ids_are_told_once():
    sightings, rejections = MarkerFrontEnd(Rig(boards=(a4_board(ids=(0, 1)),)), LENS, "m_left").process(
        0, picture(a4_board())
    )
    assert {s.marker for s in sightings} == {0, 1}
    assert len(rejections) == 1
    assert rejections[0].value == 2


def test_two_dictionaries_and_two_boards():
    other = a4_board("tag36h11", ids=(5, 6, 7, 8), id="f1")
    rig = Rig(boards=(a4_board(), other))
    front_end = MarkerFrontEnd(rig, LENS, "m_left")
    assert {s.board for s in front_end.process(0, picture(a4_board()))[0]} == {"f0"}
    assert {s.marker for s in front_end.process(1, picture(other))[0]} == {5, 6, 7, 8}


def test_a_marker_there_twice_is_decided_by_the_board():
    # the page carries id 0 again in the place of id 3, which the rig does not know
    printed = a4_board(ids=(0, 1, 2, 3))
    image = picture(printed)
    copy = picture(Board(id="x", side_m=0.075, markers=(Marker(id=0, centre_m=(0.05, 0.09)),)))
    corners = project(LENS, AT, marker_corners(printed)[3])
    low, high = np.floor(corners.min(0) - 3).astype(int), np.ceil(corners.max(0) + 4).astype(int)
    image[low[1] : high[1], low[0] : high[0]] = copy[low[1] : high[1], low[0] : high[0]]
    sightings, rejections = MarkerFrontEnd(Rig(boards=(a4_board(ids=(0, 1, 2)),)), LENS, "m_left").process(0, image)
    found = {s.marker: s for s in sightings}
    np.testing.assert_allclose(found[0].corners_px, project(LENS, AT, marker_corners(printed)[0]), atol=0.2)
    assert [r.value for r in rejections] == pytest.approx([np.hypot(0.1, 0.18)], abs=0.001)


def test_an_unreadable_marker_is_fitted_where_it_must_be():
    # 10 px wide: OpenCV reads few, the board tells where the others are
    far = pose(10.0, 30.0, 12.0, [0.0, 0.0, 0.27 * 75 / 10])
    found = 0
    for k in range(4):
        image = picture(a4_board(), far, seed=k)
        sightings, _ = MarkerFrontEnd(Rig(boards=(a4_board(),)), LENS, "m_left").process(0, image)
        for s in sightings:
            true = project(LENS, far, marker_corners(a4_board())[s.marker])
            assert np.abs(s.corners_px - true).max() < 0.5
        found += len(sightings)
    assert found in (0, 4, 8, 12, 16)


def test_follows_a_moving_board_and_finds_it_again():
    board = a4_board()
    front_end = MarkerFrontEnd(Rig(boards=(board,)), LENS, "m_left")
    blank = np.full((240, 360), 90, np.uint8)
    for k in range(6):
        at = pose(20.0, 30.0, 5.0, [0.02 * k - 0.05, 0.0, 0.7])
        assert len(front_end.process(k, picture(board, at))[0]) == 4
    assert front_end.process(7, blank) == ([], [])
    assert len(front_end.process(8, picture(board))[0]) == 4


def test_nothing_in_flat_noisy_or_tiny_images():
    front_end = MarkerFrontEnd(Rig(boards=(a4_board(),)), LENS, "m_left")
    rng = np.random.default_rng(0)
    for image in (np.zeros((240, 360)), np.full((240, 360), 255), rng.integers(0, 256, (240, 360)), np.zeros((2, 3))):
        assert front_end.process(0, image.astype(np.uint8))[0] == []


def test_a_dictionary_that_nobody_knows():
    with pytest.raises(RigError, match="tagCircle99"):
        MarkerFrontEnd(Rig(boards=(a4_board("tagCircle99"),)), LENS, "m_left")


def test_messages_in_both_orders():
    lens = camera(640, 480, 500, "plumb_bob", (-0.2, 0.05, 0.0, 0.0, 0.0))
    corners = np.array([[[100.0, 200.0], [140.0, 200.0], [140.0, 160.0], [100.0, 160.0]]])
    given = {"families": ["tag36h11"], "ids": [2]}
    ours = a4_board("DICT_APRILTAG_36h11")
    theirs = a4_board("DICT_APRILTAG_36h11", message_corner_order="opencv")
    one, _ = sightings_from_messages(Rig(boards=(ours,)), lens, "m_left", 5, **given, corners_raw_px=corners)
    other, _ = sightings_from_messages(
        Rig(boards=(theirs,)), lens, "m_left", 5, **given, corners_raw_px=corners[:, ::-1]
    )
    np.testing.assert_allclose(one[0].corners_px, other[0].corners_px)
    np.testing.assert_allclose(one[0].raw_px, corners[0])
    # the lens draws points inwards: undone, they are farther out, and their noise is larger
    assert np.linalg.norm(one[0].corners_px[0] - lens.K[:2, 2]) > np.linalg.norm(corners[0, 0] - lens.K[:2, 2])
    assert (np.linalg.eigvalsh(one[0].covariance_px2) > 0.3**2).all()


def test_messages_that_cannot_be_used_are_told():
    rig = Rig(boards=(a4_board("tag36h11"),))
    corners = np.tile(np.array([[10.0, 20.0], [20.0, 20.0], [20.0, 10.0], [10.0, 10.0]]), (5, 1, 1))
    corners[4] = np.nan
    sightings, rejections = sightings_from_messages(
        rig, LENS, "m_left", 5, ["tag36h11", "tag36h11", "tag36h11", "tag25h9", ""], [1, 1, 40, 0, 3], corners
    )
    assert sightings == []
    reasons = sorted(r.reason.split(",")[0] for r in rejections)
    assert reasons == [
        "corners beyond the lens model",
        "ids that the rig does not know",
        "stands in the image more than once",
        "stands in the image more than once",
    ]


def test_followed_markers_have_the_corners_of_read_ones(monkeypatch):
    board, other = a4_board(), a4_board()
    following = MarkerFrontEnd(Rig(boards=(board,)), LENS, "m_left")
    searched = []
    find = following._search.find
    monkeypatch.setattr(following._search, "find", lambda grey: searched.append(1) or find(grey))
    for k in range(8):
        at = pose(20.0, 30.0 + k, 5.0 - k, [0.02 * k - 0.08, 0.005 * k, 0.6 + 0.01 * k])
        image = picture(board, at, seed=k)
        followed = {s.marker: s for s in following.process(k, image)[0]}
        read = {s.marker: s for s in MarkerFrontEnd(Rig(boards=(other,)), LENS, "m_left").process(k, image)[0]}
        assert followed.keys() == read.keys()
        for marker, s in followed.items():
            covariance = s.covariance_px2 + read[marker].covariance_px2
            apart = s.corners_px - read[marker].corners_px
            assert (np.einsum("ki,kij,kj->k", apart, np.linalg.inv(covariance), apart) < 9.2).all()
    assert len(searched) == 1


def test_a_marker_that_another_took_the_place_of_is_not_followed():
    board = a4_board(ids=(0, 1, 2, 3))
    swapped = a4_board(ids=(0, 1, 7, 3))
    front_end = MarkerFrontEnd(Rig(boards=(board,)), LENS, "m_left")
    for k in range(3):
        assert {s.marker for s in front_end.process(k, picture(board, seed=k))[0]} == {0, 1, 2, 3}
    sightings, rejections = front_end.process(3, picture(swapped, seed=3))
    assert {s.marker for s in sightings} == {0, 1, 3}
    assert [r.value for r in rejections] == [1.0]


def test_through_a_lens_that_bends_lines_markers_are_followed_too():
    lens, board = camera(240, 180, 180, "plumb_bob", (-0.25, 0.08, 0.001, -0.001, 0.0)), a4_board()
    front_end = MarkerFrontEnd(Rig(boards=(board,)), lens, "m_left")
    for k in range(4):
        at = pose(25.0, 30.0, 10.0, [-0.1 + 0.03 * k, 0.03, 0.55])
        sightings = front_end.process(k, picture(board, at, lens, seed=k, supersampling=3))[0]
        assert len(sightings) == 4
        for s in sightings:
            assert np.abs(s.corners_px - project(lens, at, marker_corners(board)[s.marker])).max() < 0.15
