"""Outlines: tangent planes by hand, derivatives, and edges found in rendered images."""

from dataclasses import replace

import numpy as np
import pytest
from cylinder_scene import Cylinder, Scene, brick_texture, camera_model, noise_texture, pick_on, random_case, render
from hypothesis import given
from hypothesis import strategies as st

from surecut.factors.measurements import OutlineSighting, Rejection
from surecut.factors.outline import outline_lines, outline_noise, outline_residual, plane_normal
from surecut.frontends.pipe.limb import EdgeSeed, Window, confirmed_edges, fit_edges
from surecut.frontends.pipe.limb_model import EdgePixels, EdgeStates, linearised
from surecut.frontends.pipe.pairs import OutlinePrior
from surecut.frontends.pipe.predict import predict_outline
from surecut.frontends.pipe.silhouette import OutlineFinder, OutlineView, find_outlines, silhouette_sighting
from surecut.frontends.rays import pixel_rays

CAMERA = camera_model()
angles = st.floats(-0.7, 0.7)


def test_edges_of_an_upright_pipe_ahead():
    # Half the angle under which a pipe of radius r at distance D is seen is asin(r / D).
    lines = outline_lines(np.array([0, 0, 2.0]), np.array([0, 1.0, 0]), 0.2, CAMERA.K)
    assert lines is not None
    half = 270.0 * np.tan(np.arcsin(0.1))
    np.testing.assert_allclose(sorted(-lines[:, 2] / lines[:, 0]), (CAMERA.cx - half, CAMERA.cx + half))
    assert (lines @ np.array([CAMERA.cx, CAMERA.cy, 1.0]) < 0).all()
    assert outline_lines(np.array([0, 0.0, 0.1]), np.array([0, 1.0, 0]), 0.2, CAMERA.K) is None


@given(st.floats(-0.5, 0.5), st.floats(0.6, 3.0), angles, angles, st.floats(0.01, 0.2))
def test_residuals_vanish_on_the_true_cylinder_and_derivatives_are_exact(x, z, tilt, lean, radius):
    point, axis = np.array([x, 0.1, z]), np.array([np.sin(tilt), np.cos(tilt), np.sin(lean)])
    lines = outline_lines(point, axis, radius, CAMERA.K)
    assert lines is not None
    for line in lines:
        a, b = point - 0.3 * axis, point + 0.2 * axis
        residual, jacobian = outline_residual(line, CAMERA.K, a, b, radius)
        np.testing.assert_allclose(residual, 0, atol=1e-12)
        moved = np.concatenate((a, b, [radius])) + np.arange(7) * 1e-3
        away, _ = outline_residual(line, CAMERA.K, moved[:3], moved[3:6], float(moved[6]))
        np.testing.assert_allclose(away, jacobian @ (np.arange(7) * 1e-3), atol=1e-12)


def test_noise_is_the_line_moved():
    point, axis, radius = np.array([0.1, 0, 1.5]), np.array([0.2, 1, 0.1]), 0.05
    lines = outline_lines(point, axis, radius, CAMERA.K)
    assert lines is not None
    line, ends = lines[0], (point - 0.2 * axis, point + 0.2 * axis)
    foot = np.array([150.0, 100.0])
    foot = foot - (line[:2] @ foot + line[2]) * line[:2]
    step, columns = 1e-6, []
    for offset, turn in ((step, 0), (0, step)):
        normal = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]) @ line[:2]
        moved = np.append(normal, -normal @ foot - offset)
        columns.append([plane_normal(moved, CAMERA.K) @ p - plane_normal(line, CAMERA.K) @ p for p in ends])
    jacobian = np.array(columns).T / step
    covariance = np.array([[0.04, 1e-4], [1e-4, 1e-5]])
    expected = jacobian @ covariance @ jacobian.T
    np.testing.assert_allclose(outline_noise(line, foot, covariance, CAMERA.K, *ends), expected, rtol=1e-4)


LIGHTS = {
    "even": {"light": (0, 0, 1.0), "ambient": 1.0},
    "ahead": {"light": (0, 0, -1.0), "ambient": 0.4},
    "side": {"light": (-0.7, -0.2, -0.6), "ambient": 0.4},
    "bricks": {"light": (-0.5, -0.6, -0.6), "ambient": 0.4, "texture": brick_texture(np.random.default_rng(0))},
}


