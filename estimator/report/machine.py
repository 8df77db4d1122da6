"""The report as data: verdicts, place, doubt and evidence. The same result gives the same bytes."""

import json
from typing import Any

import numpy as np

from ...factors.rig import Rig
from ..decision import Decision, decide
from ..result import PointEstimate, Result
from ..validated_range import ValidatedRange, quantities
from .axes import K3, half_axes, triad
from .essentials import NO_VERDICT, budget_closure, drawable

FORMAT = 1


def render_json(result: Result, rig: Rig, validated: ValidatedRange | None, sha256: str) -> str:
    """Canonical text, keys sorted, one line feed at the end. Run times stay out of it."""
    decisions = decide(result, rig, validated)
    planned = {decision.cut.point for decision in decisions}
    data = {
        "format": FORMAT,
        "surecut": result.provenance.get("surecut", ""),
        "result_sha256": sha256,
        "provenance": dict(result.provenance),
        "cuts": [_cut(decision) for decision in decisions],
        "points": [_point(point, result, point.id in planned) for point in result.points],
        "consistency": _consistency(result),
        "calibration_moved_sigma": {
            c.name: (c.value - c.prior) / c.prior_sigma
            for c in result.calibration
            if not c.frozen and c.prior_sigma > 0
        },
        "rejected": _rejected(result),
        "events": [{"stamp_ns": e.stamp_ns, "kind": e.kind, "severity": e.severity} for e in result.events],
        "last_board_view_ns": result.last_board_view_ns,
        "end_ns": result.end_ns,
        "validation": None if validated is None else validated.model_dump(mode="json"),
    }
    return json.dumps(_finite(data), sort_keys=True, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def _cut(decision: Decision) -> dict[str, Any]:
    return {
        "point": decision.cut.point,
        "plan": decision.cut.model_dump(mode="json"),
        "verdict": decision.verdict,
        "headline": decision.headline,
        "probability": decision.probability,
        "required": decision.required,
        "tool_only": decision.tool_only,
        "requirements": [
            {"name": r.name, "probability": r.probability, "possible": r.possible, "text": r.text}
            for r in decision.requirements
        ],
        "blockers": list(decision.blockers),
        "margin": decision.margin,
        "expires_ns": decision.expires_ns,
        "notes": list(decision.notes),
    }


def _point(point: PointEstimate, result: Result, planned: bool) -> dict[str, Any]:
    data: dict[str, Any] = {
        "id": point.id,
        "role": point.role,
        "frame": point.frame,
        "verdict": None if planned else NO_VERDICT,
        "position_m": point.position_m.tolist(),
        "covariance_m2": point.covariance_m2.tolist(),
        "radius95_m": point.radius95_m,
        "coverage_factor": K3,
        "measurements": point.measurements,
        "budget_m2": {name: part.tolist() for name, part in point.budget.items()},
        "conditions": quantities(result, point),
        "advice": [
            {"action": a.action, "detail": a.detail, "predicted_radius95_m": a.predicted_radius95_m, "gain": a.gain}
            for a in result.advice.get(point.id, ())
        ],
    }
    if drawable(point):
        directions = triad(point)
        data["directions"] = dict(zip(directions.names, directions.rows.tolist(), strict=True))
        data["half_axes_m"] = [axis.length_m for axis in half_axes(point, directions)]
        data["budget_closure"] = budget_closure(point) if point.budget else None
    return data


def _consistency(result: Result) -> dict[str, Any]:
    consistency = result.consistency
    families = {
        f.family: {"chi2": f.chi2, "dof": f.dof, "lower": f.lower, "upper": f.upper, "residuals": f.residuals}
        for f in consistency.by_family
    }
    return {
        "passed": consistency.passed,
        "reasons": list(consistency.reasons),
        "chi2": consistency.chi2,
        "dof": consistency.dof,
        "by_family": families,
        "paths_sigma": dict(consistency.paths),
    }


def _rejected(result: Result) -> list[dict[str, Any]]:
    counts: dict[tuple[str, str], int] = {}
    for r in result.rejected:
        counts[r.family, r.reason] = counts.get((r.family, r.reason), 0) + 1
    return [{"family": family, "reason": reason, "count": n} for (family, reason), n in sorted(counts.items())]


def _finite(value: Any) -> Any:
    """Numbers that JSON lacks become null."""
    if isinstance(value, dict):
        return {str(key): _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    if isinstance(value, float | np.floating):
        return float(value) if np.isfinite(value) else None
    return value
