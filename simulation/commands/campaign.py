"""Simulate, estimate and evaluate many times: are the stated uncertainties true?"""

import subprocess
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Literal

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

from ...estimator.executor import Executor, choose_executor
from ...estimator.validated_range import range_text
from ...factors.errors import SurecutError
from ..campaign import open_campaign, read_rows, run_campaign, write_whole
from ..campaign_range import validated_range
from ..campaign_real import real_table, real_tasks, real_text
from ..campaign_report import label, quantity_text, report_html
from ..campaign_row import Row
from ..campaign_table import CampaignTable, tabulate, write_tables
from ..campaign_validation import update_validation


def command(
    output: Annotated[
        Path, typer.Option("-o", "--output", help="Folder of the runs and tables; resumed if it is one.")
    ],
    runs: Annotated[int, typer.Option(min=1, help="Number of runs; run i has seed i.")] = 50,
    scenario: Annotated[
        str,
        typer.Option(
            help="Scenario file (YAML), or the name of one; with `--level pixels` also a folder of recordings."
        ),
    ] = "cell",
    level: Annotated[
        Literal["measurements", "pixels"],
        typer.Option(help="Draw the measurements, or render images."),
    ] = "measurements",
    jobs: Annotated[int, typer.Option(min=1, help="Processes on this machine.")] = 1,
    dask: Annotated[str | None, typer.Option(help="Address of a Dask scheduler, such as tcp://host:8786.")] = None,
    leave_out: Annotated[
        bool, typer.Option("--leave-out", help="Estimate again without each family of measurements.")
    ] = False,
    decisions: Annotated[
        bool, typer.Option("--decisions", help="Decide random cuts in every run: wrong GOs, and power.")
    ] = False,
    sensitivity: Annotated[
        bool, typer.Option("--sensitivity", help="Change one input after the other: how far do the points move?")
    ] = False,
    recordings: Annotated[
        Path | None, typer.Option(help="Folder that keeps what `--level pixels` renders; what is there is used again.")
    ] = None,
    mounts_anew: Annotated[
        bool,
        typer.Option(
            "--mounts-anew",
            help="With images: state another mount in every run, drawn about the true one, so that a recording serves "
            "several times.",
        ),
    ] = False,
    real: Annotated[Path | None, typer.Option(help="Folder of real recordings: a table of these instead.")] = None,
    against: Annotated[
        Path | None, typer.Option(help="Folder of another campaign with the same seeds, to compare the points with.")
    ] = None,
    validation: Annotated[Path | None, typer.Option(help="Markdown page to put this campaign's table into.")] = None,
    range_file: Annotated[
        Path | None, typer.Option("--range", help="Write the validated range that reports ask for (YAML).")
    ] = None,
) -> None:
    """Runs a campaign and writes summary.json, summary.csv, quantities.csv and report.html."""
    console, when = Console(), stamp()
    if real is not None:
        _real(console, real, output, validation, choose_executor(jobs, dask))
        return
    campaign = open_campaign(scenario, level, leave_out, decisions, sensitivity, recordings, mounts_anew)
    with _bar(console) as progress:
        task = progress.add_task("runs", total=runs)
        executor = choose_executor(jobs, dask)
        rows = run_campaign(output, campaign, runs, executor, lambda count: progress.advance(task, count))
    table = tabulate(rows, _other(against, runs))
    notes = [f"Scenario {scenario}, level {level}.", when]
    write_tables(output, table, rows)
    write_whole(output / "report.html", report_html(f"Campaign {scenario}", table, rows, notes))
    _print(console, table)
    console.print(f"{output / 'report.html'}")
    if validation is not None:
        extras = {
            "decisions": decisions,
            "without families": leave_out,
            "sensitivity": sensitivity,
            "mounts anew": mounts_anew,
        }
        name = ", ".join([Path(scenario).stem, *(extra for extra, asked in extras.items() if asked)])
        update_validation(validation, name, level, table, when)
    if range_file is not None:
        write_whole(range_file, range_text(validated_range(rows, level, when)))
        console.print(f"{range_file}")
    if table.failed == table.runs:
        raise SurecutError(f"no run gave a result; the first says: {next(iter(table.reasons))}")


def _other(folder: Path | None, runs: int) -> tuple[str, list[Row]] | None:
    if folder is None:
        return None
    rows = read_rows(folder, range(runs))
    if not rows:
        raise SurecutError(f"{folder}: holds no runs of a campaign to compare with")
    return ", ".join(dict.fromkeys(row["scenario"] for row in rows)), rows


def stamp() -> str:
    """Date and commit, for the record."""
    here = Path(__file__).parent
    try:
        found = subprocess.run(
            ["git", "-C", str(here), "rev-parse", "--short", "HEAD"], capture_output=True, text=True, check=True
        )
        commit = found.stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        commit = "unknown"
    return f"{datetime.now(UTC):%Y-%m-%d}, commit {commit}"


def _print(console: Console, table: CampaignTable) -> None:
    grid = Table(box=None, pad_edge=False)
    for name in ("quantity", "runs", "mean", "worst", "NEES/dof", "accepted", "in 95 %"):
        grid.add_column(name, justify="left" if name == "quantity" else "right")
    for summary in table.summaries:
        at95 = next(coverage for coverage in summary.coverage if coverage.level == 0.95)
        grid.add_row(
            label(summary),
            str(summary.runs),
            quantity_text(summary.mean, summary.unit),
            quantity_text(summary.worst, summary.unit),
            f"{summary.nees_per_dof:.2f}",
            f"{summary.nees_lower:.2f} to {summary.nees_upper:.2f}",
            f"{100 * at95.share:.1f} %",
        )
    if table.chain is not None:
        grid.add_row(
            "paper's chain",
            str(table.chain.count),
            quantity_text(table.chain.mean, "m"),
            quantity_text(table.chain.worst, "m"),
        )
    console.print(grid)
    console.print(
        f"{table.runs} runs, {table.failed} without a result; consistency check passed in "
        f"{100 * table.consistent:.1f} %; {table.mean_seconds:.2f} s per estimate"
    )


def _real(console: Console, folder: Path, output: Path, validation: Path | None, executor: Executor) -> None:
    tasks = real_tasks(folder)
    if not tasks:
        raise SurecutError(f"{folder}: holds none of the recordings that are known; see its README")
    with _bar(console) as progress:
        bar = progress.add_task("recordings", total=len(tasks))

        def done(name: str) -> None:
            progress.update(bar, advance=1, description=name)

        rows = real_table(folder, output, executor, done)
    text = real_text(rows)
    write_whole(output / "real.md", text)
    console.print(text, markup=False)
    if validation is not None:
        update_validation(validation, "real recordings", "with references", text, stamp())


def _bar(console: Console) -> Progress:
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    return Progress(*columns, TextColumn("left"), TimeRemainingColumn(), console=console)
