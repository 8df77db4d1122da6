"""Campaigns on short runs: resumable, failures as rows, tables and page."""

import json
import math
from dataclasses import asdict

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from surecut.estimator.decision import tolerance_probability
from surecut.estimator.executor import SerialExecutor
from surecut.estimator.validated_range import QUANTITIES, load_validated_range, range_text, seal
from surecut.factors.errors import RigError, SurecutError
from surecut.factors.rig import Board, Marker, Mount, Pose, Rig
from surecut.simulation import campaign as campaign_module
from surecut.simulation.campaign import Campaign, failures, open_campaign, run_campaign
from surecut.simulation.campaign_decisions import _cuts, ideal_covariances
from surecut.simulation.campaign_range import validated_range
from surecut.simulation.campaign_report import report_html
from surecut.simulation.campaign_row import failed_row, quantities_of
from surecut.simulation.campaign_run import run_measurements
from surecut.simulation.campaign_table import coverage_at, tabulate, write_tables
from surecut.simulation.campaign_validation import update_validation, validation_section
from surecut.simulation.evaluate import point_quantity, scalar_quantity
from surecut.simulation.measurement_level_scenario import Scenario, load_scenarios
from surecut.simulation.rigid import inverse, rigid
from surecut.simulation.stated_mount import with_mount_anew

SHORT = Scenario.model_validate(
    {
        "name": "short",
        "motion": {"duration_s": 16.0},
        "tracks": {"per_frame": 50},
        "clouds": {"frames": 0},
    }
)


@pytest.fixture(scope="module")
def short_rows():
    return [run_measurements(seed, SHORT) for seed in range(2)]


def short_campaign():
    return Campaign("measurements", (SHORT.model_dump(mode="json"),))


def test_a_run_gives_errors_of_every_quantity_and_survives_json(short_rows):
    row = json.loads(json.dumps(short_rows[0], allow_nan=False))
    assert row["status"] == "done", row["reason"]
    quantities = quantities_of(row)
    assert {"point", "pose_b", "pose_f", "pose_m", "trajectory", "calibration"} <= {q.group for q in quantities}
    assert {q.name for q in quantities if q.group == "point"} == {"P1", "P2"}
    assert all(q.nees > 0 and 0 <= q.probability <= 1 for q in quantities if q.group == "point")
    # Loose: six seconds of camera. A wrong frame or order of the covariance would be off by orders of magnitude.
    assert all(q.error < 0.3 for q in quantities if q.group == "point")
    assert all(q.nees < 60 for q in quantities if q.group == "pose_b")
    assert len(row["chain"]) > 0


def test_table_and_page(short_rows, tmp_path):
    rows = [*short_rows, failed_row(2, "short", "the board was never seen")]
    table = tabulate(rows)
    assert (table.runs, table.failed, table.reasons) == (3, 1, {"the board was never seen": 1})
    page = report_html("short", table, rows, ["a note with <angles>"])
    assert page.count("<svg") == 3
    assert "&lt;angles&gt;" in page
    assert "http" not in page.replace("http://www.w3.org", "")
    paths = write_tables(tmp_path, table, rows)
    assert json.loads(paths[0].read_text())["failed"] == 1
    assert paths[2].read_text().startswith("run,scenario,group,name,dof,nees")


def rows_with(nees, passed=True):
    quantities = [point_quantity("P1", np.zeros(3), 1e-4 * np.eye(3), np.array([math.sqrt(1e-4 * nees), 0.0, 0.0]))]
    row = failed_row(0, "s", "")
    return row | {
        "status": "done",
        "quantities": [asdict(quantity) for quantity in quantities],
        "consistent": passed,
        "consistency_reasons": [] if passed else ["marker corners: residuals are 2 times"],
        "chi2_per_dof": {"marker corners": 1.0},
        "rejected": {"marker corners": 3},
        "events": [],
        "chain": [0.2],
        "radius95_m": [0.01],
        "seconds": 1.0,
    }


