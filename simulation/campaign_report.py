"""One page of HTML over a campaign: tables, and plots as SVG. Nothing is loaded from elsewhere."""

import html
import math
from collections.abc import Mapping, Sequence

import numpy as np

from .campaign_row import Row, quantities_of
from .campaign_table import CampaignTable
from .evaluate_summary import Summary, clopper_pearson

WIDTH, HEIGHT = 460, 300
LEFT, RIGHT, TOP, BOTTOM = 56, 14, 28, 42
COLOURS = {"point": "#0b6e8a", "pose_b": "#b5521b", "pose_f": "#5a7d2a", "pose_m": "#7a4fa3", "calibration": "#666666"}
STYLE = """
body{font:15px/1.5 system-ui,sans-serif;margin:2rem auto;max-width:1060px;padding:0 1rem;color:#1d2327;background:#fff}
h1{font-size:1.5rem;margin:0}h2{font-size:1.1rem;margin:2rem 0 .5rem}p{max-width:75ch}
table{border-collapse:collapse;font-variant-numeric:tabular-nums;font-size:13px}
th,td{padding:.25rem .6rem;text-align:right;border-bottom:1px solid #dde2e6}
th:first-child,td:first-child{text-align:left}
th{font-weight:600}.bad{color:#a3240f;font-weight:600}.plots{display:flex;flex-wrap:wrap;gap:1rem}
svg{font:12px system-ui,sans-serif}.scroll{overflow-x:auto}
"""


def report_html(title: str, table: CampaignTable, rows: Sequence[Row], notes: Sequence[str] = ()) -> str:
    """The page.

    Args:
        title: heading.
        table: the campaign's table.
        rows: the runs.
        notes: lines under the heading, such as date and commit.
    """
    good = [row for row in rows if row["status"] == "done"]
    parts = [
        f"<!doctype html><html lang=en><meta charset=utf-8><title>{html.escape(title)}</title><style>{STYLE}</style>",
        f"<h1>{html.escape(title)}</h1>",
        *(f"<p>{html.escape(note)}</p>" for note in notes),
        f"<p>{table.runs} runs, {table.failed} without a result. The consistency check passed in "
        f"{100 * table.consistent:.1f} % of the runs ({100 * table.consistent_interval[0]:.1f} to "
        f"{100 * table.consistent_interval[1]:.1f} %). Points beyond their own 99.9 % region in runs that passed: "
        f"{table.unflagged_beyond999}.</p>",
        '<div class="plots">',
        calibration_plot(good),
        error_plot(good),
        nees_plot(table.summaries),
        "</div><h2>Errors and their predicted size</h2>",
        f'<div class="scroll">{summary_table(table)}</div>',
        _families(table),
        _decisions(table),
        _pairs("Streaming replay against batch, sigmas", table.streaming_sigma, 1.0),
        _pairs("Way of the points for an input error, mm", table.sensitivity_m, 1e3),
        _reasons(table),
    ]
    return "\n".join(parts) + "</html>\n"


def summary_table(table: CampaignTable) -> str:
    """The summaries as an HTML table; what lies outside its acceptance interval is marked."""
    head = "quantity|runs|mean|median|95 %|worst|predicted rms|NEES/dof|accepted|50 %|90 %|95 %|99 %".split("|")
    lines = ["<table><tr>" + "".join(f"<th>{one}</th>" for one in head) + "</tr>"]
    for summary in table.summaries:
        sizes = (summary.mean, summary.median, summary.percentile95, summary.worst, summary.rms_sigma)
        inside = summary.nees_lower <= summary.nees_per_dof <= summary.nees_upper
        cells = [
            f"<td>{html.escape(label(summary))}</td><td>{summary.runs}</td>",
            *(f"<td>{quantity_text(size, summary.unit)}</td>" for size in sizes),
            f"<td{'' if inside else ' class=bad'}>{summary.nees_per_dof:.2f}</td>",
            f"<td>{summary.nees_lower:.2f} to {summary.nees_upper:.2f}</td>",
            *(f"<td{'' if one.accepted else ' class=bad'}>{100 * one.share:.1f} %</td>" for one in summary.coverage),
        ]
        lines.append(f"<tr>{''.join(cells)}</tr>")
    if table.chain is not None:
        chain = table.chain
        sizes = (chain.mean, chain.median, chain.percentile95, chain.worst)
        cells = "".join(f"<td>{quantity_text(size, 'm')}</td>" for size in sizes)
        lines.append(f"<tr><td>the paper's chain, every click</td><td>{chain.count}</td>{cells}</tr>")
    return "".join(lines) + "</table>"


