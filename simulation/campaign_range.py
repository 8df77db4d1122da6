"""The validated range that a campaign supports: how true its regions were, and what its runs covered."""

from collections.abc import Sequence

import numpy as np

from ..estimator.validated_range import LEAST_COVERAGE, QUANTITIES, ValidatedRange
from ..factors.errors import SurecutError
from .campaign_row import Row, quantities_of

DOCUMENT = "docs/validation.md"
CENTRAL = 0.98
"""Share of the runs that a range spans: a single run that went poorly must not widen what counts as tested."""
FEWEST_RUNS = 40
"""Below it the coverage is not known to a few per cent."""


def validated_range(rows: Sequence[Row], level: str, stamp: str) -> ValidatedRange:
    """The range of the runs whose consistency check passed, as only those may lead to a cut.

    Raises:
        SurecutError: the campaign is too small, or its regions did not hold the truth often enough.
    """
    good = [row for row in rows if row["status"] == "done" and row["consistent"] and row.get("covered")]
    if len(good) < FEWEST_RUNS:
        raise SurecutError(
            f"a validated range needs {FEWEST_RUNS} runs with a result that passed the consistency check, here are "
            f"{len(good)}; give more --runs"
        )
    points = [quantity for row in good for quantity in quantities_of(row) if quantity.group == "point"]
    coverage = sum(point.probability <= 0.95 for point in points) / len(points)
    if coverage < LEAST_COVERAGE:
        raise SurecutError(
            f"the 95 % regions held the truth in {100 * coverage:.1f} % only; such a campaign validates nothing"
        )
    return ValidatedRange(
        document=DOCUMENT,
        stamp=stamp,
        level=level,
        scenarios=tuple(sorted({row["scenario"] for row in good})),
        runs=len(good),
        coverage95=round(coverage, 4),
        nees_per_dof=round(sum(point.nees / point.dof for point in points) / len(points), 3),
        ranges={name: found for name in QUANTITIES if (found := _spread(good, name)) is not None},
    )


def _spread(rows: Sequence[Row], name: str) -> tuple[float, float] | None:
    """What the central `CENTRAL` of the runs covered; None where no run has it."""
    values = [one[name] for row in rows for one in row["covered"] if one.get(name) is not None]
    if not values:
        return None
    low, high = np.quantile(values, [(1 - CENTRAL) / 2, (1 + CENTRAL) / 2])
    return float(f"{low:.4g}"), float(f"{high:.4g}")
