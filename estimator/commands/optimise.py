"""Estimate pipe points in {b}, poses and calibration from recorded logs, jointly and with covariances."""

import shlex
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from ...factors.errors import SurecutError
from ...io.reader import LogReader
from ..freed_memory import keep_freed_memory
from ..optimise import optimise

if TYPE_CHECKING:
    from ..executor import Outcome
    from ..result import Result

HELP_EPILOG = """Examples:

  surecut optimise logs/demo.mcap -o logs/demo.estimate.mcap

  surecut optimise run.mcap --rig cell.yaml --json run.json --tum run.tum

  surecut optimise aviary.mcap --rig aviary.yaml --between 29/0 60/0

  surecut optimise day/*.mcap -o results/ --jobs 8 --resume
"""

PROCESSES = 2
"""One log alone: front ends and graph beside each other. Several logs share the cores by `--jobs` instead."""


@dataclass(frozen=True, slots=True)
class Job:
    """One log and where its results go."""

    log: Path
    output: Path | None
    rig: Path | None
    json: Path | None
    tum: Path | None
    between: tuple[tuple[str, str], ...]
    frame: Literal["o", "world"]
    """Of the trajectory in TUM format."""
    command: str = ""
    """As the user typed it."""


def command(
    logs: Annotated[list[Path], typer.Argument(help="MCAP recordings (files, or rosbag2 folders).")],
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="Log of estimates (MCAP); a folder for several logs.")
    ] = None,
    rig: Annotated[Path | None, typer.Option("--rig", help="Rig file; overrides the one in the log.")] = None,
    json: Annotated[
        Path | None, typer.Option("--json", help="Machine-readable result; a folder for several logs.")
    ] = None,
    tum: Annotated[Path | None, typer.Option("--tum", help="Trajectory of {m}, TUM format.")] = None,
    frame: Annotated[
        Literal["o", "world"], typer.Option("--frame", help="Frame of --tum; `world` is that of the rig's world_board.")
    ] = "o",
    between: Annotated[
        list[str] | None,
        typer.Option("--between", help="Distance between two marker points, such as '29/0 60/0' or '3 7'."),
    ] = None,
    jobs: Annotated[int, typer.Option("--jobs", min=1, help="Logs worked on at the same time.")] = 1,
    dask: Annotated[str | None, typer.Option("--dask", help="Address of a Dask scheduler, tcp://...")] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Skip logs whose result is there already.")] = False,
) -> None:
    """Estimate pipe points in {b}, poses and calibration from recorded logs, jointly and with covariances."""
    pairs = tuple(_pair(text) for text in between or ())
    several = len(logs) > 1
    if several and tum is not None and not tum.is_dir():
        raise typer.BadParameter("--tum must be an existing folder for several logs")
    work = [_job(log, output, rig, json, tum, pairs, frame, several) for log in logs]
    for job in work:
        if job.output is not None and job.output.resolve() == job.log.resolve():
            raise SurecutError(f"{job.log}: would be overwritten by its own result; give another -o")
    if resume:
        work = [job for job in work if not _done(job)]
    if not several:
        keep_freed_memory()
        for job in work:
            result = _with_progress(job)
            _print(result)
        return
    _many(work, jobs, dask)


def _pair(text: str) -> tuple[str, str]:
    parts = text.replace(",", " ").split()
    if len(parts) != 2:
        raise typer.BadParameter(f"--between takes two marker points, such as '29/0 60/0'; got {text!r}")
    return parts[0], parts[1]


def _job(
    log: Path, output: Path | None, rig: Path | None, json: Path | None, tum: Path | None,
    between: tuple[tuple[str, str], ...], frame: Literal["o", "world"], several: bool,
) -> Job:  # fmt: skip
    def place(target: Path | None, suffix: str) -> Path | None:
        if target is None:
            return None
        return target / f"{log.stem}{suffix}" if several or target.is_dir() else target

    typed = shlex.join(["surecut", *sys.argv[1:]])
    places = (place(output, ".estimate.mcap"), rig, place(json, ".json"), place(tum, ".tum"))
    return Job(log, *places, between, frame, typed)


def _done(job: Job) -> bool:
    """A result counts as done when it is there, whole, and of this very log."""
    if job.output is None or not job.output.exists():
        return False
    from ..result_json import from_json

    try:
        text = LogReader(job.output).attachment("result.json")
        if text is None:
            return False
        with LogReader(job.log) as reader:
            return from_json(text).provenance.get("log_sha256") == reader.sha256()
    except SurecutError:
        return False