def label(summary: Summary) -> str:
    """A summary's name for people."""
    words = {"point": "pipe point", "pose_b": "pose", "pose_f": "pose of board", "pose_m": "last pose", "pipe": ""}
    kind = words.get(summary.group, summary.group)
    return f"{kind} {summary.name}".strip()


def quantity_text(value: float, unit: str) -> str:
    """A number with its unit, metres as millimetres."""
    if not math.isfinite(value):
        return "-"
    return f"{1000 * value:.1f} mm" if unit == "m" else f"{value:.4g} {unit}".strip()


def calibration_plot(rows: Sequence[Row]) -> str:
    """How often a region held the truth, against its probability content; the band is what chance allows."""
    axes = _Axes("Coverage of the stated regions", "probability content", "share of runs", (0, 1), (0, 1))
    levels = np.linspace(0.02, 0.98, 49)
    bands = [clopper_pearson(level * len(rows), len(rows)) if rows else (0.0, 1.0) for level in levels]
    band = [*zip(levels, [b[0] for b in bands], strict=True)]
    band += [*zip(levels[::-1], [b[1] for b in bands[::-1]], strict=True)]
    parts = [axes.area(band, "#e8edf0"), axes.line([(0, 0), (1, 1)], "#9aa4ab")]
    for group, colour in COLOURS.items():
        values = [q.probability for row in rows for q in quantities_of(row) if q.group == group]
        values = np.sort([value for value in values if math.isfinite(value)])
        if len(values):
            share = np.arange(1, len(values) + 1) / len(values)
            keep = np.unique(np.linspace(0, len(values) - 1, 120).astype(int))
            parts.append(axes.line([(0, 0), *zip(values[keep], share[keep], strict=True)], colour, 1.6))
            parts.append(axes.key(group.replace("_", " "), colour))
    return axes.svg(parts)


def error_plot(rows: Sequence[Row]) -> str:
    """Histogram of the points' errors, and of the paper's chain, on a common logarithmic axis."""
    mine = [1000 * q.error for row in rows for q in quantities_of(row) if q.group == "point"]
    chain = [1000 * error for row in rows for error in row["chain"]]
    everything = [value for value in (*mine, *chain) if value > 0]
    if not everything:
        return ""
    low, high = math.log10(max(0.1, min(everything))), math.log10(max(everything)) + 0.05
    edges = np.linspace(low, high, 41)
    axes = _Axes("Error of the pipe points in {b}", "mm", "share", (low, high), (0, 0.25), logarithmic=True)
    parts = []
    for values, colour, name in ((chain, "#c9a227", "paper's chain"), (mine, COLOURS["point"], "surecut")):
        if values:
            counts, _ = np.histogram(np.log10(np.maximum(values, 0.1)), edges)
            parts += axes.bars(edges, np.minimum(counts / len(values), 0.25), colour)
            parts.append(axes.key(f"{name}: mean {np.mean(values):.1f}, worst {max(values):.0f} mm", colour))
    return axes.svg(parts)


