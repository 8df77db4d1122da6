"""Corners against rendered truth: bias, scatter, honesty, and the order of the corners."""

from dataclasses import replace

import numpy as np
import pytest
from fiducial_scenes import PAGE_M, a4_board, camera, pose

from surecut.factors.rig import Rig
from surecut.frontends.fiducials import pattern_fit
from surecut.frontends.fiducials.detector import MarkerFrontEnd
from surecut.frontends.fiducials.dictionaries import all_names, canonical_name, marker_dictionary
from surecut.simulation.marker_images import Photography, marker_corners, project, render_board


def measure(board, lens, poses, taken, seed=0):
    """Errors (n, 4, 2), outward parts and normalised squares of all corners."""
    rng = np.random.default_rng(seed)
    errors, outward, nees = [], [], []
    for camera_T_f in poses:
        image = render_board(board, PAGE_M, lens, camera_T_f, taken, rng)
        truth = {k: project(lens, camera_T_f, c) for k, c in marker_corners(board).items()}
        for s in MarkerFrontEnd(Rig(boards=(board,)), lens, "m_left").process(0, image)[0]:
            error = s.corners_px - truth[s.marker]
            away = truth[s.marker] - truth[s.marker].mean(0)
            errors.append(error)
            outward.append((error * away).sum(1) / np.linalg.norm(away, axis=1))
            nees.append(np.einsum("ki,kij,kj->k", error, np.linalg.inv(s.covariance_px2), error) / 2)
    return np.array(errors), np.array(outward), np.array(nees)


@pytest.mark.parametrize(
    ("focal", "distance", "tilt", "blur", "noise"),
    [(270, 1.1, 0, 0.8, 2.0), (270, 0.7, 40, 0.6, 2.0), (400, 0.6, 25, 1.5, 3.0), (500, 0.7, 50, 1.8, 2.0)],
)
def test_no_bias_and_an_honest_covariance(focal, distance, tilt, blur, noise):
    lens = camera(int(focal * 0.45 / distance), int(focal * 0.45 / distance), focal)
    poses = [pose(tilt, 70.0 * k, 23.0 * k, [0.001 * k, 0.002, distance]) for k in range(8)]
    errors, outward, nees = measure(a4_board(), lens, poses, Photography(blur_px=blur, noise=noise, shading=(0.2, 0.1)))
    assert len(errors) >= 20
    assert abs(outward.mean()) < 0.01
    assert np.abs(errors.mean((0, 1))).max() < 0.01
    assert np.sqrt((errors**2).mean()) < 0.04
    assert 0.6 < nees.mean() < 1.5


@pytest.mark.parametrize(("gamma", "blur"), [(2.2, 0.7), (1.6, 1.0), (0.7, 0.9)])
def test_the_response_of_the_camera_moves_no_corner(gamma, blur):
    """Between black and white a camera's response is bent: that shifts all edges towards one side of them."""
    lens = camera(230, 230, 270)
    poses = [pose(20.0, 70.0 * k, 23.0 * k, [0.001 * k, 0.002, 0.6]) for k in range(6)]
    # ink throws back 6 % of what paper does
    taken = Photography(blur_px=blur, gamma=gamma, black=225.0 * 0.06 ** (1.0 / gamma))
    errors, outward, nees = measure(a4_board(), lens, poses, taken)
    assert len(errors) == 24
    assert abs(outward.mean()) < 0.02
    assert np.sqrt((errors**2).mean()) < 0.05
    assert 0.5 < nees.mean() < 1.6


def test_motion_blur_moves_no_corner():
    lens = camera(300, 300, 400)
    poses = [pose(20.0, 50.0 * k, 31.0 * k, [0.0, 0.0, 0.6]) for k in range(4)]
    errors, outward, nees = measure(a4_board(), lens, poses, Photography(motion_px=(3.0, 2.0)))
    assert len(errors) == 16
    assert abs(outward.mean()) < 0.03
    assert nees.mean() < 2.0


def test_a_lens_that_bends_lines():
    lens = camera(180, 120, 135, "plumb_bob", (-0.3, 0.1, 0.001, -0.001, 0.0))
    errors, outward, _ = measure(a4_board(), lens, [pose(25.0, 30.0, 10.0, [-0.08, 0.03, 0.45])], Photography())
    assert len(errors) == 4
    assert np.sqrt((errors**2).mean()) < 0.05
    assert abs(outward.mean()) < 0.03


@pytest.mark.parametrize(
    "dictionary", ["DICT_4X4_50", "DICT_6X6_250", "DICT_APRILTAG_36h11", "tag25h9", "DICT_ARUCO_ORIGINAL"]
)
def test_corner_order_and_small_markers(dictionary):
    # 18 px wide, upright: corner 0 is the lower left one of the printed marker
    lens = camera(240, 240, 270)
    errors, _, _ = measure(
        a4_board(dictionary, side_m=0.075), lens, [pose(15.0, 20.0, 3.0, [0, 0, 1.12])], Photography()
    )
    assert len(errors) >= 3
    assert np.abs(errors).max() < 0.15


