"""The pipe experiment in figures: cut points, cylinders, and what is left when a part of the truth is held."""

import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from scipy.stats import chi2

from .held import HOLDS
from .pipe_experiment import AS_IT_IS, CutPoint, Examined, FoundPipe

SEEN = {"stereo": "only stereo sees the pipe", "both": "both cameras see it", "neither": "clicks alone"}
POINT_HEADER = (
    "", "points", "mean mm", "95 % mm", "worst mm", "rms along / away / across mm", "stated", "NEES/dof",
    "by component", "in 95 %",
)  # fmt: skip
PIPE_HEADER = (
    "", "pipes", "axis mean / worst deg", "radius mean mm", "worst mm", "within 3 mm", "stated mm", "NEES", "two ways",
)  # fmt: skip
HELD_HEADER = ("", "points", "mean mm", "worst mm", "NEES/dof")


def as_json(found: Sequence[Examined]) -> str:
    """Everything, in SI units."""
    return json.dumps([asdict(one) for one in found], indent=1) + "\n"


def of_json(text: str) -> tuple[Examined, ...]:
    """What `as_json` wrote."""
    return tuple(
        Examined(
            one["recording"],
            tuple(CutPoint(**_tuples(point)) for point in one["points"]),
            None if one["pipe"] is None else FoundPipe(**one["pipe"]),
            one["reason"],
        )
        for one in json.loads(text)
    )


def _tuples(point: dict[str, Any]) -> dict[str, Any]:
    return {key: tuple(value) if isinstance(value, list) else value for key, value in point.items()}


def point_lines(found: Sequence[Examined]) -> list[tuple[str, ...]]:
    """A line for all recordings, and one for each way in which the pipe was seen."""
    points = [point for one in found for point in one.points if point.held == AS_IT_IS]
    groups = {"all": points} | {words: [p for p in points if p.seen_by == seen] for seen, words in SEEN.items()}
    return [_point_line(name, group) for name, group in groups.items() if group]


def _point_line(name: str, points: Sequence[CutPoint]) -> tuple[str, ...]:
    errors, stated = np.array([p.error_m for p in points]), np.array([p.sigma_m for p in points])
    size = np.linalg.norm(errors, axis=1)
    nees = np.array([p.nees for p in points])
    return (
        name,
        f"{len(points)}",
        f"{1e3 * size.mean():.1f}",
        f"{1e3 * np.quantile(size, 0.95):.1f}",
        f"{1e3 * size.max():.1f}",
        _three(1e3 * np.sqrt((errors**2).mean(axis=0)), 1),
        _three(1e3 * np.sqrt((stated**2).mean(axis=0)), 1),
        f"{nees.mean() / 3:.2f}",
        _three(((errors / stated) ** 2).mean(axis=0), 2),
        f"{100 * np.mean(nees < chi2.ppf(0.95, 3)):.0f} %",
    )


def _three(values: Iterable[float], digits: int) -> str:
    return " / ".join(f"{value:.{digits}f}" for value in values)


def pipe_lines(found: Sequence[Examined]) -> list[tuple[str, ...]]:
    """The same for cylinders."""
    pipes = [one.pipe for one in found if one.pipe is not None]
    groups = {"all": pipes} | {words: [p for p in pipes if p.seen_by == seen] for seen, words in SEEN.items()}
    return [_pipe_line(name, group) for name, group in groups.items() if group]


def _pipe_line(name: str, pipes: Sequence[FoundPipe]) -> tuple[str, ...]:
    axis = np.degrees([p.axis_rad for p in pipes])
    radius, sigma = np.array([p.radius_error_m for p in pipes]), np.array([p.radius_sigma_m for p in pipes])
    ways = [p.paths_sigma for p in pipes if p.paths_sigma is not None]
    return (
        name,
        f"{len(pipes)}",
        f"{axis.mean():.2f} / {axis.max():.2f}",
        f"{1e3 * radius.mean():+.1f}",
        f"{1e3 * radius[np.argmax(np.abs(radius))]:+.1f}",
        f"{int((np.abs(radius) < 3e-3).sum())} of {len(pipes)}",
        f"{1e3 * sigma.mean():.1f}",
        f"{np.mean((radius / sigma) ** 2):.2f}",
        f"{max(ways):.1f} sigma at most" if ways else "",
    )


def held_lines(found: Sequence[Examined]) -> list[tuple[str, ...]]:
    """Cut points as they are and with each part of the truth, over the recordings where all of this was solved."""
    points = [point for one in found for point in one.points]
    complete = {p.recording for p in points if p.held == list(HOLDS)[-1]}
    lines = []
    for held in (AS_IT_IS, *HOLDS):
        group = [p for p in points if p.held == held and p.recording in complete]
        if group:
            size = np.array([p.distance_m for p in group])
            nees = np.mean([p.nees for p in group]) / 3
            lines.append((held, f"{len(group)}", f"{1e3 * size.mean():.1f}", f"{1e3 * size.max():.1f}", f"{nees:.2f}"))
    return lines


def tables(found: Sequence[Examined]) -> list[tuple[str, tuple[str, ...], list[tuple[str, ...]]]]:
    """Title, header and lines of each table that has any."""
    all_of_them = [
        ("Cut points against the truth", POINT_HEADER, point_lines(found)),
        ("Pipes", PIPE_HEADER, pipe_lines(found)),
        ("Cut points when a part of the truth is held", HELD_HEADER, held_lines(found)),
    ]
    return [table for table in all_of_them if table[2]]


def as_section(found: Sequence[Examined], heading: str) -> str:
    """The tables in Markdown."""
    lines = [f"## {heading}", ""]
    for title, header, rows in tables(found):
        lines += [f"{title}:", "", "| " + " | ".join(header) + " |", "|---" * len(header) + "|"]
        lines += ["| " + " | ".join(row) + " |" for row in rows]
        lines.append("")
    lines += [f"{one.recording}: {one.reason}" for one in found if one.reason]
    return "\n".join(lines).rstrip("\n") + "\n"