def nees_plot(summaries: Sequence[Summary]) -> str:
    """NEES / dof of every quantity with its acceptance interval, on a logarithmic axis."""
    shown = [s for s in summaries if math.isfinite(s.nees_per_dof) and s.nees_per_dof > 0][:24]
    if not shown:
        return ""
    row_height, top, left = 17, 34, 170
    height = top + row_height * len(shown) + 34

    def x(value: float) -> float:
        share = (math.log2(min(max(value, 0.125), 8.0)) + 3) / 6
        return left + share * (WIDTH - left - RIGHT)

    parts = ['<text x="8" y="18" font-weight="600">NEES / dof with its 95 % acceptance interval</text>']
    for tick in (0.125, 0.25, 0.5, 1, 2, 4, 8):
        parts.append(f'<line x1="{x(tick):.1f}" x2="{x(tick):.1f}" y1="{top}" y2="{height - 30}" stroke="#e3e7ea"/>')
        parts.append(f'<text x="{x(tick):.1f}" y="{height - 14}" text-anchor="middle" fill="#555">{tick:g}</text>')
    for index, summary in enumerate(shown):
        y = top + row_height * index + 9
        inside = summary.nees_lower <= summary.nees_per_dof <= summary.nees_upper
        parts.append(f'<text x="{left - 8}" y="{y + 4}" text-anchor="end">{html.escape(label(summary))}</text>')
        parts.append(
            f'<line x1="{x(summary.nees_lower):.1f}" x2="{x(summary.nees_upper):.1f}" y1="{y}" y2="{y}" '
            'stroke="#b9c3c9" stroke-width="7"/>'
        )
        colour = "#0b6e8a" if inside else "#a3240f"
        parts.append(f'<circle cx="{x(summary.nees_per_dof):.1f}" cy="{y}" r="3.6" fill="{colour}"/>')
    body = "".join(parts)
    return f'<svg width="{WIDTH}" height="{height}" viewBox="0 0 {WIDTH} {height}" role="img">{body}</svg>'


def _families(table: CampaignTable) -> str:
    lines = ["<h2>Families</h2><table><tr><th>family</th><th>chi2 / dof</th><th>rejected per run</th></tr>"]
    for family in dict.fromkeys((*table.chi2_per_dof, *table.rejected_per_run)):
        chi2_text = f"{table.chi2_per_dof[family]:.3f}" if family in table.chi2_per_dof else "-"
        rejected = table.rejected_per_run.get(family, 0.0)
        lines.append(f"<tr><td>{html.escape(family)}</td><td>{chi2_text}</td><td>{rejected:.1f}</td></tr>")
    text = "".join(lines) + "</table>"
    if table.left_out:
        text += "<h2>Without one family</h2><table><tr><th>left out</th><th>runs</th><th>failed</th>"
        text += "<th>mean error</th><th>mean 95 % radius</th></tr>"
        text += "".join(
            f"<tr><td>{html.escape(one.name)}</td><td>{one.runs}</td><td>{one.failed}</td>"
            f"<td>x {one.mean_error_ratio:.2f}</td><td>x {one.mean_radius_ratio:.2f}</td></tr>"
            for one in table.left_out
        )
        text += "</table>"
    return text


def _decisions(table: CampaignTable) -> str:
    if not table.decisions:
        return ""
    head = "allowed|cuts|GO|ideal rule's GO|wrong of the GOs|borderline|wrong of these".split("|")
    lines = ["<h2>Decisions</h2><table><tr>" + "".join(f"<th>{one}</th>" for one in head) + "</tr>"]
    for one in table.decisions:
        cells = [f"{100 * one.allowed:g} %", str(one.cuts), f"{100 * one.go:.1f} %", f"{100 * one.ideal_go:.1f} %"]
        interval = f"{100 * one.wrong_lower:.1f} to {100 * one.wrong_upper:.1f}"
        cells += [f"{100 * one.wrong:.2f} % ({interval})", str(one.border), f"{100 * one.border_wrong:.2f} %"]
        lines.append("<tr>" + "".join(f"<td>{cell}</td>" for cell in cells) + "</tr>")
    return "".join(lines) + "</table>"


def _pairs(heading: str, values: Mapping[str, tuple[float, float]], factor: float) -> str:
    """Mean and worst by name."""
    if not values:
        return ""
    lines = [f"<h2>{heading}</h2><table><tr><th></th><th>mean</th><th>worst</th></tr>"]
    for name, (mean, worst) in values.items():
        lines.append(f"<tr><td>{html.escape(name)}</td><td>{factor * mean:.3g}</td><td>{factor * worst:.3g}</td></tr>")
    return "".join(lines) + "</table>"


def _reasons(table: CampaignTable) -> str:
    lists = (
        ("Runs without a result", table.reasons),
        ("Why the consistency check refused", table.inconsistency_reasons),
        ("Events, in runs", table.events),
    )
    return "".join(
        f"<h2>{heading}</h2><table>"
        + "".join(f"<tr><td>{html.escape(reason)}</td><td>{count}</td></tr>" for reason, count in counts.items())
        + "</table>"
        for heading, counts in lists
        if counts
    )


