"""The tables of a campaign: rows to summaries, and to JSON, CSV and Parquet."""

import csv
import importlib
import importlib.util
import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np

from .campaign import write_whole
from .campaign_decisions import Decisions, summarise_decisions
from .campaign_row import Row, quantities_of
from .evaluate import Quantity
from .evaluate_summary import Coverage, Summary, clopper_pearson, summarise


@dataclass(frozen=True, slots=True)
class Errors:
    """A sample of errors, m."""

    count: int
    mean: float
    median: float
    percentile95: float
    worst: float


@dataclass(frozen=True, slots=True)
class LeftOut:
    """The points when one family is left out, against the same runs with all."""

    name: str
    runs: int
    failed: int
    mean_error_ratio: float
    mean_radius_ratio: float


@dataclass(frozen=True, slots=True)
class Compared:
    """The points against those of another campaign, over the runs that both have: the same seeds, the same scenes."""

    name: str
    runs: int
    mean_m: float
    other_mean_m: float
    coverage95: float
    other_coverage95: float
    nees_per_dof: float
    other_nees_per_dof: float

    @property
    def ratio(self) -> float:
        """Of the mean errors."""
        return self.mean_m / self.other_mean_m


@dataclass(frozen=True, slots=True)
class CampaignTable:
    """Everything that is said about a campaign."""

    runs: int
    failed: int
    reasons: dict[str, int]
    """Why runs failed."""
    summaries: tuple[Summary, ...]
    chain: Errors | None
    """The paper's method on the same runs, every click."""
    consistent: float
    consistent_interval: tuple[float, float]
    """Share of the runs that passed their own consistency check."""
    inconsistency_reasons: dict[str, int]
    unflagged_beyond999: int
    """Points outside their own 99.9 % region in runs that passed the check."""
    chi2_per_dof: dict[str, float]
    """By family, mean over the runs."""
    left_out: tuple[LeftOut, ...]
    rejected_per_run: dict[str, float]
    events: dict[str, int]
    mean_seconds: float
    decisions: tuple[Decisions, ...] = ()
    streaming_sigma: dict[str, tuple[float, float]] = field(default_factory=dict)
    """The running estimate at the end against the batch optimum of the same factors, in sigmas of the latter, by kind
    of variable: mean and worst run."""
    sensitivity_m: dict[str, tuple[float, float]] = field(default_factory=dict)
    """How far the points move for an input error: mean and worst."""
    compared: Compared | None = None


def tabulate(rows: Sequence[Row], other: tuple[str, Sequence[Row]] | None = None) -> CampaignTable:
    """All rows of a campaign in one table.

    Args:
        rows: the runs.
        other: name and rows of another campaign with the same seeds, to compare with.
    """
    good = [row for row in rows if row["status"] == "done"]
    passed = sum(row["consistent"] for row in good)
    chain = [error for row in good for error in row["chain"]]
    return CampaignTable(
        runs=len(rows),
        failed=len(rows) - len(good),
        reasons=dict(Counter(row["reason"][:160] for row in rows if row["status"] != "done").most_common(10)),
        summaries=summarise([quantities_of(row) for row in good]),
        chain=errors_of(chain) if chain else None,
        consistent=passed / len(good) if good else float("nan"),
        consistent_interval=clopper_pearson(passed, len(good)),
        inconsistency_reasons=dict(
            Counter(reason for row in good for reason in _kinds(row["consistency_reasons"])).most_common(12)
        ),
        unflagged_beyond999=sum(
            quantity.group == "point" and quantity.probability > 0.999
            for row in good
            if row["consistent"]
            for quantity in quantities_of(row)
        ),
        chi2_per_dof=_means([row["chi2_per_dof"] for row in good]),
        left_out=_left_out(good),
        rejected_per_run={
            family: count / max(1, len(good))
            for family, count in sum((Counter(row["rejected"]) for row in good), Counter()).items()
        },
        events=dict(Counter(kind for row in good for kind in set(row["events"]))),
        mean_seconds=float(np.mean([row.get("seconds", np.nan) for row in good])) if good else float("nan"),
        decisions=summarise_decisions(good),
        streaming_sigma=_mean_and_worst([row.get("streaming_difference_sigma", {}) for row in good]),
        sensitivity_m=_mean_and_worst(
            [{one["input"]: one["moved_m"]} for row in good for one in row.get("sensitivity", ())]
        ),
        compared=None if other is None else _compared(rows, *other),
    )


def _compared(rows: Sequence[Row], name: str, others: Sequence[Row]) -> Compared | None:
    """None where no run is in both."""
    mine, theirs = (_points_by_run(some) for some in (rows, others))
    both = sorted(set(mine) & set(theirs))
    if not both:
        return None
    error, coverage, nees = zip(*(_figures(some, both) for some in (mine, theirs)), strict=True)
    return Compared(name, len(both), *error, *coverage, *nees)