def run_job(job: Job) -> str:
    """One log; returns one line. Top level, so that processes and clusters can take it."""
    result = optimise(job.log, job.rig, job.between, command=job.command)
    _write(job, result)
    radius = max((p.radius95_m for p in result.points), default=float("nan"))
    state = "consistent" if result.consistency.passed else "INCONSISTENT"
    return f"{len(result.points)} points, largest 95 % radius {1e3 * radius:.1f} mm, {state}"


def _print(result: "Result") -> None:
    from rich.console import Console

    from ..tables import result_tables

    result_tables(result, Console())


def _write(job: Job, result: "Result", apart: bool = False) -> None:
    """
    Args:
        apart: a copy of the process makes the text, which takes as long as the messages, where a second core is free.
    """
    from ..aside import Aside  # with libraries that need not be there before the front ends start
    from ..output_files import write_text
    from ..result_json import to_json
    from ..result_log import tum_text, write_result

    for path in (job.output, job.json, job.tum):
        if path is not None:
            path.parent.mkdir(parents=True, exist_ok=True)
    made: Aside[str] = Aside(apart, niceness=0)
    text = cache(made.awaited)
    try:
        if job.output is not None or job.json is not None:
            made.begin(lambda: to_json(result))
        if job.output is not None:
            write_result(job.output, result, text)
        if job.json is not None:
            write_text(job.json, text())
    finally:
        made.stop()
    if job.tum is not None:
        write_text(job.tum, tum_text(result, job.frame))


def _with_progress(job: Job) -> "Result":
    """One log with a bar over its time, where somebody can see it."""
    if sys.stderr.isatty():
        result = _with_bar(job)
    else:
        result = optimise(job.log, job.rig, job.between, lambda _: _load(), job.command, processes=PROCESSES)
    _write(job, result, apart=True)
    return result


@cache
def _load() -> None:
    """What writes results takes a fifth of a second to load: at the first stamp the graph waits for the front ends."""
    from rich import console, table  # noqa: F401

    from ...io.schemas import typestore
    from .. import result_json, result_log, tables  # noqa: F401

    typestore()


def _with_bar(job: Job) -> "Result":
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    console = Console(stderr=True)
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.percentage:>3.0f} %"),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    start, length = _time_range(job.log)
    bar = Progress(*columns, console=console, transient=True, disable=not console.is_terminal)
    task = bar.add_task(job.log.name, total=length)

    def advance(stamp_ns: int) -> None:
        _load()
        bar.start()  # the bar has a thread, without which the front ends can be copies of this process
        bar.update(task, completed=min((stamp_ns - start) * 1e-9, length or float("inf")))

    try:
        return optimise(job.log, job.rig, job.between, advance, job.command, processes=PROCESSES)
    finally:
        bar.stop()


def _time_range(log: Path) -> tuple[int, float | None]:
    """Start (ns) and length (s) of a log from its summary, where it has one."""
    from ...io.summary_times import time_range

    found = time_range(log)
    return (0, None) if found is None else (found[0], max((found[1] - found[0]) * 1e-9, 1e-3))


def _many(work: Sequence[Job], jobs: int, dask: str | None) -> None:
    """Many logs; a failing one is a row with its reason and does not stop the others."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
    from rich.table import Table

    from ..executor import choose_executor

    console = Console()
    table = Table("log", "result")
    failed = 0
    columns = (
        TextColumn("{task.completed:.0f} of {task.total:.0f} logs"),
        BarColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    screen = Console(stderr=True)
    with Progress(*columns, console=screen, transient=True, disable=not screen.is_terminal) as bar:
        task = bar.add_task("logs", total=len(work))
        outcomes: list[Outcome[Job, str]] = []
        for outcome in choose_executor(jobs, dask).run(run_job, work):
            outcomes.append(outcome)
            bar.advance(task)
    for outcome in sorted(outcomes, key=lambda o: str(o.item.log)):
        failed += outcome.error is not None
        table.add_row(str(outcome.item.log), outcome.value or f"[red]failed[/red]: {outcome.error}")
    console.print(table)
    if failed:
        raise SurecutError(f"{failed} of {len(work)} logs failed; the table names the reasons")
