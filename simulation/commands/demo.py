"""The whole chain in one go: render a recording, estimate, compare with the paper's method and the truth, report."""

from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, SpinnerColumn, TaskProgressColumn, TextColumn, TimeElapsedColumn
from rich.table import Table

from ...estimator.baseline import ChainPoint
from ...estimator.commands.compare import true_points
from ...estimator.compare import chain_of_messages
from ...estimator.items import wanted_topics
from ...estimator.optimise import optimise, rig_of
from ...estimator.output_files import write_text
from ...estimator.report.content import build_document
from ...estimator.report.html import render_html
from ...estimator.result import Result
from ...estimator.result_json import stored_sha256, to_json
from ...estimator.result_log import write_result
from ...estimator.tables import result_tables
from ...estimator.validated_range import load_validated_range
from ...factors.rig import load_rig
from ...io.reader import LogReader
from ..recording import simulate
from ..scenario import load_scenarios, override


def command(
    folder: Annotated[Path, typer.Option("--folder", help="Where recording and results go.")] = Path("logs"),
    seed: Annotated[int, typer.Option(help="Draws the cell, the rig's faults and the noise.", min=0)] = 1,
    duration: Annotated[float, typer.Option(help="Length of the recording, s.", min=5)] = 30.0,
    workers: Annotated[int, typer.Option(help="Processes that render.", min=1)] = 2,
    again: Annotated[bool, typer.Option("--again", help="Render the recording even where it is there.")] = False,
) -> None:
    """Render a recording of the robot cell, estimate the pipe points, and compare with the paper and the truth."""
    console = Console()
    folder.mkdir(parents=True, exist_ok=True)
    log = folder / "demo.mcap"
    columns = (
        SpinnerColumn(),
        TextColumn("{task.description}"),
        BarColumn(),
        TaskProgressColumn(),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=console) as bar:
        if again or not log.exists():
            task = bar.add_task("1 rendering the recording", total=1.0)
            scenario = override(load_scenarios("demo")[0], {"duration_s": duration})
            simulate(log, scenario, seed, lambda share: bar.update(task, completed=share), workers)
            bar.update(task, completed=1.0)
        task = bar.add_task("2 the joint estimate", total=duration)
        first: list[int] = []

        def advance(stamp_ns: int) -> None:
            first.append(stamp_ns) if not first else None
            bar.update(task, completed=(stamp_ns - first[0]) * 1e-9)

        result = optimise(log, progress=advance, command="surecut demo")
        bar.update(task, completed=duration)
        task = bar.add_task("3 the paper's chain", total=None)
        chain = _chain(log)
        bar.update(task, total=1.0, completed=1.0)
        task = bar.add_task("4 writing results and report", total=None)
        report = _write(folder, result)
        bar.update(task, total=1.0, completed=1.0)
    result_tables(result, console)
    console.print(comparison(result, chain, true_points(str(log))))
    console.print(f"Recording {log}, estimates {folder / 'demo.estimate.mcap'}, report {report}.", highlight=False)


def _chain(log: Path) -> tuple[ChainPoint, ...]:
    with LogReader(log) as reader:
        rig = rig_of(reader, None)
    return chain_of_messages(LogReader(log, wanted_topics(rig)), rig)


def _write(folder: Path, result: Result) -> Path:
    """Log of estimates, JSON and report."""
    write_result(folder / "demo.estimate.mcap", result)
    text = to_json(result)
    write_text(folder / "demo.json", text)
    rig = load_rig(result.config_yaml)
    document = build_document(result, rig, load_validated_range(None), stored_sha256(text), None)
    report = folder / "demo.report.html"
    write_text(report, render_html(document))
    return report


def comparison(result: Result, chain: tuple[ChainPoint, ...], truth: dict[str, np.ndarray]) -> Table:
    """Errors of both methods against the truth, which only this table reads."""
    table = Table(title="Against the truth of the simulated cell")
    for name in ("point", "method", "error mm", "95 % radius mm", "inside"):
        table.add_column(name, justify="left" if name in ("point", "method") else "right")
    for name, true in truth.items():
        for row in (c for c in chain if c.point_id == name and c.position_b_m is not None):
            error = float(np.linalg.norm(row.position_b_m - true))
            table.add_row(name, "paper's chain, one click", f"{1e3 * error:.1f}", "not stated", "")
        for found in (p for p in result.points if p.id == name):
            error = float(np.linalg.norm(found.position_m - true))
            inside = "yes" if error <= found.radius95_m else "no"
            table.add_row(name, "surecut", f"{1e3 * error:.1f}", f"{1e3 * found.radius95_m:.1f}", inside, style="bold")
    return table