def _points_by_run(rows: Sequence[Row]) -> dict[int, list[Quantity]]:
    found = {
        row["run"]: [q for q in quantities_of(row) if q.group == "point"] for row in rows if row["status"] == "done"
    }
    return {run: points for run, points in found.items() if points}


def _figures(points_by_run: dict[int, list[Quantity]], runs: Sequence[int]) -> tuple[float, float, float]:
    """Mean error, coverage of the 95 % region and NEES / dof of some runs' points."""
    points = [point for run in runs for point in points_by_run[run]]
    return (
        float(np.mean([point.error for point in points])),
        float(np.mean([point.probability <= 0.95 for point in points])),
        float(np.mean([point.nees / point.dof for point in points])),
    )


def errors_of(errors_m: Sequence[float]) -> Errors:
    """Mean, median, 95 % and worst."""
    values = np.array(errors_m)
    return Errors(
        len(values),
        float(values.mean()),
        float(np.median(values)),
        float(np.quantile(values, 0.95)),
        float(values.max()),
    )


def write_tables(folder: Path, table: CampaignTable, rows: Sequence[Row]) -> list[Path]:
    """`summary.json`, `summary.csv`, `quantities.csv`, and `quantities.parquet` where pyarrow is there."""
    paths = [folder / "summary.json", folder / "summary.csv", folder / "quantities.csv"]
    write_whole(paths[0], json.dumps(_json(asdict(table)), indent=1))
    write_whole(paths[1], _csv([_summary_row(summary) for summary in table.summaries]))
    flat = [
        {"run": row["run"], "scenario": row["scenario"], **quantity} for row in rows for quantity in row["quantities"]
    ]
    write_whole(paths[2], _csv(flat))
    if importlib.util.find_spec("pyarrow") is not None and flat:
        pyarrow, parquet = importlib.import_module("pyarrow"), importlib.import_module("pyarrow.parquet")
        parquet.write_table(pyarrow.Table.from_pylist(flat), folder / "quantities.parquet")
        paths.append(folder / "quantities.parquet")
    return paths


def coverage_at(summary: Summary, level: float) -> Coverage:
    """The coverage of one level."""
    return next(coverage for coverage in summary.coverage if coverage.level == level)


def _left_out(rows: Sequence[Row]) -> tuple[LeftOut, ...]:
    names = list(dict.fromkeys(name for row in rows for name in row.get("leave_out", {})))
    return tuple(_one_left_out(name, [row for row in rows if name in row.get("leave_out", {})]) for name in names)


def _one_left_out(name: str, rows: Sequence[Row]) -> LeftOut:
    good = [row for row in rows if not row["leave_out"][name]["reason"] and row["leave_out"][name]["errors_m"]]
    with_all = [q["error"] for row in good for q in row["quantities"] if q["group"] == "point"]
    without = [error for row in good for error in row["leave_out"][name]["errors_m"]]
    radii = [radius for row in good for radius in row["radius95_m"]]
    radii_without = [radius for row in good for radius in row["leave_out"][name]["radius95_m"]]
    return LeftOut(
        name=name,
        runs=len(rows),
        failed=len(rows) - len(good),
        mean_error_ratio=float(np.mean(without) / np.mean(with_all)) if good else float("nan"),
        mean_radius_ratio=float(np.mean(radii_without) / np.mean(radii)) if good else float("nan"),
    )


def _kinds(reasons: Sequence[str]) -> set[str]:
    """Reasons without their numbers, so that they can be counted."""
    return {reason.split(":", 1)[0] for reason in reasons}


def _means(values: Sequence[dict[str, float]]) -> dict[str, float]:
    names = list(dict.fromkeys(name for one in values for name in one))
    return {name: float(np.mean([one[name] for one in values if name in one])) for name in names}


def _mean_and_worst(found: Sequence[dict[str, float]]) -> dict[str, tuple[float, float]]:
    names = list(dict.fromkeys(name for one in found for name in one))
    values = {name: [one[name] for one in found if name in one] for name in names}
    return {name: (float(np.mean(values[name])), float(np.max(values[name]))) for name in names}


def _summary_row(summary: Summary) -> dict[str, Any]:
    row = {key: value for key, value in asdict(summary).items() if key != "coverage"}
    for coverage in summary.coverage:
        percent = f"{100 * coverage.level:g}"
        row |= {
            f"coverage{percent}": coverage.share,
            f"coverage{percent}_lower": coverage.lower,
            f"coverage{percent}_upper": coverage.upper,
        }
    return row


def _csv(rows: Sequence[dict[str, Any]]) -> str:
    if not rows:
        return ""
    text = StringIO()
    writer = csv.DictWriter(text, list(rows[0]))
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def _json(value: Any) -> Any:
    """JSON has no NaN."""
    if isinstance(value, dict):
        return {key: _json(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [_json(one) for one in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value
