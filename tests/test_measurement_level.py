"""The drawn measurements have the noise that they state, about what the truth says, and nothing else."""

import numpy as np
import pytest
from scipy.stats import kstest

from surecut.estimator.pipes import EDGE_FLOOR_PX
from surecut.factors.cloud import corrected
from surecut.factors.errors import RigError
from surecut.factors.measurements import CloudFrame, MarkerSighting, OutlineSighting, Pick, StereoFrame
from surecut.factors.noise import floored
from surecut.factors.outline import outline_noise, outline_residual
from surecut.simulation.measurement_level import draw
from surecut.simulation.measurement_level_scenario import Scenario, load_scenarios
from surecut.simulation.measurement_level_truth import invert, transform


def of(run, kind):
    return [measurement for measurement in run.measurements if isinstance(measurement, kind)]


def whitened(residuals, covariances):
    return np.linalg.solve(np.linalg.cholesky(covariances), residuals[..., None])[..., 0].ravel()


def assert_normal(values, factor=1.0):
    values = np.asarray(values).ravel() / factor
    assert kstest(values, "norm").pvalue > 1e-3, (len(values), values.mean(), values.std())


def project(camera, c_T_o, points):
    pixels = transform(c_T_o, points) @ camera.K.T
    return pixels[..., :2] / pixels[..., 2:]


def m_T_o(run, stamp_ns):
    return invert(run.truth.o_T_m[run.truth.stamps_ns.index(stamp_ns)])


SCENARIO = Scenario.model_validate({"rig": {"noise": {"marker_common_px": 0.0}}})


@pytest.fixture(scope="module")
def runs():
    return [draw(SCENARIO, seed) for seed in range(2)]


def test_same_seed_same_run():
    first, again, other = draw(Scenario(), 3), draw(Scenario(), 3), draw(Scenario(), 4)
    assert first.rig == again.rig != other.rig
    for a, b in zip(of(first, StereoFrame), of(again, StereoFrame), strict=True):
        np.testing.assert_array_equal(a.left_px, b.left_px)
        np.testing.assert_array_equal(a.track_ids, b.track_ids)


def test_marker_corners(runs):
    values = []
    for run in runs:
        for sighting in of(run, MarkerSighting):
            page = run.truth.rig.boards[sighting.board]
            corners_o = transform(run.truth.o_T_f[sighting.board], page.corners_m[page.markers.index(sighting.marker)])
            c_T_o = m_T_o(run, sighting.stamp_ns)
            if sighting.camera == "m_right":
                c_T_o = invert(run.truth.rig.m_left_T_m_right) @ c_T_o
            exact = project(run.truth.rig.cameras[sighting.camera], c_T_o, corners_o)
            values.append(whitened(sighting.corners_px - exact, sighting.covariance_px2))
    assert sum(map(len, values)) > 1000
    assert_normal(np.concatenate(values))


def test_tracks_triangulate_to_one_point_with_the_stated_noise(runs):
    """Each track, with true poses and calibration: the residuals of the best point are chi-square."""
    squares, dofs = 0.0, 0
    for run in runs[:1]:
        left, right = run.truth.rig.cameras["m_left"], run.truth.rig.cameras["m_right"]
        rows: dict[int, list] = {}
        for frame in of(run, StereoFrame):
            c_T_o = m_T_o(run, frame.stamp_ns)
            for i, track in enumerate(frame.track_ids):
                rows.setdefault(int(track), []).append((left, c_T_o, frame.left_px[i]))
                if np.isfinite(frame.right_px[i]).all():
                    r_T_o = invert(run.truth.rig.m_left_T_m_right) @ c_T_o
                    rows[int(track)].append((right, r_T_o, frame.right_px[i]))
        for views in rows.values():
            if len(views) >= 4:
                square, dof = triangulation_residual(views, SCENARIO.tracks.sigma_px)
                squares, dofs = squares + square, dofs + dof
    assert dofs > 1500
    assert squares / dofs == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / dofs))


