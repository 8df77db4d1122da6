"""Parts of the stereo front end against closed forms."""

import cv2
import numpy as np
import pytest
from stereo_scene import BASELINE, FOCAL, HEIGHT, WIDTH, K, camera, left_T_right, texture

from surecut.frontends.stereo.alignment import PatchGrid, align, make_patches
from surecut.frontends.stereo.detection import detect
from surecut.frontends.stereo.geometry import StereoGeometry, exponential, inverse, logarithm, project, transform
from surecut.frontends.stereo.images import dense, to_grey
from surecut.frontends.stereo.keyframes import keyframe_reason
from surecut.frontends.stereo.matching import search_right
from surecut.frontends.stereo.motion import estimate_motion, point_covariance
from surecut.frontends.stereo.settings import StereoSettings
from surecut.frontends.stereo.warp import bend_offsets, curvatures


def rig(left_T=None):
    return StereoGeometry(camera(), camera("m_right"), left_T_right() if left_T is None else left_T)


def points(rng, n=120):
    z = rng.uniform(1, 4, n)
    u, v = rng.uniform(20, WIDTH - 20, n), rng.uniform(20, HEIGHT - 20, n)
    return np.stack(((u - K[0, 2]) / FOCAL * z, (v - K[1, 2]) / FOCAL * z, z), axis=1)


def test_exponential_and_logarithm_are_inverse():
    tangent = np.array([0.1, -0.2, 0.3, 1.0, 2.0, 3.0])
    assert np.allclose(logarithm(exponential(tangent)), tangent)
    assert np.allclose(exponential(tangent) @ inverse(exponential(tangent)), np.eye(4))


def test_triangulation_inverts_projection_for_a_turned_rig():
    turned = exponential(np.array([0.02, -0.05, 0.03, BASELINE, 0.01, -0.01]))
    there = rig(turned)
    p = points(np.random.default_rng(0))
    px = there.project(p)
    assert np.allclose(there.triangulate(px[:, :2], px[:, 2:]), p)


def test_jacobian_is_the_derivative():
    there = rig()
    p = points(np.random.default_rng(1), 5)
    step = 1e-6
    numeric = np.stack([(there.project(p + d) - there.project(p - d)) / (2 * step) for d in step * np.eye(3)], axis=2)
    assert np.allclose(there.jacobian(p), numeric, atol=1e-4)


def test_depth_variance_is_that_of_the_disparity():
    """sigma_z = z^2 / (f b) sigma_d, with sigma_d^2 = 2 sigma^2 where left and right err alike."""
    covariance = point_covariance(np.array([[0.0, 0.0, 2.0]]), 0.01 * np.eye(4)[None], rig())
    assert np.sqrt(covariance[0, 2, 2]) == pytest.approx(4.0 / (FOCAL * BASELINE) * np.sqrt(2) * 0.1, rel=0.01)


def noisy_motion(rng, share=0.0, right=True):
    """A known motion seen with 0.1 px of noise; a share of the points moves by itself."""
    there, p = rig(), points(rng)
    pose = exponential(np.array([0.03, -0.06, 0.02, 0.05, -0.02, 0.08]))
    here = transform(inverse(pose), p)
    moved = rng.random(len(p)) < share
    here[moved] += [0.1, 0.03, 0.0]
    px = there.project(here) + rng.normal(0, 0.1, (len(p), 4))
    seen = there.project(p) + rng.normal(0, 0.1, (len(p), 4))
    measured = there.triangulate(seen[:, :2], seen[:, 2:])
    covariance = np.tile(0.01 * np.eye(4), (len(p), 1, 1))
    if not right:
        px[:, 2:] = np.nan
    motion = estimate_motion(
        measured, point_covariance(measured, covariance, there), px, covariance, [np.eye(4)], there, 12
    )
    return motion, pose, moved


@pytest.mark.parametrize("right", [True, False], ids=["stereo", "left only"])
def test_motion_is_found_and_its_residuals_are_chi_square(right):
    rng = np.random.default_rng(2)
    motion, pose, _ = noisy_motion(rng, right=right)
    error = logarithm(inverse(pose) @ motion.reference_T_this)
    assert np.abs(error[:3]).max() < 0.002
    assert np.abs(error[3:]).max() < 0.006
    assert motion.inliers.mean() > 0.95
    assert 0.75 < motion.chi2[motion.inliers].mean() / (4 if right else 2) < 1.25


