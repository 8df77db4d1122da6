"""May we cut here? The uncertainty report of a result, as HTML, PDF and JSON."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from ...factors.rig import Rig, load_rig
from ...io.reader import LogReader
from ..decision import decide
from ..output_files import write_bytes, write_text
from ..report.blocks import Document
from ..report.compare import Run, build_comparison
from ..report.content import build_document
from ..report.html import render_html
from ..report.machine import render_json
from ..result import Result
from ..result_json import ResultError, from_json, stored_sha256, to_json
from ..validated_range import load_validated_range

ATTACHMENT = "result.json"
MCAP_MAGIC = b"\x89MCAP0\r\n"


@dataclass(frozen=True, slots=True)
class StoredResult:
    """A result as it was read, with the rig that it was made with and its own hash."""

    name: str
    result: Result
    rig: Rig
    sha256: str


def command(
    result: Annotated[Path, typer.Argument(help="What `surecut optimise` wrote (MCAP or JSON), or a recording.")],
    html_file: Annotated[Path | None, typer.Option("-o", "--output", help="Write the report as HTML.")] = None,
    pdf_file: Annotated[Path | None, typer.Option("--pdf", help="Write the report as PDF.")] = None,
    json_file: Annotated[Path | None, typer.Option("--json", help="Write the report as JSON.")] = None,
    other: Annotated[Path | None, typer.Option("--compare", help="Another result: report the differences.")] = None,
    rig: Annotated[Path | None, typer.Option(help="Rig file with the cut plan, for the result's own.")] = None,
    validation: Annotated[Path | None, typer.Option(help="Validated range, instead of the one installed.")] = None,
) -> None:
    """May we cut here, with what margin, what limits it, what to measure next."""
    if html_file is None and pdf_file is None and json_file is None:
        raise typer.BadParameter("nothing to write: give -o report.html, --pdf report.pdf or --json report.json")
    if other is not None and json_file is not None:
        raise typer.BadParameter("a comparison is written as HTML or PDF; leave --json out")
    stored = read_result(result, rig)
    validated = load_validated_range(validation)
    if other is not None:
        second = read_result(other, rig)
        document = build_comparison(_run(stored), _run(second), validated)
    else:
        document = build_document(
            stored.result, stored.rig, validated, stored.sha256, None if rig is None else rig.name
        )
    _write(document, html_file, pdf_file)
    if json_file is not None:
        write_text(json_file, render_json(stored.result, stored.rig, validated, stored.sha256))
    for decision in decide(stored.result, stored.rig, validated):
        typer.echo(f"{decision.verdict}: {decision.headline}")
    if not stored.rig.cut_plan:
        typer.echo("NO VERDICT: the rig file has no cut plan")


def read_result(path: Path, rig: Path | None = None) -> StoredResult:
    """The result in an MCAP file (attachment `result.json`) or in a JSON file; a recording without one is estimated.

    Raises:
        SurecutError: no such file, a result of a newer version or edited by hand, or a recording without an answer.
    """
    try:
        text = _text(path)
    except OSError as error:
        reason = f"cannot be read ({error.strerror})"
        raise ResultError(f"{path}: {reason}; give the file that `surecut optimise` wrote") from error
    if text is None:
        from ..optimise import optimise  # the whole estimator, needed only here

        text = to_json(optimise(path, rig, command=f"surecut report {path.name}")).encode()
    result = from_json(text, str(path))
    used = load_rig(rig) if rig is not None else load_rig(result.config_yaml, f"{path}: effective rig")
    return StoredResult(path.name, result, used, stored_sha256(text))


def _text(path: Path) -> bytes | None:
    """The stored result; None where the path is a recording that holds none."""
    if path.is_dir():
        return None
    with path.open("rb") as file:
        if file.read(len(MCAP_MAGIC)) != MCAP_MAGIC:
            return path.read_bytes()
    with LogReader(path) as reader:
        return reader.attachment(ATTACHMENT)


def _run(stored: StoredResult) -> Run:
    return Run(stored.name, stored.result, stored.rig, stored.sha256)


def _write(document: Document, html_file: Path | None, pdf_file: Path | None) -> None:
    if html_file is not None:
        write_text(html_file, render_html(document))
    if pdf_file is not None:
        from ..report.pdf import render_pdf  # reportlab and its fonts take a while

        write_bytes(pdf_file, render_pdf(document))