def triangulation_residual(views, sigma_px):
    A = []
    for camera, c_T_o, px in views:
        P = camera.K @ c_T_o[:3]
        A += [px[0] * P[2] - P[0], px[1] * P[2] - P[1]]
    point = np.linalg.svd(np.array(A))[2][-1]
    point = point[:3] / point[3]
    for _ in range(8):
        residual, jacobian = [], []
        for camera, c_T_o, px in views:
            x, y, z = transform(c_T_o, point)
            f = camera.K[0, 0], camera.K[1, 1]
            residual += [px[0] - f[0] * x / z - camera.K[0, 2], px[1] - f[1] * y / z - camera.K[1, 2]]
            d = np.array([[f[0] / z, 0, -f[0] * x / z**2], [0, f[1] / z, -f[1] * y / z**2]])
            jacobian += list(d @ c_T_o[:3, :3])
        step, *_ = np.linalg.lstsq(np.array(jacobian), np.array(residual), rcond=None)
        point = point + step
    return float(np.sum(np.square(residual)) / sigma_px**2), 2 * len(views) - 3


def test_cloud_points_lie_on_their_surface_once_the_depth_is_corrected(runs):
    values = []
    for run in runs:
        planes = {}
        for cloud in of(run, CloudFrame):
            rig = run.truth.rig
            points = corrected(cloud.points_m, rig.depth_offset_m, rig.depth_scale, rig.depth_rays)
            for point, normal, sigma in zip(points, cloud.normals, cloud.sigma_m, strict=True):
                planes.setdefault(tuple(np.round(normal, 6)), []).append((normal @ point, sigma))
        for samples in planes.values():
            offsets, sigmas = np.array(samples).T
            groups = np.round((offsets + 0.05) / 0.1)
            for group in set(groups):
                rows = groups == group
                if rows.sum() > 100:
                    weights = sigmas[rows] ** -2
                    mean = (weights * offsets[rows]).sum() / weights.sum()
                    values.append((offsets[rows] - mean) / np.sqrt(sigmas[rows] ** 2 - 1.0 / weights.sum()))
    values = np.concatenate(values)
    assert len(values) > 1000
    # Neighbouring parallel surfaces can fall into one group; the spread of the bulk decides.
    assert np.quantile(np.abs(values), 0.683) == pytest.approx(1.0, abs=0.06)


def test_picks_and_outlines(runs):
    clicks, edges = [], []
    for seed in range(4, 8):
        run = draw(SCENARIO, seed)
        truth, camera = run.truth, run.truth.rig.cameras["m_left"]
        for pick in of(run, Pick):
            point_o = transform(truth.o_T_b, truth.points_b_m[pick.point_id])
            exact = project(camera, m_T_o(run, pick.stamp_ns), point_o[None])[0]
            model = floored(pick.covariance_px2, run.rig.noise.pick_floor_px)
            clicks.append(whitened((pick.px - exact)[None], model[None]))
        for outline in of(run, OutlineSighting):
            c_T_b = m_T_o(run, outline.stamp_ns) @ truth.o_T_b
            a = transform(c_T_b, truth.pipe.point_b_m + 0.8 * truth.pipe.axis_b)
            b = transform(c_T_b, truth.pipe.point_b_m + 1.3 * truth.pipe.axis_b)
            for line, foot, covariance in zip(outline.lines, outline.foot_px, outline.covariance, strict=True):
                residual, _ = outline_residual(line, camera.K, a, b, truth.pipe.radius_m - truth.pipe.inset_m)
                model = covariance + np.diag([EDGE_FLOOR_PX**2, 0.0])
                noise = outline_noise(line, foot, model, camera.K, a, b)
                edges.append(whitened(residual[None], noise[None]))
    assert_normal(np.concatenate(clicks))
    assert_normal(np.concatenate(edges))


