"""What is in a log, what the estimator can use of it, what is missing and what is odd."""

import json
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from ...factors.errors import RigError
from ...factors.rig import Rig, load_rig
from ...io.inventory import Inventory, TopicInventory, check_stamps, take_inventory
from ...io.reader import LogReader
from ..log_check import Findings, check_log
from ..output_files import write_text


def command(
    log: Annotated[str, typer.Argument(help="An MCAP log, a rosbag2 folder, or - for standard input.")],
    rig: Annotated[Path | None, typer.Option(help="Rig file; without it the one that the log carries.")] = None,
    json_file: Annotated[Path | None, typer.Option("--json", help="Write the same as JSON.")] = None,
) -> None:
    """Show what is in a log, what the estimator can use of it, what is missing and what is odd."""
    given = load_rig(rig) if rig is not None else None
    source = typer.get_binary_stream("stdin") if log == "-" else log
    with LogReader(source) as reader:
        inventory = take_inventory(reader)
        sha256 = reader.sha256()
    effective, trouble = (given, None) if given is not None else carried_rig(inventory)
    findings = check_log(inventory, effective)
    if trouble is not None:
        findings = Findings(findings.usable, findings.missing, (*findings.odd, trouble))
    show(inventory, findings, Console())
    if json_file is not None:
        write_text(json_file, json.dumps(as_json(inventory, findings, sha256), indent=1) + "\n")


def carried_rig(inventory: Inventory) -> tuple[Rig | None, str | None]:
    """The rig that a log carries, or what is wrong with it."""
    if inventory.rig_yaml is None:
        return None, None
    try:
        return load_rig(inventory.rig_yaml, f"{inventory.name}: attachment rig.yaml"), None
    except RigError as error:
        return None, str(error)


def show(inventory: Inventory, findings: Findings, console: Console) -> None:
    """Print a table of topics and the findings."""
    seconds = duration_s(inventory)
    console.print(f"[bold]{escape(inventory.name)}[/]  {seconds:.1f} s, {len(inventory.topics)} topics")
    table = Table("topic", "type", "encoding")
    for column in ("messages", "Hz", "longest gap s"):
        table.add_column(column, justify="right")
    table.add_column("what")
    for topic in sorted(inventory.topics.values(), key=lambda entry: entry.topic):
        check = check_stamps(topic.stamps())
        rate = f"{check.rate_hz:.1f}" if check.rate_hz else ""
        gap = f"{check.largest_gap_s:.3f}" if check.rate_hz else ""
        cells = (topic.topic, topic.type_name, topic.encoding, str(topic.messages), rate, gap, what(topic))
        table.add_row(*(escape(cell) for cell in cells))
    console.print(table)
    for title, texts in (("usable", findings.usable), ("missing", findings.missing), ("odd", findings.odd)):
        console.print(f"[bold]{title}[/]" + ("" if texts else ": nothing"))
        for text in texts:
            console.print(f"  - {escape(text)}", soft_wrap=True)


def what(topic: TopicInventory) -> str:
    """What a topic carries, in a few words."""
    words = {"other": "not used"}.get(topic.kind, topic.kind)
    if topic.size is not None:
        words += f" {topic.size[0]}x{topic.size[1]}"
    if topic.camera is not None:
        words += f" {topic.camera.distortion_model} {topic.camera.width}x{topic.camera.height}"
    if topic.marker_ids:
        words += f", {len(topic.marker_ids)} ids of {', '.join(sorted(topic.families))}"
    return words


def duration_s(inventory: Inventory) -> float:
    """From the first to the last message."""
    return ((inventory.end_ns or 0) - (inventory.start_ns or 0)) / 1e9


def as_json(inventory: Inventory, findings: Findings, sha256: str) -> dict[str, Any]:
    """The same for machines."""
    topics = {}
    for name, topic in sorted(inventory.topics.items()):
        check = check_stamps(topic.stamps())
        topics[name] = {
            "type": topic.type_name,
            "encoding": topic.encoding,
            "messages": topic.messages,
            "kind": topic.kind,
            "frame_id": topic.frame_id,
            "rate_hz": check.rate_hz,
            "largest_gap_s": check.largest_gap_s,
            "gaps": check.gaps,
            "backwards": check.backwards,
            "duplicated": check.duplicated,
            "unset": check.unset,
            "size": list(topic.size) if topic.size else None,
        }
    return {
        "log": inventory.name,
        "log_sha256": sha256,
        "duration_s": duration_s(inventory),
        "topics": topics,
        "usable": list(findings.usable),
        "missing": list(findings.missing),
        "odd": list(findings.odd),
    }
