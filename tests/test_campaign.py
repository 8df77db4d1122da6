"""Campaigns on short runs: resumable, failures as rows, tables and page."""

import json
import math
from dataclasses import asdict

import numpy as np
import pytest

from surecut.estimator.executor import SerialExecutor
from surecut.factors.errors import SurecutError
from surecut.simulation import campaign as campaign_module
from surecut.simulation.campaign import Campaign, failures, open_campaign, run_campaign
from surecut.simulation.campaign_report import report_html
from surecut.simulation.campaign_row import failed_row, quantities_of
from surecut.simulation.campaign_run import run_measurements
from surecut.simulation.campaign_table import coverage_at, tabulate, write_tables
from surecut.simulation.campaign_validation import update_validation
from surecut.simulation.evaluate import point_quantity, scalar_quantity
from surecut.simulation.measurement_level_scenario import Scenario

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


def test_paper_b_is_nine_recordings_at_pixel_level():
    campaign = open_campaign("paper-b", "pixels")
    assert len(campaign.scenarios) == 9
    assert campaign.order(11).scenario["name"] == "paper-b-a3"


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
