"""One run of a campaign: draw or render, estimate, evaluate. What comes back is a row that JSON can hold."""

import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from ..factors.errors import SurecutError
from .campaign_baseline import chain_of_run
from .campaign_decisions import decisions_of
from .campaign_estimate import estimate_run
from .campaign_pixels import run_pixels
from .campaign_row import Row, failed_row, row_of
from .evaluate import evaluate
from .evaluate_leave_out import estimate_without, leave_out_names
from .evaluate_sensitivity import sensitivities
from .measurement_level import Run, draw
from .measurement_level_scenario import Scenario

Level = Literal["measurements", "pixels"]


@dataclass(frozen=True, slots=True)
class RunOrder:
    """What a worker is told."""

    number: int
    level: Level
    scenario: Mapping[str, Any]
    """A scenario of that level, as data."""
    leave_out: bool = False
    decisions: bool = False
    sensitivity: bool = False
    recordings: Path | None = None
    """Folder that keeps what is rendered."""
    mounts_anew: bool = False


def run(order: RunOrder) -> Row:
    """One run. What the input cannot give is a row with its reason; a defect raises."""
    if order.level == "pixels":
        return run_pixels(order.number, order.scenario, order.recordings, order.mounts_anew)
    return run_measurements(
        order.number,
        Scenario.model_validate(order.scenario),
        order.leave_out,
        order.decisions,
        order.sensitivity,
    )


def run_measurements(
    number: int, scenario: Scenario, leave_out: bool = False, decisions: bool = False, sensitivity: bool = False
) -> Row:
    """One run at measurement level."""
    drawn = draw(scenario, number)
    begin = time.process_time()
    try:
        result = estimate_run(drawn)
    except SurecutError as error:
        return failed_row(number, scenario.name, str(error))
    row = row_of(number, scenario.name, result, evaluate(result, drawn.truth))
    row["seconds"] = time.process_time() - begin
    row["chain"] = chain_errors(drawn)
    if leave_out:
        row["leave_out"] = {name: _without(drawn, name) for name in leave_out_names()}
    if decisions:
        row["decisions"] = decisions_of(drawn, result, scenario, number)
    if sensitivity:
        row["sensitivity"] = [
            {"input": f"{one.input} by {one.step:g} {one.unit}", "moved_m": float(np.linalg.norm(one.moved_b_m))}
            for one in sensitivities(drawn)
        ]
    return row


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
