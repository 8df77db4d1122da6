"""Render a synthetic recording of the robot cell, with its truth."""

from pathlib import Path
from typing import Annotated, Literal

import typer
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

from .recording import simulate
from .scenario import Scenario, ScenarioError, load_scenarios, override, scenario_names


def command(
    out: Annotated[Path | None, typer.Argument(help="The log to write (.mcap).", show_default=False)] = None,
    scenario: Annotated[str, typer.Option(help="A scenario file, or a name that --list shows.")] = "demo",
    run: Annotated[int, typer.Option(help="Which run of a scenario with several, from 1.", min=1)] = 1,
    seed: Annotated[int, typer.Option(help="Draws faults of the rig, cell, motion and noise.", min=0)] = 1,
    duration: Annotated[float | None, typer.Option(help="Seconds, instead of the scenario's.")] = None,
    place: Annotated[Literal["A", "B", "C"] | None, typer.Option(help="Where the pipe stands.")] = None,
    motion: Annotated[Literal["smooth", "sharp"] | None, typer.Option(help="How the camera is moved.")] = None,
    initialisation: Annotated[int | None, typer.Option(help="Where the camera starts, 0 to 2.")] = None,
    typed_side: Annotated[float | None, typer.Option(help="Marker side that the rig file claims, m.")] = None,
    return_to_board: Annotated[bool | None, typer.Option(help="Whether the camera ends before the board.")] = None,
    workers: Annotated[int, typer.Option(help="Processes that render.", min=1)] = 2,
    list_: Annotated[bool, typer.Option("--list", help="Name the scenarios of the package, write nothing.")] = False,
) -> None:
    """Render a synthetic recording of the robot cell, with its truth."""
    if list_:
        for name in scenario_names():
            runs = load_scenarios(name)
            typer.echo(f"{name:12} {len(runs)} run{'s' * (len(runs) > 1)}: {runs[0].description}")
        return
    if out is None:
        raise typer.BadParameter("name the log to write", param_hint="out")
    changes = {
        "duration_s": duration,
        "place": place,
        "motion": motion,
        "initialisation": initialisation,
        "return_to_board": return_to_board,
        "board": None if typed_side is None else {"typed_side_m": typed_side},
    }
    given = {key: value for key, value in changes.items() if value is not None}
    chosen = override(_run_of(load_scenarios(scenario), run, scenario), given)
    columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
    with Progress(*columns, transient=True) as bar:
        task = bar.add_task(f"rendering {out.name}", total=1.0)
        simulate(out, chosen, seed, lambda share: bar.update(task, completed=share), workers)
    typer.echo(f"{out}: scenario {chosen.name}, seed {seed}, {chosen.duration_s:g} s")


def _run_of(runs: list[Scenario], number: int, name: str) -> Scenario:
    if number > len(runs):
        raise ScenarioError(f"{name}: has {len(runs)} run(s), not {number}; give --run from 1 to {len(runs)}")
    return runs[number - 1]