@pytest.mark.parametrize("light", LIGHTS)
def test_edge_fit_is_unbiased_with_an_honest_sigma(light):
    ideal, errors, scores = pixel_rays(CAMERA) * CAMERA.fx + (CAMERA.cx, CAMERA.cy), [], []
    for seed in range(5):
        rng = np.random.default_rng(seed)
        z = rng.uniform(1, 1.8)
        pipe = Cylinder([rng.uniform(-0.2, 0.2), 0, z], [rng.normal(0, 0.3), 1, rng.normal(0, 0.2)], 0.05, 0.8)
        image = render(Scene([pipe], noise=1.5, blur_px=0.5, shadow=False, **LIGHTS[light]), CAMERA, rng, 4)
        middle = CAMERA.K @ pipe.point
        for line in pipe.lines(CAMERA.K):
            foot = middle[:2] / middle[2]
            foot = foot - (line[:2] @ foot + line[2]) * line[:2]
            seed_line = line + np.array([0, 0, rng.normal(0, 0.4)])
            seed = EdgeSeed(seed_line, foot, (-50, 50), 13.5 / z)
            looked = [(Window(image.ravel().astype(float), ideal.reshape(-1, 2), 1.5), seed)]
            (found,) = fit_edges(looked)
            assert found is not None
            (fit,) = confirmed_edges(looked, [found])
            assert fit is not None
            turn = np.arctan2(line[0] * fit.line[1] - line[1] * fit.line[0], line[:2] @ fit.line[:2])
            error = np.array([line[:2] @ fit.foot_px + line[2], turn])
            errors.append(error[0])
            scores.append(error @ np.linalg.solve(fit.covariance, error) / 2)
    assert abs(np.mean(errors)) < 0.1
    assert np.mean(scores) < 3.0
    assert np.median(scores) > 0.1


def line_errors(found, truth):
    """Distance in px of each found edge, at its foot, outside the true one."""
    errors = []
    for line, foot in zip(found.lines, found.foot_px, strict=True):
        true = truth[int(np.argmax(truth[:, :2] @ line[:2]))]
        errors.append(true[:2] @ foot + true[2])
    return np.array(errors)


def test_finds_the_outline_about_a_pick_and_says_why_not():
    rng = np.random.default_rng(4)
    pipe = Cylinder([0.05, 0, 1.2], [0.15, 1, 0.05], 0.05, 0.85)
    scene = Scene([pipe], texture=noise_texture(rng), wall_m=2.2, light=(-0.2, -0.5, -0.8), ambient=0.5, noise=1.5)
    image = render(scene, CAMERA, rng)
    pick, lines = pick_on(scene, CAMERA, rng, 1.0)
    found = silhouette_sighting(image, CAMERA, pick, stamp_ns=3)
    assert isinstance(found, OutlineSighting), found
    assert np.abs(line_errors(found, lines)).max() < 0.5
    blank = silhouette_sighting(np.full_like(image, 90), CAMERA, pick)
    assert isinstance(blank, Rejection)
    assert blank.reason
    outside = silhouette_sighting(image, CAMERA, np.array([-500.0, 50.0]))
    assert isinstance(outside, Rejection)


def test_pictures_looked_at_together_answer_as_each_alone():
    finder, views = OutlineFinder(CAMERA), []
    for seed, z in ((4, 1.1), (5, 1.2), (6, 1.35)):
        rng = np.random.default_rng(seed)
        pipe = Cylinder([0.05, 0, z], [0.15, 1, 0.05], 0.05, 0.85)
        scene = Scene([pipe], texture=noise_texture(rng), wall_m=2.2, light=(-0.2, -0.5, -0.8), ambient=0.5, noise=1.5)
        pick, _ = pick_on(scene, CAMERA, rng, 1.0)
        prior = OutlinePrior(pick, 1.5, 0.05 * CAMERA.fx / z, 1.0)
        views.append(OutlineView(finder, seed, "pipe0", render(scene, CAMERA, rng), prior))
    blank = OutlineView(finder, 7, "pipe0", np.full_like(views[0].image, 90), views[0].prior)
    together = find_outlines([views[0], blank, *views[1:]])
    assert isinstance(together.pop(1), Rejection)
    for view, found in zip(views, together, strict=True):
        alone = finder.find(view.stamp_ns, view.pipe_id, view.image, view.prior)
        assert isinstance(found, OutlineSighting)
        assert isinstance(alone, OutlineSighting)
        sigma = np.sqrt(alone.covariance[:, 0, 0])
        for i in range(2):
            assert abs(np.append(alone.foot_px[i], 1.0) @ found.lines[i]) < 0.02 * sigma[i]
        assert found.quality == pytest.approx(alone.quality, abs=1e-3)


