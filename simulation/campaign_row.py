"""A run's row: what JSON holds of it."""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from ..estimator.result import Result
from ..estimator.validated_range import quantities as covered
from .evaluate import Quantity

Row = dict[str, Any]


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
        "covered": [_plain(covered(result, point)) for point in result.points],
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
    return [Quantity(**_numbers(one)) for one in row["quantities"]]


def _numbers(one: dict[str, Any]) -> dict[str, Any]:
    """JSON has no NaN: null stands for it, but where null is meant."""
    return {key: math.nan if value is None and key != "error_rad" else value for key, value in one.items()}


def _plain(values: dict[str, Any]) -> dict[str, Any]:
    """JSON has no NaN."""
    return {
        key: None if isinstance(value, float) and not math.isfinite(value) else value for key, value in values.items()
    }
