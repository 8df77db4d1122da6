"""The report as a document, from the result, the decisions and the validated range."""

from ...factors.rig import Rig
from ..decision import Decision, decide, percent
from ..result import Result
from ..validated_range import ValidatedRange
from .blocks import Block, Document, Heading, Paragraph, Table
from .essentials import banner, detail_pages, point_pages
from .evidence import evidence_pages
from .glossary import TERMS
from .text import mm, utc

TITLE = "Uncertainty report for cut safety"


def build_document(
    result: Result, rig: Rig, validated: ValidatedRange | None, sha256: str, plan: str | None = None
) -> Document:
    """The whole report.

    Args:
        sha256: the result's own hash, printed on every page.
        plan: name of the rig file that the cut plan was taken from, where that is not the result's own.
    """
    decisions = decide(result, rig, validated)
    log = result.provenance.get("log_sha256", "")
    version = result.provenance.get("surecut", "")
    other_plan = (Paragraph(f"Cut plan from {plan}, not from the rig in the result."),) if plan else ()
    blocks = (
        *other_plan,
        *_opening(result, decisions),
        *_points(result, decisions),
        *evidence_pages(result, validated),
        *_glossary(),
    )
    return Document(
        title=TITLE,
        subtitle=f"Recording up to {utc(result.end_ns)}",
        footer=f"surecut {version} · result {sha256[:16]} · log {log[:16]}",
        blocks=blocks,
    )


def _glossary() -> tuple[Block, ...]:
    table = Table("In plain words.", ("word", "meaning"), TERMS, widths=(0.28, 0.72))
    return Heading("Words", 1, new_page=True), table


def _opening(result: Result, decisions: tuple[Decision, ...]) -> list[Block]:
    """What stands before the points: missing input, and a table where there are several cuts."""
    blocks: list[Block] = []
    if not decisions:
        blocks.append(
            Paragraph(
                "The rig file has no cut plan. This report states where the points are and how sure that is; it gives "
                "no permission to cut."
            )
        )
    known = {point.id for point in result.points}
    missing = [decision for decision in decisions if decision.cut.point not in known]
    for decision in missing:
        blocks += [Heading(f"Point {decision.cut.point}", 1), banner(decision.cut.point, decision, result)]
    if not result.points:
        blocks.append(Paragraph("The recording holds no pick, so there is no point to report on."))
    if len(decisions) > 1:
        blocks.insert(0, _summary(result, decisions))
    return blocks


def _summary(result: Result, decisions: tuple[Decision, ...]) -> Table:
    radii = {point.id: mm(point.radius95_m) for point in result.points}
    rows = tuple(
        (
            decision.cut.point,
            decision.verdict,
            "none" if decision.probability is None else percent(decision.probability),
            percent(decision.required),
            radii.get(decision.cut.point, "none"),
        )
        for decision in decisions
    )
    return Table(
        caption="All cuts of the plan.",
        header=("Point", "Verdict", "probability", "required", "95 % within"),
        rows=rows,
        numeric=(2, 3, 4),
    )


def _points(result: Result, decisions: tuple[Decision, ...]) -> list[Block]:
    """Points of the cut plan first, in its order, then the others."""
    by_id = {point.id: point for point in result.points}
    planned = [(by_id[d.cut.point], d) for d in decisions if d.cut.point in by_id]
    named = {point.id for point, _ in planned}
    entries = [*planned, *((point, None) for point in result.points if point.id not in named)]
    blocks: list[Block] = []
    for index, (point, decision) in enumerate(entries):
        blocks += point_pages(result, point, decision, first=index == 0)
    for index, (point, _) in enumerate(entries):
        blocks += detail_pages(result, point, first=index == 0)
    return blocks
