"""The pages behind the verdict: does the model agree with its data, what was refused, where the data come from."""

from collections import defaultdict
from collections.abc import Iterator

import numpy as np

from ..result import CalibrationEstimate, DistanceEstimate, FamilyConsistency, Result
from ..validated_range import QUANTITIES, ValidatedRange, quantities
from .blocks import Block, Drawing, Heading, Paragraph, Table
from .drawings import acceptance_intervals, residual_tenths, sigma_bars
from .text import duration, mm_with, significant, utc, with_sigma

REASONS_SHOWN = 40
MOVED_SHOWN = 8
TENTHS_LEAST = 40
"""Residuals of a family from which on a histogram says something."""
DOF_LEAST = 1e-6
"""A family with fewer degrees of freedom has nothing to be tested with."""


def evidence_pages(result: Result, validated: ValidatedRange | None) -> Iterator[Block]:
    """All of the evidence, most telling first."""
    yield Heading("Can it be believed?", 1, new_page=True)
    yield from _consistency(result)
    yield from _paths(result)
    yield from _validation(result, validated)
    yield from _events(result)
    yield from _distances(result)
    yield from _calibration(result)
    yield from _rejections(result)
    yield from _streaming(result)
    yield from _provenance(result)


def _consistency(result: Result) -> Iterator[Block]:
    consistency = result.consistency
    yield Heading("Does the model agree with its own data?")
    if consistency.passed:
        low = [f.family for f in consistency.by_family if f.dof > DOF_LEAST and f.chi2 / f.dof < f.lower]
        more = f" Less than stated, so stated with caution: {', '.join(low)}." if low else ""
        yield Paragraph(f"Yes. No family of measurements scatters more than its stated uncertainty allows.{more}")
    else:
        yield Paragraph("NO: " + "; ".join(consistency.reasons or ("the consistency check failed",)) + ".")
    if not consistency.by_family:
        return
    rows = tuple(
        (f.family, f"{f.chi2:.1f}", f"{f.dof:.1f}", _ratio(f.chi2, f.dof), _limits(f),
         str(f.residuals), str(f.downweighted))
        for f in consistency.by_family
    )  # fmt: skip
    total = ("all", f"{consistency.chi2:.1f}", f"{consistency.dof:.1f}", _ratio(consistency.chi2, consistency.dof))
    yield Table(
        caption="Chi-square by family, refused measurements left out, robust weights off.",
        header=("Family", "chi²", "degrees of freedom", "ratio", "limits of the ratio", "residuals", "softened"),
        rows=(*rows, (*total, "", "", "")),
        numeric=(1, 2, 3, 4, 5, 6),
        total=1,
        widths=(0.28, 0.12, 0.14, 0.09, 0.15, 0.11, 0.11),
    )
    yield Drawing(
        acceptance_intervals(consistency.by_family),
        "Ratio (diamond) and its limits (bar), logarithmic. Above: noisier than claimed. Below: better than claimed.",
    )
    drawn = [f for f in consistency.by_family if sum(f.tenths) >= TENTHS_LEAST]
    if drawn:
        yield Drawing(
            residual_tenths(drawn),
            "Residuals by tenths of the distribution that they ought to have, small ones left. The dashed line is the "
            "expected count; a pile at the right end means outliers or too small an uncertainty.",
        )


def _limits(family: FamilyConsistency) -> str:
    return f"{family.lower:.3g} to {family.upper:.3g}" if np.isfinite(family.upper) else ""


def _ratio(chi2: float, dof: float) -> str:
    return significant(chi2 / dof, 3) if dof > DOF_LEAST else "none"


def _paths(result: Result) -> Iterator[Block]:
    if not result.consistency.paths:
        return
    yield Heading("Do independent ways agree?")
    rows = sorted(result.consistency.paths.items(), key=lambda item: (-abs(item[1]), item[0]))
    yield Drawing(
        sigma_bars(rows, "Disagreement of independent ways"),
        "Disagreement in sigmas. Beyond 2 σ happens in one case of twenty by chance, beyond 3 σ it needs a reason.",
    )


def _validation(result: Result, validated: ValidatedRange | None) -> Iterator[Block]:
    yield Heading("Has the stated uncertainty been tested against truth?")
    if validated is None:
        yield Paragraph("NO. No validated range is installed, so no cut is permitted on this result.")
        return
    yield Paragraph(
        f"{validated.runs} runs with known truth ({validated.document}): the 95 % region held it in "
        f"{validated.coverage95 * 100:.1f} % of them; mean normalised squared error per degree of freedom "
        f"{validated.nees_per_dof:.2f}, ideal 1."
    )
    rows: list[tuple[str, ...]] = []
    for point in result.points:
        values = quantities(result, point)
        for name, (low, high) in sorted(validated.ranges.items()):
            inside = "inside" if low <= values[name] <= high else "OUTSIDE"
            row = (point.id, QUANTITIES[name], f"{values[name]:.4g}", f"{low:.4g} to {high:.4g}", inside)
            rows.append(row)
    if rows:
        yield Table(
            caption="This recording within the validated range. Lengths in m, times in s.",
            header=("Point", "Quantity", "here", "validated", ""),
            rows=tuple(rows),
            numeric=(2, 3),
            widths=(0.12, 0.46, 0.14, 0.16, 0.12),
        )


