"""May we cut here? The uncertainty report of a result, as HTML, PDF and JSON."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from ...factors.errors import SurecutError
from ...factors.rig import Rig, load_rig
from ...io.reader import LogReader
from ..decision import decide
from ..executor import Executor, choose_executor
from ..output_files import write_bytes, write_text
from ..report.blocks import Document
from ..report.compare import Run, build_comparison
from ..report.content import build_document
from ..report.html import render_html
from ..report.machine import render_json
from ..result import Result
from ..result_json import ResultError, from_json, stored_sha256, to_json
from ..validated_range import ValidatedRange, load_validated_range

ATTACHMENT = "result.json"
MCAP_MAGIC = b"\x89MCAP0\r\n"


@dataclass(frozen=True, slots=True)
class StoredResult:
    """A result as it was read, with the rig that it was made with and its own hash."""

    name: str
    result: Result
    rig: Rig
    sha256: str


@dataclass(frozen=True, slots=True)
class ReportJob:
    """One report to write."""

    result: Path
    html: Path | None
    pdf: Path | None
    json: Path | None
    rig: Path | None
    validation: Path | None


def command(
    results: Annotated[
        list[Path],
        typer.Argument(help="What `surecut optimise` wrote (MCAP or JSON), or recordings.", metavar="RESULT"),
    ],
    html_file: Annotated[
        Path | None, typer.Option("-o", "--output", help="Write the report as HTML; of several results: a folder.")
    ] = None,
    pdf_file: Annotated[Path | None, typer.Option("--pdf", help="Write it as PDF; of several: a folder.")] = None,
    json_file: Annotated[Path | None, typer.Option("--json", help="Write it as JSON; of several: a folder.")] = None,
    other: Annotated[Path | None, typer.Option("--compare", help="Another result: report the differences.")] = None,
    rig: Annotated[Path | None, typer.Option(help="Rig file with the cut plan, for the result's own.")] = None,
    validation: Annotated[Path | None, typer.Option(help="Validated range, instead of the one installed.")] = None,
    jobs: Annotated[int, typer.Option("--jobs", min=1, help="Results worked on at the same time.")] = 1,
    dask: Annotated[str | None, typer.Option("--dask", help="Address of a Dask scheduler, tcp://...")] = None,
) -> None:
    """May we cut here, with what margin, what limits it, what to measure next."""
    if html_file is None and pdf_file is None and json_file is None:
        raise typer.BadParameter("nothing to write: give -o report.html, --pdf report.pdf or --json report.json")
    if other is not None and json_file is not None:
        raise typer.BadParameter("a comparison is written as HTML or PDF; leave --json out")
    if len(results) > 1 and other is not None:
        raise typer.BadParameter("a comparison is of one result with another; give one before --compare")
    if other is not None:
        _compare(results[0], other, rig, load_validated_range(validation), html_file, pdf_file)
        return
    targets = (html_file, pdf_file, json_file)
    if len(results) > 1:
        for target in targets:
            if target is not None:
                target.mkdir(parents=True, exist_ok=True)
    work = [_job(path, targets, rig, validation) for path in results]
    if len(work) == 1:
        for line in report_job(work[0]):
            typer.echo(line)
        return
    _many(work, choose_executor(jobs, dask))


def report_job(job: ReportJob) -> list[str]:
    """One report; returns its verdicts. Top level, so that processes and clusters can take it."""
    stored, validated = read_result(job.result, job.rig), load_validated_range(job.validation)
    plan = None if job.rig is None else job.rig.name
    _write(build_document(stored.result, stored.rig, validated, stored.sha256, plan), job.html, job.pdf)
    if job.json is not None:
        write_text(job.json, render_json(stored.result, stored.rig, validated, stored.sha256))
    told = [f"{made.verdict}: {made.headline}" for made in decide(stored.result, stored.rig, validated)]
    return told if stored.rig.cut_plan else ["NO VERDICT: the rig file has no cut plan"]


def _job(
    result: Path, targets: tuple[Path | None, Path | None, Path | None], rig: Path | None, validation: Path | None
) -> ReportJob:
    """Each report goes to the file that was named, or to one with the result's name in the folder that was."""

    def place(target: Path | None, suffix: str) -> Path | None:
        return target / f"{result.stem}{suffix}" if target is not None and target.is_dir() else target

    html, pdf, json = targets
    return ReportJob(result, place(html, ".html"), place(pdf, ".pdf"), place(json, ".json"), rig, validation)


def _many(work: Sequence[ReportJob], executor: Executor) -> None:
    """Many results; a failing one is a line with its reason and does not stop the others."""
    names = [job.result.stem for job in work]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise SurecutError(f"{twice[0]}: two results of that name would write the same report; report them apart")
    failed = 0
    for outcome in sorted(executor.run(report_job, work), key=lambda o: str(o.item.result)):
        failed += outcome.error is not None
        for line in outcome.value if outcome.value is not None else [f"FAILED: {outcome.error}"]:
            typer.echo(f"{outcome.item.result}: {line}")
    if failed:
        raise SurecutError(f"{failed} of {len(work)} results gave no report; the lines above name the reasons")


def _compare(
    path: Path, other: Path, rig: Path | None, validated: ValidatedRange | None, html: Path | None, pdf: Path | None
) -> None:
    """Two results side by side, and the verdicts on the first."""
    stored, second = read_result(path, rig), read_result(other, rig)
    _write(build_comparison(_run(stored), _run(second), validated), html, pdf)
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
