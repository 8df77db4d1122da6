"""Print an example of the rig file, or check one and print the effective configuration."""

from pathlib import Path
from typing import Annotated

import typer

from ...factors.errors import LogError
from ...factors.rig import dump_rig, load_rig
from ...io.reader import LogReader

EXAMPLE = Path(__file__).parents[1] / "rig_example.yaml"


def command(
    file: Annotated[Path | None, typer.Argument(help="A rig file to check.", metavar="[RIG]")] = None,
    example: Annotated[bool, typer.Option("--example", help="Print a commented example of every key.")] = False,
    log: Annotated[Path | None, typer.Option("--from", help="Print the rig that a log carries.")] = None,
) -> None:
    """Print an example of the rig file, or check one and print the effective configuration."""
    if sum((file is not None, example, log is not None)) != 1:
        raise typer.BadParameter("give one of: a rig file, --example, --from LOG")
    if example:
        typer.echo(EXAMPLE.read_text(encoding="utf-8"), nl=False)
    elif file is not None:
        typer.echo(dump_rig(load_rig(file)), nl=False)
    elif log is not None:
        typer.echo(dump_rig(load_rig(rig_text(log), f"{log}: attachment rig.yaml")), nl=False)


def rig_text(log: Path) -> bytes:
    """The rig file that a log carries.

    Raises:
        LogError: it carries none, or is no log.
    """
    with LogReader(log) as reader:
        text = reader.attachment("rig.yaml")
    if text is None:
        raise LogError(f"{log}: carries no rig.yaml; give the rig file with --rig")
    return text
