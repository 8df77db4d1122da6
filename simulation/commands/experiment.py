"""Repeat a published experiment on rendered images, with the truth beside it."""

import sys
from pathlib import Path
from typing import Annotated

import typer
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn
from rich.table import Table

from ...estimator.output_files import write_bytes, write_text
from ...factors.errors import SurecutError
from ..fiducial_experiment import METHODS, Outcome, Setup, run_experiment
from ..fiducial_plot import FORMATS, draw
from ..fiducial_table import as_json, as_section, cells, rows, stated, told, with_section
from ..held import HOLDS
from ..pipe_experiment import examine_all
from ..pipe_table import as_json as pipe_json
from ..pipe_table import as_section as pipe_section
from ..pipe_table import tables as pipe_tables

app = typer.Typer(no_args_is_help=True)
_COLUMNS = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeRemainingColumn())


@app.callback()
def _experiments() -> None:
    """Repeat a published experiment on rendered images, with the truth beside it."""


@app.command()
def fiducial(
    json_file: Annotated[Path | None, typer.Option("--json", help="Write everything in figures.")] = None,
    plot: Annotated[Path | None, typer.Option(help="Draw depth errors against distance (.svg or .png).")] = None,
    page: Annotated[Path | None, typer.Option(help="Put the tables into a page (Markdown).")] = None,
    images: Annotated[int, typer.Option(help="Images at each distance.", min=1)] = 5,
    distances: Annotated[str, typer.Option(help="From, to and step in mm.")] = "400,1200,100",
    size: Annotated[str, typer.Option(help="Width and height of the images, px.")] = "1920x1080",
    focal: Annotated[float, typer.Option(help="True focal length, px.", min=10)] = 1400.0,
    focal_error: Annotated[float, typer.Option(help="Per cent by which the given focal length is too long.")] = 0.0,
    focal_sigma: Annotated[
        float | None,
        typer.Option(help="Sigma of the given focal length, per cent.  [default: the error, at least 0.3]", min=0),
    ] = None,
    seed: Annotated[int, typer.Option(help="Draws places, light and noise.", min=0)] = 1,
) -> None:
    """Depth of printed markers at 400 to 1200 mm: raw, times the scalar S, and joint."""
    if plot is not None and plot.suffix.lower() not in FORMATS:
        raise SurecutError(f"{plot}: a plot is written as .svg or .png; change the name")
    sigma = max(abs(focal_error), 0.3) if focal_sigma is None else focal_sigma
    setup = Setup(
        distances_m=distances_of(distances),
        images=images,
        size_px=size_of(size),
        focal_px=focal,
        focal_error_rel=focal_error / 100,
        focal_sigma_rel=sigma / 100,
        seed=seed,
    )
    with Progress(*_COLUMNS, transient=True) as bar:
        task = bar.add_task("photographing the page", total=1.0)
        outcome = run_experiment(setup, lambda share: bar.update(task, completed=share))
    show(outcome, Console())
    if json_file is not None:
        write_text(json_file, as_json(outcome))
    if page is not None:
        before = page.read_text(encoding="utf-8") if page.exists() else "# Fiducials\n"
        write_text(page, with_section(before, as_section(setup, rows(outcome.depths), told(outcome))))
    if plot is not None:
        write_bytes(plot, draw(outcome, plot.suffix))


@app.command()
def pipe(
    folder: Annotated[Path, typer.Argument(help="Simulated recordings (*.mcap); they carry their truth.")],
    json_file: Annotated[Path | None, typer.Option("--json", help="Write everything in figures.")] = None,
    page: Annotated[Path | None, typer.Option(help="Put the tables into a page (Markdown).")] = None,
    held: Annotated[
        bool, typer.Option("--held", help="Solve again with parts of the truth held: what stands in the way?")
    ] = False,
    recordings: Annotated[int | None, typer.Option(help="Only the first ones.", min=1)] = None,
) -> None:
    """Cut points and cylinders of simulated recordings against their truth."""
    with Progress(*_COLUMNS, transient=True) as bar:
        task = bar.add_task("recordings", total=min(len(list(folder.glob("*.mcap"))), recordings or sys.maxsize))
        found = examine_all(folder, tuple(HOLDS) if held else (), recordings, lambda: bar.advance(task))
    console = Console()
    for title, header, lines in pipe_tables(found):
        shown = Table(title=title, box=SIMPLE_HEAD, pad_edge=False, collapse_padding=True)
        for name in header:
            shown.add_column(name)
        for line in lines:
            shown.add_row(*line)
        console.print(shown)
    for one in found:
        if one.reason:
            console.print(f"{one.recording}: {one.reason}", highlight=False)
    if json_file is not None:
        write_text(json_file, pipe_json(found))
    if page is not None:
        before = page.read_text(encoding="utf-8") if page.exists() else "# Pipes\n"
        heading = f"Simulated recordings: {len(found)} of {folder.name}"
        write_text(page, with_section(before, pipe_section(found, heading)))


def show(outcome: Outcome, console: Console) -> None:
    """One table per side length."""
    table = rows(outcome.depths)
    for typed in outcome.setup.typed_sides_m:
        title = f"Depth error, mm: {1e3 * outcome.setup.side_m:.0f} mm markers given as {1e3 * typed:.0f} mm"
        shown = Table(title=title, box=SIMPLE_HEAD, pad_edge=False, collapse_padding=True)
        shown.add_column("distance", justify="right", no_wrap=True)
        for method in METHODS:
            shown.add_column(f"{method}\nmean / spread", justify="right", no_wrap=True)
            shown.add_column("turned\ndeg", justify="right", no_wrap=True)
        for line in cells(table, typed):
            shown.add_row(*line)
        console.print(shown)
        console.print(stated(table, typed), highlight=False)
    console.print(told(outcome), highlight=False)


def distances_of(text: str) -> tuple[float, ...]:
    """Metres of `400,1200,100`: from, to and step in mm.

    Raises:
        SurecutError: something else, or more than a hundred.
    """
    try:
        first, last, step = (float(part) for part in text.split(","))
    except ValueError:
        raise SurecutError(f"--distances {text!r}: write from, to and step in mm, such as 400,1200,100") from None
    if not (0 < first <= last and step > 0 and (last - first) / step < 100):
        raise SurecutError(f"--distances {text!r}: from, to and step in mm have to rise from above zero, 100 at most")
    count = int((last - first) / step + 1e-9) + 1
    return tuple(round(first + k * step, 6) / 1e3 for k in range(count))


def size_of(text: str) -> tuple[int, int]:
    """Width and height of `1920x1080`.

    Raises:
        SurecutError: something else.
    """
    width, _, height = text.partition("x")
    if not (width.isdigit() and height.isdigit() and 64 <= int(width) <= 8192 and 64 <= int(height) <= 8192):
        raise SurecutError(f"--size {text!r}: write width x height in pixels, such as 1920x1080")
    return int(width), int(height)