def test_edge_model_in_single_precision_follows_the_one_in_double():
    rng = np.random.default_rng(2)
    depth, along = rng.uniform(-4.5, 5.0, (12, 40)), rng.uniform(-30, 30, (12, 40))
    edge, each = np.repeat((0, 1), 6), np.ones(12)
    grey = 90.0 + 60.0 * (depth > 0.3) + 5.0 * np.sqrt(np.maximum(depth, 0)) + rng.normal(0, 1.5, depth.shape)
    double = EdgePixels(grey, depth, along, np.ones_like(grey), 12.0 * each, 0.3 * each, edge, 1.5 * each)
    single = replace(double, **{n: getattr(double, n).astype(np.float32) for n in ("grey", "depth", "along", "weight")})
    state = EdgeStates.start(2).moved(np.tile([0.3, 0.002, -0.1, 20.0, 3.0, 30.0, -8.0, 4.0, 2.0], (2, 1)))
    exact, fast = linearised(double, state), linearised(single, state)
    assert np.allclose(fast.shift, exact.shift, atol=2e-4)
    assert np.allclose(fast.variance, exact.variance, rtol=1e-3)
    step = 1e-4
    for i in range(2):
        ahead, back = (state.moved(np.eye(9)[[i, i]] * s) for s in (step, -step))
        slope = (linearised(double, ahead).squares - linearised(double, back).squares) / (4 * step)
        assert np.allclose(slope, -exact.score[:, i], rtol=0.02, atol=0.02 * np.abs(slope).max())


def test_outline_in_a_distorted_image():
    camera = camera_model(distortion=(-0.2, 0.05, 1e-3, -1e-3, 0))
    pipe = Cylinder([0.35, 0, 1.2], [0.1, 1, 0.05], 0.05, 0.2)
    scene = Scene([pipe], wall_m=2.2, light=(-0.2, -0.5, -0.8), ambient=0.5, noise=1.0, shadow=False)
    rng = np.random.default_rng(0)
    pick, lines = pick_on(scene, camera, rng, 0.5)
    found = silhouette_sighting(render(scene, camera, rng), camera, pick)
    assert isinstance(found, OutlineSighting), found
    assert np.abs(line_errors(found, lines)).max() < 0.4


def test_predicted_outline_is_where_the_edges_are():
    a, b = np.array([0.1, -0.3, 1.4]), np.array([0.0, 0.4, 1.3])
    prior = predict_outline(CAMERA, a, b, 0.05, 0.005, 0.01, 0.002)
    lines = outline_lines(a, b - a, 0.05, CAMERA.K)
    assert prior is not None
    assert lines is not None
    distance = lines @ np.append(prior.centre_px, 1.0)
    np.testing.assert_allclose(-distance, prior.half_width_px, rtol=0.01)
    assert predict_outline(CAMERA, a - (0, 0, 5), b - (0, 0, 5), 0.05, 0.005, 0.01, 0.002) is None


def test_tracked_outlines_over_difficult_scenes():
    """Shadows, neighbours, flanges, highlights, things in front: few wrong edges, and most scenes are measured."""
    from cylinder_scene import visible_share

    finder, found, wrong, seen = OutlineFinder(CAMERA), 0, 0, 0
    for seed in range(100, 112):
        rng = np.random.default_rng(seed)
        scene = random_case(rng)
        if visible_share(scene, CAMERA) < 0.75:
            continue
        pipe = scene.cylinders[0]
        image, lines = render(scene, CAMERA, rng, 3), pipe.lines(CAMERA.K)
        ends = [pipe.point + s * pipe.axis + rng.normal(0, 0.003, 3) for s in (-0.15, 0.15)]
        prior = predict_outline(CAMERA, ends[0], ends[1], pipe.radius + rng.normal(0, 0.002), 0.004, 0.02, 0.002)
        assert prior is not None
        seen += 1
        sighting = finder.find(0, "pipe0", image, prior)
        if isinstance(sighting, OutlineSighting):
            found += 1
            sigma = np.sqrt(sighting.covariance[:, 0, 0])
            wrong += bool((np.abs(line_errors(sighting, lines)) > 1.0 + 3 * sigma).any())
    assert seen >= 8
    assert found >= 0.6 * seen
    assert wrong <= 0.15 * found
