"""The command line `surecut`: a frame that finds its commands and tells errors in one line.

A command is a function with typer's annotations in a module of its own, listed in `pyproject.toml`:

    [project.entry-points."surecut.commands"]
    info = "surecut.estimator.commands.info:command"

It may also be a `typer.Typer` with sub-commands. Only the module of the command that is called is imported; the list
in `surecut --help` shows the first line of each module's docstring. A command translates arguments, calls a function
that can be imported, and prints; it lets `SurecutError` pass. After a change to the list: `pip install -e .`.

Exit status: 0 done; 1 the input cannot give an answer, and one line says why; 2 wrong usage; 130 interrupted.
An unexpected exception is a defect and keeps its traceback.
"""

import ast
import atexit
import gc
import importlib.util
import os
import sys
from collections.abc import Callable, Sequence
from importlib.metadata import EntryPoint, entry_points, version
from pathlib import Path
from typing import Annotated, Any

import typer

from ..factors.errors import SurecutError
from .threads import use_one_thread

GROUP = "surecut.commands"
COLLECT_EVERY = 10_000
"""New objects between two searches for unreachable ones. Libraries bring many that stay; at Python's 700 the searches
among them take a tenth of a command's start."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Run a command and exit with its status."""
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")  # a bad image is told in our own one line
    use_one_thread()
    gc.set_threshold(COLLECT_EVERY)
    atexit.register(gc.freeze)  # at the end nobody searches what the system takes back anyway
    given = list(sys.argv[1:] if arguments is None else arguments)
    run = typer.main.get_command(application(given))
    try:
        run(given, prog_name="surecut")
    except SurecutError as error:
        print(f"surecut: {one_line(error)}", file=sys.stderr)
        raise SystemExit(1) from None


def application(arguments: Sequence[str]) -> typer.Typer:
    """The commands, of which only the one that `arguments` name is imported."""
    app = typer.Typer(add_completion=False, no_args_is_help=True, pretty_exceptions_enable=False, rich_markup_mode=None)
    app.callback()(_options)
    wanted = next((argument for argument in arguments if not argument.startswith("-")), None)
    points = sorted(entry_points(group=GROUP), key=lambda entry: entry.name)
    named = [point for point in points if point.name == wanted]
    if named and arguments[0] == wanted:  # nobody will see the list
        points = named
    for point in points:
        if point.name != wanted:
            app.command(point.name, help=summary_of(point))(_not_loaded)
            continue
        command: Callable[..., Any] | typer.Typer = point.load()
        if isinstance(command, typer.Typer):
            app.add_typer(command, name=point.name, help=summary_of(point))
        else:
            app.command(point.name)(command)
    return app


def one_line(error: BaseException) -> str:
    """An error's message without line breaks."""
    return " ".join(str(error).split())


def summary_of(point: EntryPoint) -> str:
    """First line of a command's module docstring, read without importing the module."""
    try:
        spec = importlib.util.find_spec(point.module)
    except ModuleNotFoundError:
        return ""
    if spec is None or spec.origin is None:
        return ""
    docstring = ast.get_docstring(ast.parse(Path(spec.origin).read_text(encoding="utf-8"))) or ""
    return docstring.partition("\n")[0]


def _not_loaded() -> None:
    """Stands for a command in the list of commands."""


def _version(wanted: bool) -> None:
    if wanted:
        print(f"surecut {version('surecut')}")
        raise typer.Exit


def _options(
    show_version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Show the version and exit.")
    ] = False,
) -> None:
    """Where is the pipe in the robot's frame, and how sure are we?"""
