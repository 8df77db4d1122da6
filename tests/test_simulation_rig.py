"""Scenarios, faults of the rig, depth noise, light: against values known by hand."""

import numpy as np
import pytest

from surecut.factors.camera import CameraModel
from surecut.factors.rig import dump_rig, load_rig
from surecut.simulation.atlas import build_atlas
from surecut.simulation.depth import BASELINE_M, STEP_PX, Surface, axial_sigma_m, measure
from surecut.simulation.faults import TrueRig, draw_rig
from surecut.simulation.rigid import inverse, transform
from surecut.simulation.scenario import Scenario, ScenarioError, load_scenarios, override, scenario_names
from surecut.simulation.sensor import project
from surecut.simulation.studio import uncovered


def rig_of(seed: int = 0, **changes):
    return draw_rig(Scenario.model_validate(changes), 1.0, np.random.default_rng(seed))


def test_every_scenario_of_the_package_loads():
    assert {"demo", "paper-b", "biased", "sharp", "visible", "stations", "arm", "dark", "covered"} <= set(
        scenario_names()
    )
    for name in scenario_names():
        assert load_scenarios(name)
    runs = load_scenarios("paper-b")
    assert [(r.place, r.initialisation) for r in runs] == [(p, i) for p in "ABC" for i in range(3)]
    assert [r.motion for r in runs] == ["smooth", "smooth", "sharp"] * 3


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("pipes: {}", "pipes"),
        ("mobile: {focal_px: -3}", "mobile.focal_px"),
        ("duration_s: .nan", "duration_s"),
        ("- 1", "no scenario"),
        ("runs: 3", "no scenario"),
        ("place: [", "YAML"),
    ],
)
def test_a_wrong_scenario_is_told_in_one_line(tmp_path, text, word):
    path = tmp_path / "wrong.yaml"
    path.write_text(text)
    with pytest.raises(ScenarioError) as caught:
        load_scenarios(path)
    assert word in str(caught.value)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_unknown_scenario_names_the_known_ones():
    with pytest.raises(ScenarioError, match="demo"):
        load_scenarios("nowhere")


def test_override_goes_into_sections():
    changed = override(Scenario(), {"board": {"typed_side_m": 0.05}, "place": "C"})
    assert (changed.board.typed_side_m, changed.board.side_m, changed.place) == (0.05, 0.075, "C")


def test_biased_rig_reads_35_mm_short_at_1250_mm():
    """z = f B / d with the given f and B, d from the true rig: 1.25 m reads 1.25 / (1.02 + 0.3 z / (f B))."""
    still = dict.fromkeys(("focal_rel", "centre_px", "right_turn_rad", "right_shift_m"), 0.0)
    pair = rig_of(sigmas=still, bias={"baseline_rel": 0.02, "disparity_px": 0.3})
    point = np.array([[0.0, 0.0, 1.25]])
    left = project(pair.truth.cameras["m_left"], point)
    right = project(pair.truth.cameras["m_right"], transform(inverse(pair.truth.left_T_right), point))
    disparity = (left - right)[0, 0]
    assert disparity == pytest.approx(270 * 0.15 * 1.02 / 1.25 + 0.3, abs=0.01)
    assert 1.25 - 270 * 0.15 / disparity == pytest.approx(0.0354, abs=0.001)


def test_drawn_faults_have_the_stated_spread():
    pairs = [rig_of(seed) for seed in range(300)]
    shifts = np.array(
        [
            transform(p.truth.f_T_b, np.zeros(3)) - p.rig.mount.f_T_b.translation_m  # pyright: ignore
            for p in pairs
        ]
    )
    assert np.allclose(shifts.std(axis=0), 0.001, rtol=0.15)
    offsets = np.array([p.truth.depth_offset_m for p in pairs])
    assert offsets.std() == pytest.approx(0.015, rel=0.15)
    assert all(p.truth.errors["baseline_rel"] >= 0 and p.truth.errors["disparity_px"] >= 0 for p in pairs)
    distances = np.array(
        [
            [
                d.distance_m
                - np.linalg.norm(np.subtract(markers[int(d.point_a)].centre_m, markers[int(d.point_b)].centre_m))
                for d in p.rig.distances
            ]
            for p in pairs
            for markers in [p.truth.markers]
        ]
    )
    assert distances.std() == pytest.approx(0.0003, rel=0.1)


def test_rig_file_is_whole_and_never_knows_the_faults():
    one, other = (
        rig_of(5, board={"measured_distances": False}),
        rig_of(5, board={"page_scale": 0.97, "measured_distances": False}),
    )
    assert load_rig(dump_rig(one.rig)) == one.rig
    assert one.rig == other.rig
    assert other.truth.markers[0].side_m == pytest.approx(0.97 * one.truth.markers[0].side_m, abs=1e-5)


