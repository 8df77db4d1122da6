"""Many runs together: errors, NEES with its acceptance interval, coverage with its binomial interval.

Quantities of one run depend on each other (two points share the whole chain), runs do not. Intervals of a quantity
that a run has several times are therefore those of as many independent values as there are runs: too wide rather
than too narrow.
"""

import math
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import beta, chi2

from .evaluate import Group, Quantity

LEVELS = (0.5, 0.9, 0.95, 0.99)
CONFIDENCE = 0.95


@dataclass(frozen=True, slots=True)
class Coverage:
    """How often the region of probability content `level` held the truth."""

    level: float
    share: float
    lower: float
    upper: float
    """Clopper-Pearson interval of the share."""

    @property
    def accepted(self) -> bool:
        """Whether the runs allow the share to be `level`."""
        return self.lower <= self.level <= self.upper


@dataclass(frozen=True, slots=True)
class Summary:
    """One quantity over all runs."""

    group: Group
    name: str
    unit: str
    runs: int
    values: int
    """Several per run for poses along the way."""
    without_covariance: int
    mean: float
    median: float
    percentile95: float
    worst: float
    rms: float
    rms_sigma: float
    """Root mean square of the predicted sigma: to be compared with `rms`."""
    mean_angle_rad: float | None
    nees_per_dof: float
    nees_lower: float
    nees_upper: float
    """Where NEES / dof lies in 95 % of campaigns of this size when the covariances are right."""
    coverage: tuple[Coverage, ...]
    beyond999: int
    """Values outside their own 99.9 % region."""


def summarise(runs: Iterable[Sequence[Quantity]]) -> tuple[Summary, ...]:
    """Summaries by quantity, and for groups of several names one over all of them (name `all`)."""
    by_name: dict[tuple[Group, str], list[list[Quantity]]] = defaultdict(list)
    for quantities in runs:
        in_run: dict[tuple[Group, str], list[Quantity]] = defaultdict(list)
        for quantity in quantities:
            in_run[quantity.group, quantity.name].append(quantity)
            if quantity.group in ("point", "pose_f"):
                in_run[quantity.group, "all"].append(quantity)
        for key, values in in_run.items():
            by_name[key].append(values)
    summaries = [_summary(group, name, values) for (group, name), values in by_name.items()]
    order = {
        "point": 0,
        "pose_b": 1,
        "pose_f": 2,
        "pose_m": 3,
        "trajectory": 4,
        "motion": 5,
        "calibration": 6,
        "pipe": 7,
    }
    return tuple(sorted(summaries, key=lambda one: (order[one.group], one.name != "all", one.name)))


def nees_interval(runs: int, dof: int, confidence: float = CONFIDENCE) -> tuple[float, float]:
    """Acceptance interval of mean NEES / dof over independent runs (chi-square of runs * dof degrees)."""
    if runs == 0:
        return math.nan, math.nan
    total = runs * dof
    tail = 0.5 * (1.0 - confidence)
    return float(chi2.ppf(tail, total) / total), float(chi2.ppf(1.0 - tail, total) / total)


def clopper_pearson(hits: float, trials: int, confidence: float = CONFIDENCE) -> tuple[float, float]:
    """Exact binomial interval of a share; `hits` may be fractional (a mean over dependent values)."""
    if trials == 0:
        return math.nan, math.nan
    tail = 0.5 * (1.0 - confidence)
    lower = 0.0 if hits <= 0 else float(beta.ppf(tail, hits, trials - hits + 1))
    upper = 1.0 if hits >= trials else float(beta.ppf(1.0 - tail, hits + 1, trials - hits))
    return lower, upper


def _summary(group: Group, name: str, runs: Sequence[Sequence[Quantity]]) -> Summary:
    values = [quantity for run in runs for quantity in run]
    errors = np.array([quantity.error for quantity in values])
    angles = [quantity.error_rad for quantity in values if quantity.error_rad is not None]
    usable = [[quantity for quantity in run if math.isfinite(quantity.nees)] for run in runs]
    usable = [run for run in usable if run]
    flat = [quantity for run in usable for quantity in run]
    nees_lower, nees_upper = nees_interval(len(usable), values[0].dof)
    sigmas = np.array([quantity.sigma for quantity in flat])
    return Summary(
        group=group,
        name=name,
        unit=values[0].unit,
        runs=len(runs),
        values=len(values),
        without_covariance=len(values) - len(flat),
        mean=float(errors.mean()),
        median=float(np.median(errors)),
        percentile95=float(np.quantile(errors, 0.95)),
        worst=float(errors.max()),
        rms=float(np.sqrt((errors**2).mean())),
        rms_sigma=float(np.sqrt((sigmas**2).mean())) if len(flat) else math.nan,
        mean_angle_rad=float(np.mean(angles)) if angles else None,
        nees_per_dof=float(np.mean([quantity.nees / quantity.dof for quantity in flat])) if flat else math.nan,
        nees_lower=nees_lower,
        nees_upper=nees_upper,
        coverage=tuple(_coverage(level, usable) for level in LEVELS),
        beyond999=sum(quantity.probability > 0.999 for quantity in flat),
    )


def _coverage(level: float, runs: Sequence[Sequence[Quantity]]) -> Coverage:
    """Share of all values; interval as of one value per run."""
    inside = [quantity.probability <= level for run in runs for quantity in run]
    share = float(np.mean(inside)) if inside else math.nan
    lower, upper = clopper_pearson(share * len(runs), len(runs)) if inside else (math.nan, math.nan)
    return Coverage(level, share, lower, upper)
