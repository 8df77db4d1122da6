"""The fiducial experiment in figures: a row per side length, method and distance; as JSON and as a page."""

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np

from .fiducial_experiment import METHODS, Depth, Method, Outcome, Setup

NORMAL_95 = 1.959963984540054
"""Half width of the interval that holds 95 % of a normal variable, in sigmas."""


@dataclass(frozen=True, slots=True)
class Row:
    """All markers and images at one distance by one method. Errors are measured less true."""

    typed_side_m: float
    method: Method
    distance_m: float
    count: int
    mean_m: float
    """Mean error of the depth."""
    spread_m: float
    """Largest less smallest error, as the paper gives its spread."""
    worst_m: float
    rotation_rad: float
    """Mean error of the orientation."""
    sigma_m: float | None
    """Mean of the stated sigmas; None where the method states none."""
    inside95: float | None
    """Share of the depths whose own 95 % interval holds the truth."""


def rows(depths: Sequence[Depth]) -> tuple[Row, ...]:
    """By side length as typed, method and distance, in this order."""
    groups: dict[tuple[float, int, float], list[Depth]] = {}
    for d in depths:
        groups.setdefault((-d.typed_side_m, METHODS.index(d.method), d.distance_m), []).append(d)
    return tuple(_row(group) for _, group in sorted(groups.items()))


def _row(group: list[Depth]) -> Row:
    errors = np.array([d.depth_m - d.true_m for d in group])
    sigmas = np.array([d.sigma_m for d in group if d.sigma_m is not None])
    inside = float(np.mean(np.abs(errors) < NORMAL_95 * sigmas)) if len(sigmas) else None
    first = group[0]
    return Row(
        first.typed_side_m,
        first.method,
        first.distance_m,
        len(group),
        float(errors.mean()),
        float(np.ptp(errors)),
        float(np.abs(errors).max()),
        float(np.mean([d.rotation_error_rad for d in group])),
        float(sigmas.mean()) if len(sigmas) else None,
        inside,
    )


def as_json(outcome: Outcome) -> str:
    """Setup, rows, single depths and events, in SI units."""
    content = {
        "setup": asdict(outcome.setup) | {"light": outcome.setup.light.model_dump()},
        "rows": [asdict(row) for row in rows(outcome.depths)],
        "depths": [asdict(depth) for depth in outcome.depths],
        "events": dict(Counter(event.kind for event in outcome.told)),
    }
    return json.dumps(content, indent=1) + "\n"


def rows_of_json(text: str) -> tuple[Row, ...]:
    """The rows that `as_json` wrote."""
    return tuple(Row(**row) for row in json.loads(text)["rows"])


HEADER = ("distance mm", *(f"{method}: {what}" for method in METHODS for what in ("mean / spread mm", "turned deg")))


def cells(table: Sequence[Row], typed_side_m: float) -> list[tuple[str, ...]]:
    """Rows of text, one per distance: mean error and spread in mm, and orientation error in degrees, by method."""
    mine = [row for row in table if row.typed_side_m == typed_side_m]
    found = {(row.distance_m, row.method): row for row in mine}
    lines = []
    for distance in sorted({row.distance_m for row in mine}):
        line = [f"{1e3 * distance:.0f}"]
        for method in METHODS:
            row = found.get((distance, method))
            line += ["none", ""] if row is None else _figures(row)
        lines.append(tuple(line))
    return lines


def _figures(row: Row) -> list[str]:
    return [f"{1e3 * row.mean_m:+.1f} / {1e3 * row.spread_m:.1f}", f"{np.degrees(row.rotation_rad):.2f}"]


def stated(table: Sequence[Row], typed_side_m: float) -> str:
    """What the joint estimate says about its own depth, in a sentence."""
    joint = [r for r in table if r.method == "joint" and r.typed_side_m == typed_side_m]
    joint = [r for r in joint if r.sigma_m is not None and r.inside95 is not None]
    if not joint:
        return "No joint estimate."
    near, far = min(joint, key=lambda r: r.distance_m), max(joint, key=lambda r: r.distance_m)
    inside = sum((r.inside95 or 0.0) * r.count for r in joint) / sum(r.count for r in joint)
    return (
        f"The joint depth states a sigma of {1e3 * (near.sigma_m or 0):.1f} mm at {1e3 * near.distance_m:.0f} mm and "
        f"{1e3 * (far.sigma_m or 0):.1f} mm at {1e3 * far.distance_m:.0f} mm; {100 * inside:.0f} % of the depths lie "
        "in their own 95 % interval."
    )


def told(outcome: Outcome) -> str:
    """Events by kind, in a sentence; of equal ones the first."""
    if not outcome.told:
        return "No event."
    kinds = Counter(event.kind for event in outcome.told)
    first = {event.kind: event.text for event in reversed(outcome.told)}
    return "; ".join(f"{count} x {kind} ({first[kind]})" for kind, count in kinds.items()) + "."


def as_section(setup: Setup, table: Sequence[Row], events: str) -> str:
    """The tables in Markdown, under a heading that names the focal length."""
    lines = [heading(setup), ""]
    for typed in setup.typed_sides_m:
        lines += [f"Side length given as {1e3 * typed:.0f} mm, printed with {1e3 * setup.side_m:.0f} mm:", ""]
        lines += ["| " + " | ".join(HEADER) + " |", "|---" * len(HEADER) + "|"]
        lines += ["| " + " | ".join(line) + " |" for line in cells(table, typed)]
        lines += ["", stated(table, typed), ""]
    return "\n".join([*lines, f"Events: {events}", ""])


def heading(setup: Setup) -> str:
    """Of a section on a page of results."""
    if setup.focal_error_rel == 0.0:
        return f"## Focal length right, sigma {100 * setup.focal_sigma_rel:g} %"
    long = "long" if setup.focal_error_rel > 0 else "short"
    return f"## Focal length {100 * abs(setup.focal_error_rel):g} % too {long}, sigma {100 * setup.focal_sigma_rel:g} %"


def with_section(page: str, section: str) -> str:
    """A page with a section (its first line is the heading) in the place of its predecessor, or at the end."""
    title = section.partition("\n")[0]
    before, found, rest = page.partition(title + "\n")
    after = rest[rest.index("\n## ") + 1 :] if found and "\n## " in rest else ""
    return "\n".join(part for part in (before.rstrip("\n") + "\n", section, after) if part)