def test_a_point_beyond_its_region_counts_only_when_the_check_was_silent():
    table = tabulate([rows_with(3.0), rows_with(40.0), rows_with(40.0, passed=False)])
    assert table.unflagged_beyond999 == 1
    assert table.consistent == pytest.approx(2 / 3)
    assert table.inconsistency_reasons == {"marker corners": 1}
    summary = next(one for one in table.summaries if one.name == "P1")
    assert summary.nees_per_dof == pytest.approx(83.0 / 9.0)
    assert coverage_at(summary, 0.95).share == pytest.approx(1 / 3)


def test_runs_are_resumed_and_failures_are_rows(tmp_path, monkeypatch):
    called = []

    def stub(order):
        called.append(order.number)
        if order.number == 1:
            raise ValueError("a defect")
        return rows_with(3.0) | {"run": order.number}

    monkeypatch.setattr(campaign_module, "run", stub)
    counts = []
    rows = run_campaign(tmp_path, short_campaign(), 3, SerialExecutor(), counts.append)
    assert [row["run"] for row in rows] == called == [0, 1, 2]
    assert [row["reason"] for row in failures(rows)] == ["ValueError: a defect"]
    (tmp_path / "runs" / "000002.json").unlink()
    rows = run_campaign(tmp_path, short_campaign(), 4, SerialExecutor(), counts.append)
    assert called == [0, 1, 2, 2, 3]
    assert [row["run"] for row in rows] == [0, 1, 2, 3]
    assert counts == [0, 1, 1, 1, 2, 1, 1]


def test_a_folder_belongs_to_one_campaign(tmp_path, monkeypatch):
    monkeypatch.setattr(campaign_module, "run", lambda order: rows_with(3.0) | {"run": order.number})
    run_campaign(tmp_path, short_campaign(), 1, SerialExecutor())
    other = Campaign("measurements", (SHORT.model_copy(update={"seed": 1}).model_dump(mode="json"),))
    with pytest.raises(SurecutError, match="other settings"):
        run_campaign(tmp_path, other, 1, SerialExecutor())


@pytest.mark.parametrize("name", ["cell", "sharp", "half-noise", "outliers", "no-kinect", "open", "wrong-side"])
def test_scenarios_that_come_along_are_valid(name):
    (scenario,) = open_campaign(name, "measurements").scenarios
    assert scenario["name"] == name


@pytest.mark.parametrize("level", ["pixels", "measurements"])
def test_paper_b_is_nine_runs_at_both_levels(level):
    campaign = open_campaign("paper-b", level)
    assert len(campaign.scenarios) == 9
    assert campaign.order(11).scenario["name"] == "paper-b-a3"


@pytest.mark.parametrize(
    ("name", "level"), [("paper-a", "pixels"), ("paper-a", "measurements"), ("validation", "pixels")]
)
def test_campaigns_of_several_conditions(name, level):
    assert len({one["name"] for one in open_campaign(name, level).scenarios}) >= 3


def test_entries_of_a_scenario_file_lie_over_its_common_keys(tmp_path):
    file = tmp_path / "two.yaml"
    file.write_text("motion: {duration_s: 9}\nruns:\n  - {name: a}\n  - {name: b, motion: {style: sharp}}\n")
    a, b = load_scenarios(file)
    assert (a.name, a.motion.duration_s, a.motion.style) == ("a", 9.0, "smooth")
    assert (b.name, b.motion.duration_s, b.motion.style) == ("b", 9.0, "sharp")


