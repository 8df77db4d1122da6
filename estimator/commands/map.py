"""Write the mapped surroundings, the pipe and the points as a cloud (PLY or PCD)."""

from pathlib import Path
from typing import Annotated

import typer

from ...factors.errors import SurecutError
from ...io.point_files import pcd_bytes, ply_bytes
from ..output_files import write_bytes
from ..scene import build_scene
from .report import read_result

WRITERS = {".ply": ply_bytes, ".pcd": pcd_bytes}


def command(
    result: Annotated[Path, typer.Argument(help="What `surecut optimise` wrote (MCAP or JSON), or a recording.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="The cloud: scene.ply or scene.pcd.")],
) -> None:
    """Write the mapped surroundings, the pipe and the points as a cloud (PLY or PCD)."""
    writer = WRITERS.get(output.suffix.lower())
    if writer is None:
        raise typer.BadParameter(f"{output}: the name has to end with .ply or .pcd")
    stored = read_result(result)
    scene = build_scene(stored.result)
    if len(scene.points_m) == 0:
        raise SurecutError(f"{result}: holds nothing that could be drawn; run `surecut optimise` again")
    write_bytes(output, writer(scene.points_m, scene.colours, scene.sigma_m))
    mapped = 0 if stored.result.surroundings is None else len(stored.result.surroundings.points) // 16
    typer.echo(f"{output}: {len(scene.points_m)} points in {{b}}, {mapped} of them mapped")