class _Axes:
    """A frame with scales; draws in data coordinates."""

    def __init__(
        self,
        title: str,
        x_name: str,
        y_name: str,
        x_range: tuple[float, float],
        y_range: tuple[float, float],
        logarithmic: bool = False,
    ) -> None:
        self._title, self._names = title, (x_name, y_name)
        self._x, self._y, self._logarithmic = x_range, y_range, logarithmic
        self._keys = 0

    def at(self, x: float, y: float) -> tuple[float, float]:
        """Pixels of a point."""
        u = LEFT + (x - self._x[0]) / (self._x[1] - self._x[0]) * (WIDTH - LEFT - RIGHT)
        v = HEIGHT - BOTTOM - (y - self._y[0]) / (self._y[1] - self._y[0]) * (HEIGHT - TOP - BOTTOM)
        return u, v

    def line(self, points: Sequence[tuple[float, float]], colour: str, width: float = 1.0) -> str:
        """A polyline."""
        return f'<polyline points="{self._path(points)}" fill="none" stroke="{colour}" stroke-width="{width}"/>'

    def area(self, points: Sequence[tuple[float, float]], colour: str) -> str:
        """A filled polygon."""
        return f'<polygon points="{self._path(points)}" fill="{colour}"/>'

    def bars(self, edges: np.ndarray, heights: np.ndarray, colour: str) -> list[str]:
        """A histogram."""
        bars = []
        for low, high, value in zip(edges[:-1], edges[1:], heights, strict=True):
            (u0, v0), (u1, v1) = self.at(float(low), 0.0), self.at(float(high), float(value))
            bars.append(
                f'<rect x="{u0:.1f}" y="{v1:.1f}" width="{max(u1 - u0 - 0.6, 0.5):.1f}" height="{v0 - v1:.1f}" '
                f'fill="{colour}" fill-opacity="0.65"/>'
            )
        return bars

    def key(self, text: str, colour: str) -> str:
        """A line of the legend."""
        y = TOP + 12 + 15 * self._keys
        self._keys += 1
        return (
            f'<rect x="{LEFT + 8}" y="{y - 8}" width="10" height="10" fill="{colour}"/>'
            f'<text x="{LEFT + 23}" y="{y + 1}">{html.escape(text)}</text>'
        )

    def svg(self, parts: Sequence[str]) -> str:
        """The plot."""
        ticks = []
        for value in self._ticks():
            u, v = self.at(value, self._y[0])
            text = f"{10**value:g}" if self._logarithmic else f"{value:g}"
            ticks.append(f'<text x="{u:.1f}" y="{v + 16:.1f}" text-anchor="middle" fill="#555">{text}</text>')
        for value in np.linspace(*self._y, 6):
            u, v = self.at(self._x[0], float(value))
            ticks.append(f'<text x="{u - 6:.1f}" y="{v + 4:.1f}" text-anchor="end" fill="#555">{value:.2g}</text>')
        (u0, v0), (u1, v1) = self.at(self._x[0], self._y[0]), self.at(self._x[1], self._y[1])
        frame = f'<rect x="{u0}" y="{v1}" width="{u1 - u0}" height="{v0 - v1}" fill="none" stroke="#b9c3c9"/>'
        titles = (
            f'<text x="{LEFT}" y="18" font-weight="600">{html.escape(self._title)}</text>'
            f'<text x="{(u0 + u1) / 2}" y="{HEIGHT - 8}" text-anchor="middle" fill="#555">{self._names[0]}</text>'
        )
        return (
            f'<svg width="{WIDTH}" height="{HEIGHT}" viewBox="0 0 {WIDTH} {HEIGHT}" role="img">'
            + "".join([*parts, frame, *ticks, titles])
            + "</svg>"
        )

    def _ticks(self) -> list[float]:
        if not self._logarithmic:
            return [float(value) for value in np.linspace(*self._x, 6)]
        return [float(value) for value in range(math.ceil(self._x[0]), math.floor(self._x[1]) + 1)]

    def _path(self, points: Sequence[tuple[float, float]]) -> str:
        return " ".join(f"{u:.1f},{v:.1f}" for u, v in (self.at(float(x), float(y)) for x, y in points))
