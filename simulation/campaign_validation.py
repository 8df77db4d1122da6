"""The page of results (Markdown): one section per campaign, each replaced when its campaign is run again."""

from pathlib import Path

from .campaign import write_whole
from .campaign_decisions import decisions_text
from .campaign_report import label, quantity_text
from .campaign_table import CampaignTable, Compared

TITLE = "# Validation"
INTRODUCTION = """
Written by `surecut campaign ... --validation docs/validation.md`; do not edit by hand. Errors are truth less estimate.
NEES is the squared error in units of the stated covariance; over many runs NEES/dof is 1 when the covariance is true,
and stays in the interval given for it with 95 %. Coverage is how often a region of that content held the truth.
"""


DECISIONS = """
Cuts with random tolerances and tools, decided by the report's rule on the stored result. The ideal rule knows the true
covariance (same scene and faults, linearised at measurements without noise); tolerances are drawn from 0.7 to 1.4
times those at which it is just content. A GO is wrong when truth less estimate, with the tool's own error drawn, leaves
the tolerance; borderline are GOs up to 1.1 times that limit. Cuts of one run share its error: the interval is that of
as many cuts as runs.
"""


def update_validation(path: Path, name: str, level: str, content: CampaignTable | str, stamp: str) -> None:
    """Puts a section into the page, in the place of its predecessor or at the end."""
    heading = f"## {name}, {level}"
    body = content if isinstance(content, str) else validation_section(content)
    sections = _sections(path.read_text(encoding="utf-8")) if path.exists() else {}
    sections[heading] = f"{heading}\n{stamp}.\n\n{body.strip()}\n"
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, "\n".join([TITLE, INTRODUCTION.strip(), "", *sections.values()]))


def validation_section(table: CampaignTable) -> str:
    """A campaign's table in Markdown."""
    lines = [
        f"{table.runs} runs, {table.failed} without a result. The consistency check passed in "
        f"{100 * table.consistent:.1f} % ({100 * table.consistent_interval[0]:.1f} to "
        f"{100 * table.consistent_interval[1]:.1f}); points beyond their 99.9 % region in runs that passed: "
        f"{table.unflagged_beyond999}. {table.mean_seconds:.2f} s per estimate on one core.",
        "",
        "| quantity | mean | 95 % | worst | predicted rms | NEES/dof | accepted | in 50 / 90 / 95 / 99 % |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for summary in table.summaries:
        shares = " / ".join(f"{100 * coverage.share:.1f}" for coverage in summary.coverage)
        sizes = (summary.mean, summary.percentile95, summary.worst, summary.rms_sigma)
        cells = " | ".join(quantity_text(size, summary.unit) for size in sizes)
        accepted = f"{summary.nees_lower:.2f} to {summary.nees_upper:.2f}"
        lines.append(f"| {label(summary)} | {cells} | {summary.nees_per_dof:.2f} | {accepted} | {shares} |")
    if table.chain is not None:
        sizes = (table.chain.mean, table.chain.percentile95, table.chain.worst)
        cells = " | ".join(quantity_text(size, "m") for size in sizes)
        lines.append(f"| the paper's chain, {table.chain.count} clicks | {cells} | | | | |")
    if table.compared is not None:
        lines += ["", *compared_lines(table.compared)]
    families = ", ".join(f"{family} {value:.2f}" for family, value in table.chi2_per_dof.items())
    lines += ["", f"chi2/dof by family: {families}."]
    if table.streaming_sigma:
        stream = ", ".join(f"{name} {mean:.2f} ({worst:.2f})" for name, (mean, worst) in table.streaming_sigma.items())
        lines.append(f"Streaming replay against batch at the end, sigmas, mean (worst run): {stream}.")
    if table.sensitivity_m:
        moved = ", ".join(f"{name}: {quantity_text(m, 'm')}" for name, (m, _) in table.sensitivity_m.items())
        lines.append(f"Mean way that the points move for an input error: {moved}.")
    if table.left_out:
        left = ", ".join(
            f"{one.name} x {one.mean_error_ratio:.2f} (radius x {one.mean_radius_ratio:.2f}"
            + (f", {one.failed} of {one.runs} without a result)" if one.failed else ")")
            for one in table.left_out
        )
        lines.append(f"Mean error of the points without one family: {left}.")
    if table.decisions:
        lines += ["", DECISIONS.strip(), "", decisions_text(table.decisions), ""]
    if table.reasons:
        lines.append("Without a result: " + "; ".join(f"{count} x {text}" for text, count in table.reasons.items()))
    return "\n".join(lines)


def compared_lines(compared: Compared) -> list[str]:
    """A campaign beside another one with the same seeds."""
    one = compared
    return [
        f"| points of the {one.runs} runs that both have | mean error | in 95 % | NEES/dof |",
        "|---|---|---|---|",
        f"| here | {quantity_text(one.mean_m, 'm')} | {100 * one.coverage95:.1f} % | {one.nees_per_dof:.2f} |",
        f"| {one.name} | {quantity_text(one.other_mean_m, 'm')} | {100 * one.other_coverage95:.1f} % "
        f"| {one.other_nees_per_dof:.2f} |",
        f"| ratio | x {one.ratio:.2f} | | |",
    ]


def _sections(text: str) -> dict[str, str]:
    sections: dict[str, str] = {}
    heading = ""
    for line in text.splitlines():
        if line.startswith("## "):
            heading = line
            sections[heading] = ""
        if heading:
            sections[heading] += line + "\n"
    return {heading: text.rstrip() + "\n" for heading, text in sections.items()}