def test_points_that_move_by_themselves_are_outliers():
    motion, pose, moved = noisy_motion(np.random.default_rng(3), share=0.3)
    assert not motion.inliers[moved].any()
    assert motion.inliers[~moved].mean() > 0.95
    assert np.abs(logarithm(inverse(pose) @ motion.reference_T_this)[3:]).max() < 0.008


def test_too_few_points_give_no_motion():
    there, p = rig(), points(np.random.default_rng(4), 8)
    covariance = np.tile(0.01 * np.eye(4), (8, 1, 1))
    assert estimate_motion(p, np.tile(1e-4 * np.eye(3), (8, 1, 1)), there.project(p), covariance, [], there, 12) is None


@pytest.mark.parametrize("gain", [1.0, 0.4])
def test_alignment_finds_a_shift_to_hundredths_whatever_the_brightness(gain):
    image = texture(np.random.default_rng(5), HEIGHT, WIDTH)
    image = cv2.GaussianBlur(image, (0, 0), 1.0)
    shift = np.array([1.37, -0.62])
    # Shifted in the frequency domain: OpenCV's own warps are off by hundredths themselves.
    phase = np.fft.fftfreq(WIDTH)[None] * shift[0] + np.fft.fftfreq(HEIGHT)[:, None] * shift[1]
    moved = np.fft.ifft2(np.fft.fft2(image) * np.exp(-2j * np.pi * phase)).real * gain + 10
    first, second = (dense(np.rint(picture).astype(np.uint8), 0.7) for picture in (image, moved))
    grid = PatchGrid(7, bend_sigma=0.06)
    px = detect(np.rint(image).astype(np.uint8), np.zeros((0, 2)), 100, 10.0, 15, 1.0)
    found = align(second, make_patches(first, px, grid, 1.0), px.copy(), np.tile(np.eye(2), (len(px), 1, 1)), grid)
    error = (found.px - px - shift)[found.converged]
    assert found.converged.mean() > 0.9
    assert np.abs(np.median(error, axis=0)).max() < 0.01
    assert np.sqrt((error**2).mean()) < 0.05
    assert found.correlation[found.converged].min() > 0.9


