"""Is a GO as safe as it says, and is it given where it could be? Random cuts, decided by the whole chain.

The ideal rule knows the true covariance: that of the same graph at measurements without noise, linearised next to the
truth, whatever the residuals of the noisy run made of it. Tolerances are drawn about those at which the ideal rule is
just content, where a rule that is too bold or too shy shows. An outcome adds the tool's own error to the estimate's.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..estimator.bundle import bundles
from ..estimator.decision import decide, tolerance_probability
from ..estimator.engine import Engine
from ..estimator.linear import LinearSystem
from ..estimator.points_in_base import point_blocks
from ..estimator.result import Result
from ..estimator.result_json import from_json, to_json
from ..estimator.surfaces import lay_on_surfaces
from ..estimator.validated_range import ValidatedRange
from ..factors import keys
from ..factors.rig import Cut, load_rig
from .evaluate_summary import clopper_pearson
from .measurement_level import Run, draw
from .measurement_level_scenario import NoiseFactors, Scenario
from .measurement_level_truth import Float

ALLOWED = (0.05, 0.01)
CUTS = 4
"""Random cuts per point and allowed rate."""
NOISELESS = 1e-3
SPREAD = (0.7, 1.4)
"""Tolerances over those at which the ideal rule is just content, log-uniform."""
BORDER = 1.1
"""Up to this factor on the ideal rule's limit a cut counts as borderline."""
RANGE = ValidatedRange(document="this campaign", runs=1, coverage95=1.0, nees_per_dof=1.0, ranges={})
"""The range comes out of campaigns, so that it cannot be a condition within them."""


@dataclass(frozen=True, slots=True)
class Decisions:
    """All cuts of one allowed rate."""

    allowed: float
    cuts: int
    runs: int
    go: float
    """Share of the cuts that were permitted."""
    ideal_go: float
    """Share that the ideal rule permits."""
    wrong: float
    """Share of the permitted cuts that missed their limits."""
    wrong_lower: float
    wrong_upper: float
    border: int
    """Permitted cuts next to the ideal rule's limit."""
    border_wrong: float


def decisions_of(drawn: Run, result: Result, scenario: Scenario, number: int) -> list[dict[str, Any]]:
    """Every cut of one run: the allowed rate, the verdicts, and how it came out. A lost point is no GO."""
    rng = np.random.default_rng([scenario.seed, number, 8])
    true = ideal_covariances(scenario, number)
    plan = [
        (cut, factor) for name in sorted(true) for cut, factor in _cuts(name, true[name], drawn.truth.pipe.axis_b, rng)
    ]
    stored = from_json(to_json(result), "result")
    rig = load_rig(stored.config_yaml, "result").model_copy(update={"cut_plan": tuple(cut for cut, _ in plan)})
    estimates = {point.id: point.position_m for point in stored.points}
    found = []
    for (cut, factor), decision in zip(plan, decide(stored, rig, RANGE), strict=True):
        tool = rng.normal(0.0, cut.tool_sigma_m, 3)
        go = decision.verdict == "GO"
        inside = go and _inside(
            cut, drawn.truth.points_b_m[cut.point] - estimates[cut.point] + tool, drawn.truth.pipe.axis_b
        )
        found.append(
            {"allowed": cut.wrong_go_probability, "factor": factor, "ideal": factor >= 1.0, "go": go, "inside": inside}
        )
    return found


def ideal_covariances(scenario: Scenario, number: int) -> dict[str, Float]:
    """Covariance of every point of a run, shape (3, 3), next to the truth: same scene, same faults, no noise."""
    silent = NoiseFactors(**dict.fromkeys(NoiseFactors.model_fields, NOISELESS))
    run = draw(scenario.model_copy(update={"noise_factors": silent}), number)
    engine = Engine(run.rig, run.cameras, lay_on_surfaces, advises=False)
    for bundle in bundles(list(run.measurements)):
        engine.add(bundle)
    engine.revisit()
    values = engine.solver.settle()
    system = LinearSystem(engine.solver.log.graph(), values)
    points = [point for point in engine.pipes.points.values() if point.known and values.exists(keys.base(0))]
    return {
        point.id: system.covariance(point_blocks(values, keys.base(0), keys.point(point.index))[1]) for point in points
    }


