"""A printable board of markers at exact size, with a ruler to check the print, and the rig file's section for it."""

import re
from pathlib import Path
from typing import Annotated

import typer
import yaml

from ...factors.errors import RigError
from ...factors.rig import Board
from ...frontends.fiducials.page import PAPERS_MM, as_pdf, as_svg, lay_out
from ..output_files import write_bytes, write_text

_MM = {"mm": 1.0, "cm": 10.0, "m": 1000.0, "in": 25.4}


def command(
    output: Annotated[Path, typer.Option("--output", "-o", help="PDF to write.")] = Path("board.pdf"),
    dictionary: Annotated[str, typer.Option(help="OpenCV dictionary, or an AprilTag family.")] = "DICT_4X4_50",
    ids: Annotated[str, typer.Option(help="Marker ids, such as 0-3 or 4,7,20-22.")] = "0-3",
    side: Annotated[str, typer.Option(help="Side of the black square, with its unit.")] = "75mm",
    page: Annotated[str, typer.Option(help=f"{', '.join(PAPERS_MM)}, or width x height such as 300x400mm.")] = "A4",
    landscape: Annotated[bool, typer.Option("--landscape", help="Turn the page.")] = False,
    name: Annotated[str, typer.Option(help="The board's id in the rig file.")] = "f0",
    svg: Annotated[bool, typer.Option("--svg", help="Write an SVG beside the PDF.")] = False,
) -> None:
    """Write a printable board of markers at exact size, and print the rig file's section for it."""
    size = page_size_mm(page)
    layout = lay_out(dictionary, marker_ids(ids), length_mm(side), (size[1], size[0]) if landscape else size, name)
    section = rig_section(layout.board)
    write_bytes(output, as_pdf(layout))
    if svg:
        write_text(output.with_suffix(".svg"), as_svg(layout))
    write_text(output.with_suffix(".yaml"), section)
    typer.echo(section, nl=False)


def rig_section(board: Board) -> str:
    """The `boards` section of a rig file, for one board."""
    whole = board.model_dump(mode="json")
    kept = {key: whole[key] for key in ("id", "dictionary", "side_m")}
    kept["markers"] = [{"id": m["id"], "centre_m": m["centre_m"]} for m in whole["markers"]]
    return yaml.safe_dump({"boards": [kept]}, sort_keys=False, default_flow_style=None)


def length_mm(text: str) -> float:
    """Millimetres of `75mm`, `7.5 cm`, `0.075 m` or `3in`.

    Raises:
        RigError: no number, no unit, or not above zero.
    """
    match = re.fullmatch(r"\s*([0-9]*\.?[0-9]+)\s*(mm|cm|m|in)\s*", text)
    value = float(match[1]) * _MM[match[2]] if match else 0.0
    if value <= 0:
        raise RigError(f"{text!r} is no length; write it with its unit, such as 75mm")
    return value


def page_size_mm(text: str) -> tuple[float, float]:
    """Width and height of a paper by name, or of `300x400mm`.

    Raises:
        RigError: neither.
    """
    if text.upper() in PAPERS_MM:
        return PAPERS_MM[text.upper()]
    width, separator, height = text.partition("x")
    if not separator:
        raise RigError(f"page {text!r} is not known; known are {', '.join(PAPERS_MM)}, or a size such as 300x400mm")
    unit = re.sub(r"[0-9.\s]", "", height)
    return length_mm(width if re.search("[a-z]", width) else width + unit), length_mm(height)


def marker_ids(text: str) -> tuple[int, ...]:
    """Ids of `0-3` or `4,7,20-22`.

    Raises:
        RigError: something else.
    """
    ids: list[int] = []
    for part in text.split(","):
        match = re.fullmatch(r"\s*(\d{1,6})(?:\s*-\s*(\d{1,6}))?\s*", part)
        if match is None or (match[2] is not None and int(match[2]) < int(match[1])):
            raise RigError(f"{text!r} are no ids; write them such as 0-3 or 4,7,20-22")
        ids += range(int(match[1]), int(match[2] or match[1]) + 1)
    return tuple(ids)