def test_a_validated_range_spans_what_the_runs_covered_and_refuses_what_refutes_it(tmp_path):
    covered = [dict.fromkeys(QUANTITIES, value + 1.0) for value in range(50)]
    rows = [rows_with(3.0) | {"run": i, "covered": [covered[i]]} for i in range(50)]
    rows.append(rows_with(3.0, passed=False) | {"covered": [{"distance_m": 99.0}]})
    found = validated_range(rows, "measurements", "2030-01-01, commit a")
    assert (found.runs, found.coverage95, found.level) == (50, 1.0, "measurements")
    # central 98 % of 1, 2, ... 50: quantiles by linear interpolation, 1 + 49 q
    assert found.ranges["distance_m"] == (1.49, 49.51)
    # one poor run among two hundred does not widen what counts as tested
    poor = rows_with(3.0) | {"covered": [dict.fromkeys(QUANTITIES, 900.0)]}
    assert validated_range([*rows[:50] * 4, poor], "measurements", "").ranges["radius95_m"] == (1.0, 50.0)
    file = tmp_path / "range.yaml"
    file.write_text(range_text(found))
    assert load_validated_range(file) == seal(found)
    with pytest.raises(SurecutError, match="give more --runs"):
        validated_range(rows[:20], "measurements", "")
    with pytest.raises(SurecutError, match="validates nothing"):
        validated_range([row | rows_with(30.0) for row in rows], "measurements", "")


def test_decisions_count_wrong_gos_among_the_gos():
    cuts = [
        {"allowed": 0.05, "factor": 1.05, "ideal": True, "go": True, "inside": True},
        {"allowed": 0.05, "factor": 1.3, "ideal": True, "go": True, "inside": False},
        {"allowed": 0.05, "factor": 0.9, "ideal": False, "go": False, "inside": False},
        {"allowed": 0.01, "factor": 1.2, "ideal": True, "go": False, "inside": False},
    ]
    five, one = tabulate([rows_with(3.0) | {"decisions": cuts}]).decisions
    assert (five.cuts, five.go, five.ideal_go, five.wrong) == (3, pytest.approx(2 / 3), pytest.approx(2 / 3), 0.5)
    assert (five.border, five.border_wrong) == (1, 0.0)
    assert (one.cuts, one.go, one.ideal_go, one.wrong) == (1, 0.0, 1.0, 0.0)


def test_the_ideal_covariance_is_that_of_the_estimate_but_for_its_noise(short_rows):
    ideal = ideal_covariances(SHORT, 0)["P1"]
    stated = next(q for q in quantities_of(short_rows[0]) if q.name == "P1").sigma
    assert np.sqrt(np.trace(ideal)) == pytest.approx(stated, rel=0.25)


def test_the_ideal_rule_is_just_content_at_factor_one():
    covariance, axis = np.diag([4e-6, 1e-6, 9e-6]), np.array([0.0, 0.0, 1.0])
    for cut, factor in _cuts("P1", covariance, axis, np.random.default_rng(0)):
        held = tolerance_probability(cut, covariance, axis)
        assert (held >= 1 - cut.wrong_go_probability) == (factor >= 1.0)


def test_an_unknown_scenario_names_those_that_there_are():
    with pytest.raises(SurecutError, match=r"cell.*half-noise"):
        open_campaign("nowhere", "measurements")


def test_a_section_of_the_validation_page_is_replaced_and_others_stay(tmp_path):
    page = tmp_path / "docs" / "validation.md"
    update_validation(page, "cell", "measurements", tabulate([rows_with(3.0)]), "2030-01-01, commit a")
    update_validation(page, "real", "real", "| old |", "2030-01-01, commit a")
    update_validation(page, "real", "real", "| new |", "2030-01-02, commit b")
    text = page.read_text()
    assert text.count("## cell, measurements") == 1
    assert "| new |" in text
    assert "| old |" not in text
    assert text.startswith("# Validation")


def test_scalars_without_a_covariance_are_counted():
    bad = scalar_quantity("calibration", "baseline", 0.15, 0.0, 0.15, "m")
    assert math.isnan(bad.nees)