@pytest.mark.parametrize("family", ["markers", "picks"])
def test_wrong_noise_has_the_asked_factor(family):
    scenario = Scenario.model_validate(
        {"rig": {"noise": {"marker_common_px": 0.0}}, "noise_factors": {family: 2.0}, "picks": {"clicks": 40}}
    )
    run = draw(scenario, 0)
    values = []
    if family == "picks":
        for point_id in run.truth.points_b_m:
            for stamp in {pick.stamp_ns for pick in of(run, Pick)}:
                px = [p.px for p in of(run, Pick) if (p.point_id, p.stamp_ns) == (point_id, stamp)]
                values.append((px - np.mean(px, axis=0)).ravel() * np.sqrt(40 / 39))
        stated = max(scenario.picks.sigma_px, run.rig.noise.pick_floor_px)
    else:
        for sighting in of(run, MarkerSighting):
            page = run.truth.rig.boards["f0"]
            c_T_o = m_T_o(run, sighting.stamp_ns)
            if sighting.camera == "m_right":
                c_T_o = invert(run.truth.rig.m_left_T_m_right) @ c_T_o
            corners_o = transform(run.truth.o_T_f["f0"], page.corners_m[page.markers.index(sighting.marker)])
            values.append(
                (sighting.corners_px - project(run.truth.rig.cameras[sighting.camera], c_T_o, corners_o)).ravel()
            )
        stated = scenario.markers.sigma_px
    assert_normal(np.concatenate(values) / stated, factor=2.0)


def test_outliers_have_the_asked_share():
    run = draw(Scenario.model_validate({"outliers": {"share": 0.1, "families": ["tracks"]}}), 0)
    clean = draw(Scenario(), 0)
    # Every left pixel of a row has an equal in the right one but for disparity: rows leave the epipolar line.
    off = [
        np.abs(frame.left_px[:, 1] - frame.right_px[:, 1])[np.isfinite(frame.right_px[:, 0])]
        for frame in of(run, StereoFrame)
    ]
    inside = [
        np.abs(frame.left_px[:, 1] - frame.right_px[:, 1])[np.isfinite(frame.right_px[:, 0])]
        for frame in of(clean, StereoFrame)
    ]
    limit = np.concatenate(inside).max()
    share = (np.concatenate(off) > limit).mean()
    # Two chances per row, less those that are thrown along the line.
    assert 0.1 < share < 0.2


def test_calibration_is_drawn_from_its_prior():
    baselines, focal, scales, radii = [], [], [], []
    for seed in range(25):
        run = draw(Scenario.model_validate({"motion": {"duration_s": 1.0}, "clouds": {"frames": 0}}), seed)
        rig = run.truth.rig
        baselines.append((np.linalg.norm(rig.m_left_T_m_right[:3, 3]) / 0.15 - 1.0) / run.rig.stereo.baseline_sigma_rel)
        focal.append((rig.cameras["m_left"].K[0, 0] / 270.0 - 1.0) / run.rig.cameras.m_left.focal_sigma_rel)
        scales.append(rig.depth_scale / run.rig.kinect.depth_scale_sigma)
        pipe = run.rig.pipes[0]
        radii.append((2 * run.truth.pipe.radius_m - pipe.nominal_diameter_m) / pipe.diameter_sigma_m)
    for values in (baselines, focal, scales, radii):
        assert kstest(values, "norm").pvalue > 1e-3


def test_without_faults_the_rig_is_as_its_file_says():
    run = draw(Scenario(faults=False), 1)
    assert np.linalg.norm(run.truth.rig.m_left_T_m_right[:3, 3]) == pytest.approx(0.15)
    assert run.truth.rig.depth_offset_m == 0.0
    assert run.truth.rig.boards["f0"].side_m == 0.075


def test_a_wrong_side_length_is_in_the_file_only():
    run = draw(Scenario(typed_side_m=0.05), 1)
    assert run.rig.boards[0].side_m == 0.05
    assert run.truth.rig.boards["f0"].side_m == pytest.approx(0.075, abs=0.003)


def test_scenario_errors_name_file_and_key(tmp_path):
    path = tmp_path / "s.yaml"
    path.write_text("tracks: {per_fram: 3}\n")
    with pytest.raises(RigError, match=r"s\.yaml: tracks\.per_fram"):
        load_scenarios(path)
    with pytest.raises(RigError, match="cannot be read"):
        load_scenarios(tmp_path / "none.yaml")