def summarise_decisions(rows: Sequence[dict[str, Any]]) -> tuple[Decisions, ...]:
    """Over the runs that decided. The interval is that of as many independent cuts as there are runs: too wide."""
    good = [row["decisions"] for row in rows if row.get("decisions")]
    return tuple(_summary(allowed, good) for allowed in ALLOWED) if good else ()


def decisions_text(found: Sequence[Decisions]) -> str:
    """The table in Markdown."""
    lines = [
        "| allowed | cuts | GO | ideal rule's GO | wrong of the GOs | 95 % interval | borderline | wrong of these |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for one in found:
        cells = (
            f"{100 * one.allowed:g} %",
            f"{one.cuts} in {one.runs} runs",
            f"{100 * one.go:.1f} %",
            f"{100 * one.ideal_go:.1f} %",
            f"{100 * one.wrong:.2f} %",
            f"{100 * one.wrong_lower:.2f} to {100 * one.wrong_upper:.2f} %",
            str(one.border),
            f"{100 * one.border_wrong:.2f} %",
        )
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def _summary(allowed: float, runs: Sequence[Sequence[dict[str, Any]]]) -> Decisions:
    cuts = [cut for run in runs for cut in run if cut["allowed"] == allowed]
    go = [cut for cut in cuts if cut["go"]]
    border = [cut for cut in go if 1.0 <= cut["factor"] <= BORDER]
    wrong = _share(go, "inside", False)
    trials = min(len(go), len(runs))
    lower, upper = clopper_pearson(wrong * trials, trials)
    return Decisions(
        allowed=allowed,
        cuts=len(cuts),
        runs=len(runs),
        go=_share(cuts, "go"),
        ideal_go=_share(cuts, "ideal"),
        wrong=wrong,
        wrong_lower=lower,
        wrong_upper=upper,
        border=len(border),
        border_wrong=_share(border, "inside", False),
    )


def _share(cuts: Sequence[dict[str, Any]], key: str, value: bool = True) -> float:
    return float(np.mean([cut[key] == value for cut in cuts])) if cuts else 0.0


def _cuts(name: str, covariance_m2: Float, axis_b: Float, rng: np.random.Generator) -> list[tuple[Cut, float]]:
    """Random cuts at a point, each with its size over the smallest one that the ideal rule permits."""
    found = []
    for allowed in ALLOWED:
        for _ in range(CUTS):
            shape = float(np.exp(rng.uniform(np.log(0.5), np.log(2.0))))
            tool_m = float(rng.uniform(0.0, 0.5 * np.sqrt(np.trace(covariance_m2) / 3.0)))
            factor = float(np.exp(rng.uniform(*np.log(SPREAD))))
            size_m = factor * _limit_m(name, allowed, shape, tool_m, covariance_m2, axis_b)
            found.append((_cut(name, allowed, shape, tool_m, size_m), factor))
    return found


def _limit_m(name: str, allowed: float, shape: float, tool_m: float, covariance_m2: Float, axis_b: Float) -> float:
    """The tolerance at which the ideal rule is just content, by bisection."""
    low, high = 1e-6, 100.0 * float(np.sqrt(np.trace(covariance_m2)) + tool_m)
    for _ in range(40):
        middle = float(np.sqrt(low * high))
        held = tolerance_probability(_cut(name, allowed, shape, tool_m, middle), covariance_m2, axis_b)
        low, high = (low, middle) if held >= 1.0 - allowed else (middle, high)
    return high


def _cut(name: str, allowed: float, shape: float, tool_m: float, size_m: float) -> Cut:
    return Cut(
        point=name,
        tolerance_along_m=size_m * shape,
        tolerance_across_m=size_m,
        tool_sigma_m=tool_m,
        wrong_go_probability=allowed,
    )


def _inside(cut: Cut, error_m: Float, axis_b: Float) -> bool:
    along = float(error_m @ axis_b)
    across = float(np.linalg.norm(error_m - along * axis_b))
    return abs(along) <= cut.tolerance_along_m and across <= cut.tolerance_across_m
