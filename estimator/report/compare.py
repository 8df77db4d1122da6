"""Two results side by side: two runs, two days, two operators. Differences in sigmas."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc

from ...factors.rig import Rig
from ..decision import Decision, decide, percent
from ..result import PointEstimate, Result
from ..validated_range import ValidatedRange
from .axes import triad
from .blocks import Block, Document, Drawing, Heading, Paragraph, Table
from .drawings import sigma_bars
from .essentials import NO_VERDICT, drawable
from .text import mm, mm_with, significant, utc, with_sigma


@dataclass(frozen=True, slots=True)
class Run:
    """One of the two."""

    name: str
    result: Result
    rig: Rig
    sha256: str


def build_comparison(a: Run, b: Run, validated: ValidatedRange | None) -> Document:
    """Verdicts, points, pipes, calibration and distances of two results, matched by name."""
    blocks = (
        Paragraph(f"A: {a.name}, recording up to {utc(a.result.end_ns)}. B: {b.name}, up to {utc(b.result.end_ns)}."),
        *_verdicts(a, b, validated),
        *_points(a.result, b.result),
        *_calibration(a.result, b.result),
        *_provenance(a, b),
    )
    return Document(
        title="Comparison of two results",
        subtitle=f"{a.name} and {b.name}",
        footer=f"A: result {a.sha256[:16]} · B: result {b.sha256[:16]}",
        blocks=blocks,
    )


def _verdicts(a: Run, b: Run, validated: ValidatedRange | None) -> Iterator[Block]:
    left = {d.cut.point: d for d in decide(a.result, a.rig, validated)}
    right = {d.cut.point: d for d in decide(b.result, b.rig, validated)}
    yield Heading("Verdicts")
    if not (left or right):
        yield Paragraph("Neither result has a cut plan: there is no permission to cut.")
        return
    names = list(dict.fromkeys([*left, *right]))
    yield Table(
        caption="Verdict and probability that all limits are kept.",
        header=("Point", "A", "", "B", ""),
        rows=tuple((name, *_verdict(left.get(name)), *_verdict(right.get(name))) for name in names),
        numeric=(2, 4),
        widths=(0.2, 0.25, 0.13, 0.29, 0.13),
    )


def _verdict(decision: Decision | None) -> tuple[str, str]:
    if decision is None:
        return (NO_VERDICT, "")
    return (decision.verdict, "" if decision.probability is None else percent(decision.probability))


def _points(a: Result, b: Result) -> Iterator[Block]:
    right = {point.id: point for point in b.points}
    pairs = [(point, right[point.id]) for point in a.points if point.id in right]
    yield Heading("Points")
    alone = sorted({p.id for p in a.points} ^ {p.id for p in b.points})
    if alone:
        yield Paragraph(f"In one of the two only: {', '.join(alone)}.")
    for first, second in pairs:
        yield from _pair(first, second)
    if pairs:
        yield Paragraph(
            "The two are taken as independent. What they share, such as one tape measure, moves both alike and makes "
            "them agree better than the figures say.",
            note=True,
        )


def _pair(a: PointEstimate, b: PointEstimate) -> Iterator[Block]:
    if a.frame != b.frame or not (drawable(a) and drawable(b)):
        yield Paragraph(f"{a.id} cannot be compared: not in one frame, or a covariance that is not usable.")
        return
    directions = triad(a)
    difference = directions.rows @ (b.position_m - a.position_m)
    covariance = directions.turned(a.covariance_m2 + b.covariance_m2)
    sigma = np.sqrt(np.diag(covariance))
    distance2 = mahalanobis2(a, b)
    chance = float(chdtrc(3, distance2))
    yield Table(
        caption=(
            f"{a.id}: B less A with one standard uncertainty. Together {significant(float(np.sqrt(distance2)))} σ in "
            f"three dimensions; by chance as much or more in {percent(chance)} of cases."
        ),
        header=("", *directions.names, "95 % within, A", "95 % within, B"),
        rows=(
            (
                "difference",
                *(mm_with(d, s) for d, s in zip(difference, sigma, strict=True)),
                mm(a.radius95_m),
                mm(b.radius95_m),
            ),
            ("in sigmas", *(f"{significant(d / s)} σ" for d, s in zip(difference, sigma, strict=True)), "", ""),
        ),
        numeric=(1, 2, 3, 4, 5),
    )


def mahalanobis2(a: PointEstimate, b: PointEstimate) -> float:
    """Squared distance of two independent estimates of one point; chi-square with 3 degrees of freedom."""
    difference = b.position_m - a.position_m
    return float(difference @ np.linalg.solve(a.covariance_m2 + b.covariance_m2, difference))


def _calibration(a: Result, b: Result) -> Iterator[Block]:
    right = {state.name: state for state in b.calibration}
    pairs = [(state, right[state.name]) for state in a.calibration if state.name in right]
    pairs = [(s, t) for s, t in pairs if not (s.frozen or t.frozen) and s.sigma > 0 and t.sigma > 0]
    if not pairs:
        return
    yield Heading("Calibration")
    apart = [(s.name, (t.value - s.value) / float(np.hypot(s.sigma, t.sigma))) for s, t in pairs]
    rows = tuple(
        (f"{s.name} [{s.unit}]", with_sigma(s.value, s.sigma), with_sigma(t.value, t.sigma), f"{significant(d)} σ")
        for (s, t), (_, d) in zip(pairs, apart, strict=True)
    )
    yield Table(
        caption="Estimated states with one standard uncertainty.",
        header=("State", "A", "B", "B less A"),
        rows=rows,
        numeric=(1, 2, 3),
        widths=(0.4, 0.22, 0.22, 0.16),
    )
    yield Drawing(sigma_bars(apart, "Calibration, B less A"), "B less A in sigmas.")


def _provenance(a: Run, b: Run) -> Iterator[Block]:
    yield Heading("Where they come from")
    keys = sorted({*a.result.provenance, *b.result.provenance})
    rows = ((k, a.result.provenance.get(k, ""), b.result.provenance.get(k, "")) for k in keys)
    yield Table(
        caption="Versions, hashes and commands.", header=("", "A", "B"), rows=tuple(rows), widths=(0.2, 0.4, 0.4)
    )