def test_a_repeating_pattern_gets_no_right_match():
    u, v = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    bars = np.where((u // 8) % 2 == (v // 8) % 2, 60, 180).astype(np.uint8)
    px = np.array([[200.0, 120.0], [240.0, 80.0]])
    assert np.isnan(search_right(bars, bars, px, px, rig(), 0.4, 3.0, 7, 0.8)).all()


def test_corners_keep_their_distance_and_leave_the_rest_alone():
    image = np.rint(texture(np.random.default_rng(6), HEIGHT, WIDTH)).astype(np.uint8)
    old = np.array([[100.0, 100.0], [200.0, 50.0]])
    new = detect(image, old, 120, 9.0, 10, 1.0)
    everything = np.concatenate((old, new))
    apart = np.linalg.norm(everything[:, None] - everything[None], axis=2) + 1e3 * np.eye(len(everything))
    assert len(new) == 120
    assert apart.min() > 8.0
    quadrants = np.unique(2 * (new[:, 0] > WIDTH / 2) + (new[:, 1] > HEIGHT / 2), return_counts=True)[1]
    assert quadrants.min() > 20


def test_noise_has_no_corners():
    image = np.rint(128 + np.random.default_rng(7).normal(0, 2, (HEIGHT, WIDTH))).astype(np.uint8)
    assert len(detect(image, np.zeros((0, 2)), 200, 9.0, 10, 2.0)) < 10


def test_keyframe_reasons():
    settings, still = StereoSettings(), np.zeros((50, 2))
    turned = exponential(np.array([0.0, 0.4, 0.0, 0, 0, 0]))
    assert keyframe_reason(still, np.eye(4), 20, 200, 433, settings) is None
    assert keyframe_reason(still + 60, np.eye(4), 200, 200, 433, settings) == "parallax"
    assert keyframe_reason(still + 5, turned, 200, 200, 433, settings) == "rotation"
    assert keyframe_reason(still + 5, np.eye(4), 90, 200, 433, settings) == "share"
    assert keyframe_reason(still + 5, np.eye(4), 50, 60, 433, settings) == "few tracks"
    assert keyframe_reason(still + 5, np.eye(4), 180, 200, 433, settings) is None


def test_grey_from_any_image():
    bgr = np.zeros((4, 5, 3), np.uint8)
    bgr[..., 1] = 100
    assert to_grey(bgr)[0, 0] == round(0.587 * 100)
    assert to_grey(np.full((4, 5), 0x7FFF, np.uint16))[0, 0] == 0x7F
    assert to_grey(bgr[:, :, :1]).shape == (4, 5)


def test_projection_behind_the_camera_is_nan():
    assert np.isnan(project(np.array([[0.0, 0.0, -1.0]]), camera())).all()


def test_a_turned_patch_fits_beside_its_centre():
    """A camera that turns by theta about the vertical sees d at W (d + (c . d) d); the fit is off as foretold."""
    theta = 0.3
    turn = np.eye(4)
    turn[:3, :3] = [[np.cos(theta), 0, np.sin(theta)], [0, 1, 0], [-np.sin(theta), 0, np.cos(theta)]]
    left, _ = curvatures(np.array([[0.0, 0.0, 2.0]]), np.zeros((1, 2)), turn[None], rig())
    # u / f = tan(phi + theta): half its second derivative over its first.
    assert left[0] == pytest.approx([np.tan(theta) / K[0, 0], 0.0], rel=1e-6, abs=1e-9)
    assert not np.any(curvatures(np.full((1, 3), np.nan), np.zeros((1, 2)), turn[None], rig()))

    rng = np.random.default_rng(8)
    waves = list(zip(rng.normal(0, 0.45, (40, 2)), rng.normal(0, 13, 40), rng.uniform(0, 2 * np.pi, 40), strict=True))

    def seen(u, v):
        return (128 + sum(a * np.cos(k[0] * u + k[1] * v + phase) for k, a, phase in waves)).astype(np.float32)

    u, v = np.meshgrid(np.arange(WIDTH, dtype=float), np.arange(HEIGHT, dtype=float))
    image, grid, c = seen(u, v), PatchGrid(7, bend_sigma=0.06), np.array([3e-3, 0.0])
    px = detect(np.clip(image, 0, 255).astype(np.uint8), np.zeros((0, 2)), 40, 25.0, 20, 1.0)
    patches = make_patches(dense(image, 0.7), px, grid, 1.0)
    foretold = bend_offsets(np.tile(np.eye(2), (len(px), 1, 1)), patches.bend, np.tile(c, (len(px), 1)))
    off = []
    for row, (x, y) in enumerate(px):
        back = 1.0 - c[0] * np.clip(u - x, -25, 25)
        bent = seen(x + back * (u - x), y + back * (v - y))
        off.append(
            align(dense(bent, 0.7), patches.take(np.array([row])), px[[row]], np.eye(2)[None], grid).px[0] - (x, y)
        )
    assert np.sqrt((foretold**2).mean()) > 0.02
    assert np.abs(off - foretold).max() < 0.1 * np.abs(foretold).max()


def test_alignment_does_not_prefer_whole_pixels():
    """Shifts by all phases of a pixel: what is off does not follow the phase."""
    image = cv2.GaussianBlur(texture(np.random.default_rng(9), HEIGHT, WIDTH), (0, 0), 0.8)
    grid = PatchGrid(7, bend_sigma=0.06)
    first = np.rint(image).astype(np.uint8)
    px = detect(first, np.zeros((0, 2)), 120, 10.0, 15, 1.0)
    patches = make_patches(dense(first, 0.7), px, grid, 1.0)
    off = []
    for shift in (phases := np.arange(8) / 8):
        factor = np.exp(-2j * np.pi * np.fft.fftfreq(WIDTH)[None] * shift)
        moved = np.fft.ifft2(np.fft.fft2(image) * factor).real
        found = align(
            dense(np.rint(moved).astype(np.uint8), 0.7), patches, px, np.tile(np.eye(2), (len(px), 1, 1)), grid
        )
        off.append(np.median((found.px - px)[found.converged, 0]) - shift)
    amplitude = 2 * np.abs(np.mean(np.array(off) * np.exp(2j * np.pi * phases)))
    assert amplitude < 0.002
