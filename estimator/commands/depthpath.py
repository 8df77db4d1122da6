"""The path of a depth camera that is carried about, by its depth images alone."""

from pathlib import Path
from typing import Annotated

import typer

from ...io.reader import LogReader
from ..depth_path import depth_path, tum_line
from ..optimise import rig_of
from ..output_files import write_text


def command(
    log: Annotated[Path, typer.Argument(help="An MCAP recording with depth images or clouds.")],
    tum: Annotated[Path, typer.Option("--tum", help="Trajectory of the depth camera, TUM format.")],
    rig: Annotated[Path | None, typer.Option("--rig", help="Rig file; overrides the one in the log.")] = None,
) -> None:
    """The path of a depth camera that is carried about, by its depth images alone, in the frame of the first image."""
    with LogReader(log) as reader:
        given = rig_of(reader, rig)
    poses = list(depth_path(log, given))
    write_text(tum, "".join(tum_line(pose) + "\n" for pose in poses))
    lost = sum(pose.lost for pose in poses)
    typer.echo(f"{tum}: {len(poses)} poses" + (f", {lost} of them guessed: the clouds hardly met" if lost else ""))