def test_board_faults():
    typed = rig_of(1, board={"typed_side_m": 0.05})
    assert typed.rig.boards[0].side_m == 0.05
    assert typed.truth.markers[0].side_m == pytest.approx(0.075, abs=0.001)
    swapped = rig_of(1, board={"swapped": [1, 2]})
    assert [m.pattern_id for m in swapped.truth.markers] == [0, 2, 1, 3]
    loose = rig_of(1, board={"loose": {"id": 3}})
    moved = np.subtract(loose.truth.markers[3].centre_m, typed.truth.markers[3].centre_m)
    assert moved == pytest.approx([0.006, -0.004])


def kinect_camera() -> CameraModel:
    k = np.array([[585.0, 0, 159.5], [0, 585.0, 119.5], [0, 0, 1]])
    return CameraModel("b_depth", 320, 240, k, "plumb_bob", np.zeros(5), np.eye(3), None)


def true_rig(offset: float = 0.0, scale: float = 0.0) -> TrueRig:
    return TrueRig({}, np.eye(4), np.eye(4), np.eye(4), (), offset, scale, {})


def wall(z: float) -> Surface:
    return Surface(np.full((240, 320), z, np.float32), np.zeros((240, 320), np.float32))


@pytest.mark.parametrize("z", [0.8, 1.5, 2.5, 3.5])
@pytest.mark.parametrize("correlation", [0.0, 0.5])
def test_depth_noise_is_as_published(z, correlation):
    rng = np.random.default_rng(3)
    samples = np.stack([measure(wall(z), kinect_camera(), true_rig(), correlation, rng) for _ in range(6)])
    seen = samples[samples > 0]
    assert seen.size > 0.98 * samples.size
    assert seen.mean() == pytest.approx(z, abs=0.0015 * z)
    assert seen.std() == pytest.approx(0.0012 + 0.0019 * (z - 0.4) ** 2, rel=0.12)
    assert axial_sigma_m(np.float32(z), np.float32(0.0)) == pytest.approx(0.0012 + 0.0019 * (z - 0.4) ** 2)


def test_depth_comes_in_steps_of_disparity():
    seen = measure(wall(2.0), kinect_camera(), true_rig(), 0.0, np.random.default_rng(0))
    steps = 585.0 * BASELINE_M / seen[seen > 0] / STEP_PX
    assert np.abs(steps - np.rint(steps)).max() < 1e-2
    assert len(np.unique(seen)) < 12


def test_depth_offset_scale_and_range():
    rng = np.random.default_rng(0)
    seen = measure(wall(2.0), kinect_camera(), true_rig(0.02, 0.01), 0.0, rng)
    assert seen[seen > 0].mean() == pytest.approx(2.0 * 1.01 + 0.02, abs=0.003)
    assert not measure(wall(0.3), kinect_camera(), true_rig(), 0.0, rng).any()
    assert not measure(wall(5.0), kinect_camera(), true_rig(), 0.0, rng).any()
    assert not measure(wall(0.0), kinect_camera(), true_rig(), 0.0, rng).any()


def test_edges_fray_and_drop_out():
    z = np.full((240, 320), 2.0, np.float32)
    z[:, :160] = 1.0
    flat = np.zeros_like(z)
    seen = measure(Surface(z, flat), kinect_camera(), true_rig(), 0.0, np.random.default_rng(1))
    near_edge, away = seen[:, 157:163], seen[:, 20:100]
    assert 0.15 < (near_edge == 0).mean() < 0.6
    assert (away == 0).mean() < 0.01
    right = seen[:, 160]
    assert 0.05 < ((right > 0) & (right < 1.5)).sum() / (right > 0).sum() < 0.6


def test_atlas_returns_the_charts():
    rng = np.random.default_rng(0)
    charts = [rng.uniform(0, 1, shape).astype(np.float32) for shape in ((37, 50), (64, 64), (1, 3), (200, 9))]
    atlas = build_atlas(charts)
    for number, chart in enumerate(charts):
        rows, columns = np.indices(chart.shape).reshape(2, -1)
        index = np.full(rows.size, number, np.int32)
        texels = np.stack([columns + 0.5, rows + 0.5]).astype(np.float32)
        found = atlas.sample(index, texels, np.zeros(rows.size, np.float32))
        assert np.abs(found - chart.ravel()).max() < 1e-3
    square = np.full(1, 1, np.int32)
    top = atlas.sample(square, np.array([[32.0], [32.0]], np.float32), np.full(1, 6.0, np.float32))
    assert top[0] == pytest.approx(charts[1].mean(), abs=1e-3)
    half = atlas.sample(square, np.array([[3.0], [5.0]], np.float32), np.full(1, 1.0, np.float32))
    assert half[0] == pytest.approx(charts[1][4:6, 2:4].mean(), abs=1e-3)


def test_a_covered_lens_is_dark_and_opens_again():
    scenario = Scenario.model_validate({"timeline": {"covered": [[2.0, 3.0]]}})
    assert uncovered(scenario, 1.5) == 1.0
    assert uncovered(scenario, 2.5) == pytest.approx(0.004)
    assert 0.1 < uncovered(scenario, 3.1) < 1.0
