"""The paper's own method on a log, beside the estimate and, where the log has it, the truth."""

import json
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn
from rich.table import Table

from ...io.messages import PointsBody
from ...io.reader import LogReader
from ..baseline import ChainPoint
from ..compare import chain_of_messages
from ..items import wanted_topics
from ..optimise import rig_of
from ..output_files import write_text
from ..result import Result
from ..result_json import from_json

Float = NDArray[np.float64]
TRUTH = "/truth/points"


def command(
    log: Annotated[str, typer.Argument(help="An MCAP log or a rosbag2 folder.")],
    rig: Annotated[Path | None, typer.Option(help="Rig file; without it the one that the log carries.")] = None,
    result: Annotated[Path | None, typer.Option(help="JSON result of `surecut optimise` for the same log.")] = None,
    mean: Annotated[bool, typer.Option("--mean", help="Mean over the board's markers instead of one marker.")] = False,
    json_file: Annotated[Path | None, typer.Option("--json", help="Write the table as JSON.")] = None,
) -> None:
    """Run the paper's chain of single measurements on a log, for every click."""
    console = Console()
    with LogReader(log, ()) as reader:
        effective = rig_of(reader, rig)
    with (
        LogReader(log, wanted_topics(effective)) as reader,
        Progress(SpinnerColumn(), TextColumn("reading"), TimeElapsedColumn(), console=console, transient=True) as bar,
    ):
        bar.add_task("reading")
        points = chain_of_messages(reader, effective, "mean" if mean else "one_marker")
    truth = true_points(log)
    estimate = from_json(result.read_text(encoding="utf-8"), str(result)) if result is not None else None
    console.print(table_of(points, estimate, truth))
    if json_file is not None:
        write_text(json_file, json.dumps(as_json(points, estimate, truth), indent=1) + "\n")


def true_points(log: str) -> dict[str, Float]:
    """The last truth of each point in {b}, where a simulated log holds it. For the printed table only."""
    found: dict[str, Float] = {}
    with LogReader(log, (TRUTH,)) as reader:
        for message in reader:
            if isinstance(message.body, PointsBody):
                found |= dict(zip(message.body.ids, message.body.points_m, strict=True))
    return found


def table_of(points: tuple[ChainPoint, ...], estimate: Result | None, truth: dict[str, Float]) -> Table:
    """One row per click, then one per estimated point."""
    table = Table(box=None, pad_edge=False)
    for name in ("point", "method", "x mm", "y mm", "z mm", "95 % radius mm", "error mm"):
        table.add_column(name, justify="left" if name in ("point", "method") else "right")
    for point in points:
        if point.position_b_m is None:
            table.add_row(point.point_id, f"paper's chain: {point.reason}")
        else:
            table.add_row(point.point_id, "paper's chain", *_cells(point.position_b_m, truth.get(point.point_id)))
    for found in () if estimate is None else estimate.points:
        cells = _cells(found.position_m, truth.get(found.id), f"{1000 * found.radius95_m:.1f}")
        table.add_row(found.id, "surecut", *cells)
    for name, place in truth.items():
        table.add_row(name, "truth", *_cells(place, None))
    return table


def as_json(points: tuple[ChainPoint, ...], estimate: Result | None, truth: dict[str, Float]) -> dict[str, object]:
    """The same, machine-readable."""
    return {
        "chain": [
            {
                "id": point.point_id,
                "stamp_ns": point.stamp_ns,
                "position_m": None if point.position_b_m is None else point.position_b_m.tolist(),
                "error_m": _error(point.position_b_m, truth.get(point.point_id)),
                "reason": point.reason,
            }
            for point in points
        ],
        "estimate": [
            {
                "id": point.id,
                "position_m": point.position_m.tolist(),
                "radius95_m": point.radius95_m,
                "error_m": _error(point.position_m, truth.get(point.id)),
            }
            for point in (() if estimate is None else estimate.points)
        ],
        "truth": {name: place.tolist() for name, place in truth.items()},
    }


def _cells(position_m: Float, true_m: Float | None, radius: str = "") -> list[str]:
    error = _error(position_m, true_m)
    return [*(f"{1000 * value:.1f}" for value in position_m), radius, "" if error is None else f"{1000 * error:.1f}"]


def _error(position_m: Float | None, true_m: Float | None) -> float | None:
    if position_m is None or true_m is None:
        return None
    return float(np.linalg.norm(position_m - true_m))
