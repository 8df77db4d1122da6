"""One run of a campaign: draw or render, estimate, evaluate. What comes back is a row that JSON can hold."""

import math
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np

from ..estimator.result import Result
from ..factors.errors import SurecutError
from .campaign_baseline import chain_of_run
from .campaign_estimate import estimate_run
from .evaluate import Quantity, evaluate
from .evaluate_leave_out import estimate_without, leave_out_names
from .measurement_level import Run, draw
from .measurement_level_scenario import Scenario

Level = Literal["measurements", "pixels"]
Row = dict[str, Any]


@dataclass(frozen=True, slots=True)
class RunOrder:
    """What a worker is told."""

    number: int
    level: Level
    scenario: Mapping[str, Any]
    """A scenario of that level, as data."""
    leave_out: bool = False


def run(order: RunOrder) -> Row:
    """One run. What the input cannot give is a row with its reason; a defect raises."""
    if order.level == "pixels":
        from .campaign_pixels import run_pixels

        return run_pixels(order.number, order.scenario)
    return run_measurements(order.number, Scenario.model_validate(order.scenario), leave_out=order.leave_out)


def run_measurements(number: int, scenario: Scenario, leave_out: bool = False) -> Row:
    """One run at measurement level."""
    drawn = draw(scenario, number)
    begin = time.perf_counter()
    try:
        result = estimate_run(drawn)
    except SurecutError as error:
        return failed_row(number, scenario.name, str(error))
    row = row_of(number, scenario.name, result, evaluate(result, drawn.truth))
    row["seconds"] = time.perf_counter() - begin
    row["chain"] = chain_errors(drawn)
    if leave_out:
        row["leave_out"] = {name: _without(drawn, name) for name in leave_out_names()}
    return row


def row_of(number: int, scenario: str, result: Result, quantities: Sequence[Quantity]) -> Row:
    """The row of a run that gave a result."""
    consistency = result.consistency
    return {
        "run": number,
        "scenario": scenario,
        "status": "done",
        "reason": "",
        "quantities": [_plain(asdict(quantity)) for quantity in quantities],
        "radius95_m": [point.radius95_m for point in result.points],
        "consistent": bool(consistency.passed),
        "consistency_reasons": list(consistency.reasons),
        "chi2_per_dof": {family.family: family.chi2 / family.dof for family in consistency.by_family if family.dof > 0},
        "paths_sigma": dict(consistency.paths),
        "rejected": dict(Counter(rejection.family for rejection in result.rejected)),
        "events": [event.kind for event in result.events],
        "streaming_difference_sigma": dict(result.streaming_difference_sigma),
        "timing_s": dict(result.timing),
        "chain": [],
    }


def failed_row(number: int, scenario: str, reason: str) -> Row:
    """The row of a run that gave none."""
    return {"run": number, "scenario": scenario, "status": "failed", "reason": reason, "quantities": [], "chain": []}


def quantities_of(row: Row) -> list[Quantity]:
    """The quantities of a row, as they were before JSON."""
    return [
        Quantity(**{key: math.nan if value is None and key != "error_rad" else value for key, value in one.items()})
        for one in row["quantities"]
    ]


def chain_errors(drawn: Run) -> list[float]:
    """Error of the paper's chain at every click that it answers, m."""
    try:
        points = chain_of_run(drawn)
    except SurecutError:
        return []
    return [
        float(np.linalg.norm(point.position_b_m - drawn.truth.points_b_m[point.point_id]))
        for point in points
        if point.position_b_m is not None
    ]


def _without(drawn: Run, name: str) -> Row:
    """Errors and predicted radii of the points when one family is left out."""
    try:
        result = estimate_without(drawn, name)
    except SurecutError as error:
        return {"reason": str(error), "errors_m": [], "radius95_m": []}
    errors = [quantity.error for quantity in evaluate(result, drawn.truth) if quantity.group == "point"]
    return {"reason": "", "errors_m": errors, "radius95_m": [point.radius95_m for point in result.points]}


def _plain(values: dict[str, Any]) -> dict[str, Any]:
    """JSON has no NaN."""
    return {
        key: None if isinstance(value, float) and not math.isfinite(value) else value for key, value in values.items()
    }