def _events(result: Result) -> Iterator[Block]:
    yield Heading("What happened on the way")
    last = result.last_board_view_ns
    if last is None:
        yield Paragraph("No board was seen.")
    else:
        yield Paragraph(f"Board last seen {duration((result.end_ns - last) * 1e-9)} before the end of the recording.")
    if not result.events:
        yield Paragraph("No event was recorded.")
        return
    order = {"error": 0, "warning": 1, "info": 2}
    events = sorted(result.events, key=lambda e: (order[e.severity], e.stamp_ns, e.kind, e.text))
    yield Table(
        caption="Events, gravest first.",
        header=("", "When", "What"),
        rows=tuple((e.severity.upper(), utc(e.stamp_ns), e.text) for e in events),
        widths=(0.12, 0.25, 0.63),
    )


def _distances(result: Result) -> Iterator[Block]:
    if not result.distances:
        return
    yield Heading("Distances")
    rows = tuple(_distance_row(distance) for distance in result.distances)
    yield Table(
        caption="Distances between marker points, with one standard uncertainty.",
        header=("Between", "estimated", "given", "difference"),
        rows=rows,
        numeric=(1, 2, 3),
    )


def _distance_row(distance: DistanceEstimate) -> tuple[str, ...]:
    estimated = mm_with(distance.distance_m, distance.sigma_m)
    if distance.given_m is None:
        return (distance.name, estimated, "not given", "")
    given_sigma = distance.given_sigma_m or 0.0
    given = mm_with(distance.given_m, given_sigma) if given_sigma else f"{distance.given_m * 1e3:.2f} mm"
    sigma = float(np.hypot(distance.sigma_m, given_sigma))
    apart = (distance.distance_m - distance.given_m) / sigma if sigma > 0 else float("nan")
    return (distance.name, estimated, given, f"{significant(apart)} σ")


def _calibration(result: Result) -> Iterator[Block]:
    if not result.calibration:
        return
    yield Heading("Calibration against what was known before")
    moved = [(c.name, _moved(c)) for c in result.calibration if not c.frozen and c.prior_sigma > 0]
    rows = tuple(
        (
            f"{c.name} [{c.unit}]",
            with_sigma(c.prior, c.prior_sigma),
            "held" if c.frozen else with_sigma(c.value, c.sigma),
            "" if c.frozen or c.prior_sigma <= 0 else f"{significant(_moved(c))} σ",
        )
        for c in result.calibration
    )
    yield Table(
        caption="Each calibration state with one standard uncertainty; moved in units of the prior's.",
        header=("State", "before", "estimated", "moved"),
        rows=rows,
        numeric=(1, 2, 3),
        widths=(0.4, 0.22, 0.22, 0.16),
    )
    if moved:
        furthest = sorted(moved, key=lambda row: (-abs(row[1]), row[0]))[:MOVED_SHOWN]
        bars = sigma_bars(furthest, "Calibration against its prior")
        yield Drawing(bars, "The states that moved furthest from their priors.")


def _moved(state: CalibrationEstimate) -> float:
    return (state.value - state.prior) / state.prior_sigma


def _rejections(result: Result) -> Iterator[Block]:
    yield Heading("What was refused")
    if not result.rejected:
        yield Paragraph("No measurement was refused.")
        return
    groups: dict[tuple[str, str], list[tuple[int, float, float, str]]] = defaultdict(list)
    for r in result.rejected:
        groups[r.family, r.reason].append((r.stamp_ns, r.value, r.limit, r.what))
    yield Paragraph(
        f"{len(result.rejected)} measurements did not enter the estimate. All are listed in the result file."
    )
    ordered = sorted(groups.items(), key=lambda item: (-len(item[1]), item[0]))
    rows: list[tuple[str, ...]] = []
    for (family, reason), members in ordered[:REASONS_SHOWN]:
        _, value, limit, what = max(members, key=lambda m: (abs(m[1] - m[2]), m[3]))
        rows.append((str(len(members)), family, reason, _worst(what, value, limit)))
    yield Table(
        caption="Refused measurements by reason; of each the one that missed its limit by most.",
        header=("Number", "Family", "Reason", "Worst"),
        rows=tuple(rows),
        numeric=(0,),
        widths=(0.09, 0.2, 0.35, 0.36),
    )


def _worst(what: str, value: float, limit: float) -> str:
    """The number that decided, where there is one; a limit of zero stands for none."""
    if not np.isfinite(value):
        return what
    return f"{what}: {value:.3g} against {limit:.3g}" if limit else f"{what}: {value:.3g}"


def _streaming(result: Result) -> Iterator[Block]:
    if not result.streaming_difference_sigma:
        return
    yield Heading("Live against offline")
    rows = sorted(result.streaming_difference_sigma.items(), key=lambda item: (-abs(item[1]), item[0]))
    yield Table(
        caption="Largest difference between the running estimate and the final one, in sigmas of the final one.",
        header=("Quantity", "difference"),
        rows=tuple((name, f"{significant(value)} σ") for name, value in rows),
        numeric=(1,),
    )


def _provenance(result: Result) -> Iterator[Block]:
    yield Heading("Where it comes from")
    rows = sorted(result.provenance.items())
    yield Table(
        caption="Versions, hashes and command.",
        header=("", ""),
        rows=(*rows, ("end of the recording", utc(result.end_ns))),
        widths=(0.25, 0.75),
    )
    if result.picks:
        yield Table(
            caption="The operator's picks: pixels as clicked, with the standard uncertainty of the click.",
            header=("Point", "Role", "Camera", "When", "pixel", "± px"),
            rows=tuple(
                (
                    p.point_id,
                    p.role,
                    p.camera,
                    utc(p.stamp_ns),
                    f"{p.pixel[0]:.1f}, {p.pixel[1]:.1f}",
                    f"{p.sigma_px:.2g}",
                )
                for p in sorted(result.picks, key=lambda p: (p.stamp_ns, p.point_id, p.camera))
            ),
            numeric=(4, 5),
            widths=(0.12, 0.12, 0.14, 0.34, 0.18, 0.1),
        )