def test_a_covered_corner_is_left_to_the_rest():
    board, lens = a4_board(), camera(300, 300, 400)
    camera_T_f = pose(15.0, 20.0, 3.0, [0, 0, 0.6])
    image = render_board(board, PAGE_M, lens, camera_T_f, Photography(), np.random.default_rng(0))
    true = project(lens, camera_T_f, marker_corners(board)[0])
    x, y = np.rint(true[1]).astype(int)
    # a small glare, not so large that the marker cannot be read
    image[y - 3 : y + 2, x - 2 : x + 3] = 255
    sightings, _ = MarkerFrontEnd(Rig(boards=(board,)), lens, "m_left").process(0, image)
    found = {s.marker: s for s in sightings}
    assert np.abs(found[0].corners_px - true).max() < 0.15


def test_names_of_families():
    assert canonical_name("tag36h11") == canonical_name("36h11") == "DICT_APRILTAG_36h11"
    assert canonical_name("DICT_ARUCO_MIP_36H12") == "DICT_ARUCO_MIP_36h12"
    assert canonical_name("tagStandard41h12") == "tagStandard41h12"
    assert len(all_names()) == 22


@pytest.mark.parametrize("name", all_names())
def test_patterns_have_a_black_border_and_differ_from_their_turns(name):
    dictionary = marker_dictionary(name)
    pattern = dictionary.pattern(1)
    border = np.concatenate([pattern[0], pattern[-1], pattern[:, 0], pattern[:, -1]])
    assert pattern.shape == (dictionary.cells, dictionary.cells)
    assert not border.any()
    assert all((np.rot90(pattern, k) != pattern).any() for k in (1, 2, 3))


@pytest.mark.parametrize("rays", [3, 4])
def test_edges_that_are_off_as_a_whole_are_in_the_covariance(rays, monkeypatch):
    """Few rays a pixel see a part of its area only: upright edges are off by their place in the pixel. Without the
    variance of whole edges the covariance knows nothing of it."""
    lens = camera(230, 230, 270)
    poses = [pose(3.0, 40.0 * k, 0.5 * k, [0.002 * k, 0.003 * k, 0.62 + 0.01 * k]) for k in range(8)]
    taken = Photography(blur_px=0.6, noise=1.0, supersampling=rays)
    nees = measure(a4_board(), lens, poses, taken)[2]
    assert 0.4 < nees.mean() < 2.0
    whole = pattern_fit.edge_errors
    monkeypatch.setattr(pattern_fit, "edge_errors", lambda *a: replace(whole(*a), variance_px2=np.zeros(len(a[0]))))
    assert measure(a4_board(), lens, poses, taken)[2].mean() > 2.0 * nees.mean()


def test_a_shadow_across_one_marker_is_in_its_covariance_and_in_no_other():
    """The edge of a shadow is no edge of the print. What it does to the fit stays the same in all views of a recording,
    so it has to be told from one image."""
    board, lens, rng = a4_board(), camera(230, 230, 270), np.random.default_rng(2)
    shaded, others, sigmas = [], [], []
    for k in range(12):
        camera_T_f = pose(10.0, 40.0 * k, 3.0 * k, [0.002 * k, 0.003 * k, 0.85])
        taken = Photography(blur_px=0.6, noise=0.0, black=30.0, white=210.0)
        image = render_board(board, PAGE_M, lens, camera_T_f, taken, rng).astype(float)
        truth = {k: project(lens, camera_T_f, c) for k, c in marker_corners(board).items()}
        corners = truth[0]
        middle, along = corners[:2].mean(0), corners[1] - corners[0]
        v, u = np.mgrid[: image.shape[0], : image.shape[1]]
        across = ((u - middle[0]) * along[0] + (v - middle[1]) * along[1]) / np.linalg.norm(along)
        near = np.exp(-((np.hypot(u - corners[:, 0].mean(), v - corners[:, 1].mean()) / np.linalg.norm(along)) ** 4))
        image *= 1.0 - 0.5 * near / (1.0 + np.exp(across / 0.8))
        image = np.clip(np.rint(image + rng.normal(0.0, 3.0, image.shape)), 0, 255).astype(np.uint8)
        for s in MarkerFrontEnd(Rig(boards=(board,)), lens, "m_left").process(0, image)[0]:
            error = s.corners_px - truth[s.marker]
            square = np.einsum("ki,kij,kj->k", error, np.linalg.inv(s.covariance_px2), error).mean() / 2
            (shaded if s.marker == 0 else others).append(square)
            sigmas.append((s.marker, np.sqrt(np.einsum("kii->k", s.covariance_px2).mean() / 2), np.abs(error).max()))
    assert len(shaded) == 12
    assert np.mean([worst for marker, _, worst in sigmas if marker == 0]) > 0.1
    assert np.mean(shaded) < 2.0
    assert 0.5 < np.mean(others) < 1.6
    plain = np.mean([sigma for marker, sigma, _ in sigmas if marker != 0])
    assert np.mean([sigma for marker, sigma, _ in sigmas if marker == 0]) > 3.0 * plain