def test_points_beside_those_of_another_campaign():
    """Only runs that both have count, and of two campaigns the errors' means are compared."""
    mine = [rows_with(4.0 * 9.0) | {"run": 0}, rows_with(4.0) | {"run": 1}, rows_with(900.0) | {"run": 7}]
    others = [rows_with(4.0) | {"run": 0}, rows_with(1.0) | {"run": 1}, rows_with(1.0) | {"run": 2}]
    table = tabulate(mine, ("clean", others))
    found = table.compared
    assert found is not None
    # errors are 10 mm times the root of the squared deviation: 60 and 20 mm against 20 and 10 mm
    assert (found.runs, found.mean_m, found.other_mean_m) == (2, pytest.approx(0.04), pytest.approx(0.015))
    assert found.ratio == pytest.approx(0.04 / 0.015)
    # 11.3 is the 99 % point of chi-square with three degrees of freedom, 7.8 the 95 % one
    assert (found.coverage95, found.other_coverage95) == (0.5, 1.0)
    assert (found.nees_per_dof, found.other_nees_per_dof) == (pytest.approx(40 / 6), pytest.approx(5 / 6))
    assert "| ratio | x 2.67 |" in validation_section(table)
    assert tabulate(mine, ("clean", [rows_with(1.0) | {"run": 5}])).compared is None


def test_what_is_left_out_and_what_inputs_do_is_in_table_and_page():
    without = {"reason": "", "errors_m": [0.03], "radius95_m": [0.08]}
    failed = {"reason": "no board", "errors_m": [], "radius95_m": []}
    rows = [
        rows_with(4.0) | {
            "run": run,
            "radius95_m": [0.02],
            "leave_out": {"marker corners": without if run else failed, "picks": without},
            "sensitivity": [{"input": "baseline by 1 mm", "moved_m": 0.004 * (run + 1)}],
        }
        for run in range(2)
    ]  # fmt: skip
    table = tabulate(rows)
    corners, picks = table.left_out
    assert (corners.name, corners.runs, corners.failed) == ("marker corners", 2, 1)
    assert (corners.mean_error_ratio, corners.mean_radius_ratio) == (pytest.approx(1.5), pytest.approx(4.0))
    assert (picks.failed, picks.mean_error_ratio) == (0, pytest.approx(1.5))
    assert table.sensitivity_m == {"baseline by 1 mm": (pytest.approx(0.006), pytest.approx(0.008))}
    text = validation_section(table)
    assert "marker corners x 1.50 (radius x 4.00, 1 of 2 without a result)" in text
    assert "baseline by 1 mm: 6.0 mm" in text
    page = report_html("s", table, rows)
    assert "Without one family" in page
    assert "baseline by 1 mm" in page


def test_mounts_drawn_anew_have_the_stated_tolerance(tmp_path):
    rig = Rig(boards=(Board(id="f0", side_m=0.075, markers=(Marker(id=0, centre_m=(0.0, 0.0)),)),))
    with pytest.raises(RigError, match="no mount"):
        with_mount_anew(rig, np.eye(4), 0)
    mount = Mount(board="f0", f_T_b=Pose(), translation_sigma_m=0.004, rotation_sigma_rad=0.03)
    rig = rig.model_copy(update={"mount": mount})
    true = rigid((0.3, -0.2, 0.1), (0.1, 0.2, 0.3))
    drawn = [with_mount_anew(rig, true, seed).mount for seed in range(400)]
    off = np.array([inverse(true) @ rigid(m.f_T_b.rotation_vector_rad, m.f_T_b.translation_m) for m in drawn if m])
    assert off[:, :3, 3].std() == pytest.approx(0.004, rel=0.06)
    turns = Rotation.from_matrix(off[:, :3, :3]).as_rotvec()
    assert turns.std() == pytest.approx(0.03, rel=0.06)
    assert with_mount_anew(rig, true, 3) == with_mount_anew(rig, true, 3)
    (tmp_path / "a.mcap").touch()
    assert open_campaign(str(tmp_path), "pixels", mounts_anew=True).order(0).mounts_anew
    with pytest.raises(SurecutError, match="recordings only"):
        open_campaign("cell", "measurements", mounts_anew=True)


def test_a_folder_of_recordings_is_a_scenario(tmp_path):
    for name in ("b", "a"):
        (tmp_path / f"{name}.mcap").touch()
    campaign = open_campaign(str(tmp_path), "pixels")
    assert [campaign.order(i).scenario["name"] for i in (0, 1, 2)] == ["a", "b", "a"]
    (tmp_path / "empty").mkdir()
    with pytest.raises(SurecutError, match="holds no recordings"):
        open_campaign(str(tmp_path / "empty"), "pixels")
