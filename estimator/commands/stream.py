"""Estimate live, from sensors or a replay, with the numbers of `optimise`; to viewers, robot and files."""

import signal
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from ...factors.errors import LogError, SurecutError
from ...factors.rig import Rig, dump_rig, load_rig
from ...io.live.access import Access
from ...io.live.expected import expected_bodies
from ...io.live.foxglove_client import FoxgloveClient
from ...io.live.foxglove_server import FoxgloveServer
from ...io.live.interfaces import Sink, Source
from ...io.live.json_server import JsonServer
from ...io.live.mcap_stream import McapStream
from ...io.live.recorder import Recorder
from ...io.live.replay import Replay
from ...io.live.web_server import WebServer
from ...io.reader import LogReader
from ..output_files import write_text
from ..sensing import wanted_topics
from ..stream.report import summary_json, summary_lines
from ..stream.settings import StreamSettings
from ..stream.stream import Stream
from ..validated_range import load_validated_range

HELP_EPILOG = """Examples:

  surecut stream --rig cell.yaml --zenoh tcp/robot:7447 --view 8765 --tcp 9000

  surecut stream --rig cell.yaml --foxglove ws://robot:8765 --record shift.mcap --checkpoint cell.memory.json

  surecut stream --replay run.mcap --rate max --json live.json
"""


def command(
    rig: Annotated[Path | None, typer.Option("--rig", help="Rig file; a replayed log may carry its own.")] = None,
    zenoh: Annotated[
        str | None, typer.Option("--zenoh", help="Input from robots with rmw_zenoh: router, such as tcp/HOST:7447.")
    ] = None,
    zenoh_domain: Annotated[int, typer.Option("--zenoh-domain", help="ROS_DOMAIN_ID.", min=0, max=232)] = 0,
    foxglove: Annotated[
        list[str] | None, typer.Option("--foxglove", help="Input from a Foxglove WebSocket server, ws://HOST:PORT.")
    ] = None,
    mcap: Annotated[
        list[str] | None, typer.Option("--mcap", help="Input as an MCAP stream: - (stdin) or tcp://HOST:PORT.")
    ] = None,
    replay: Annotated[Path | None, typer.Option("--replay", help="Input from a recorded log, as if live.")] = None,
    rate: Annotated[str, typer.Option("--rate", help="Speed of the replay: 1, 2.5, ... or max.")] = "1",
    loop: Annotated[int, typer.Option("--loop", min=1, help="How often the replayed log is played.")] = 1,
    view: Annotated[int | None, typer.Option("--view", help="Foxglove WebSocket server on this port.")] = None,
    tcp: Annotated[int | None, typer.Option("--tcp", help="One JSON line per update on this port.")] = None,
    web: Annotated[int | None, typer.Option("--web", help="/metrics (Prometheus) and /healthz on this port.")] = None,
    zenoh_out: Annotated[
        str | None, typer.Option("--zenoh-out", help="Publish to robots with rmw_zenoh: router, such as tcp/HOST:7447.")
    ] = None,
    record: Annotated[Path | None, typer.Option("--record", help="Record the estimates (MCAP), flushed.")] = None,
    checkpoint: Annotated[
        Path | None, typer.Option("--checkpoint", help="Memory, written every few seconds; a restart goes on from it.")
    ] = None,
    prior: Annotated[
        Path | None, typer.Option("--prior", help="Memory of an earlier run to begin with, where no checkpoint is.")
    ] = None,
    host: Annotated[str, typer.Option("--host", help="Address that servers listen on.")] = "127.0.0.1",
    allow_remote: Annotated[
        bool, typer.Option("--allow-remote", help="Let servers listen where other machines can reach them.")
    ] = False,
    token: Annotated[
        str | None, typer.Option("--token", envvar="SURECUT_TOKEN", help="What commands from elsewhere must carry.")
    ] = None,
    validation: Annotated[
        Path | None, typer.Option("--validation", help="Validated range; see docs/report.md.")
    ] = None,
    json: Annotated[Path | None, typer.Option("--json", help="At the end: the last answer and all counters.")] = None,
) -> None:
    """Estimate live, from sensors or a replay, with the numbers of `optimise`; to viewers, robot and files."""
    rig_data = _rig(rig, replay)
    sources = _sources(rig_data, zenoh, zenoh_domain, foxglove or [], mcap or [], replay, rate, loop)
    access = Access(host, allow_remote, token)
    sinks: list[Sink] = []
    if view is not None:
        sinks.append(FoxgloveServer(access, view, picks_topic=rig_data.picks_topic))
    if tcp is not None:
        sinks.append(JsonServer(access, tcp))
    if record is not None:
        attachments = (("rig.yaml", "application/yaml", dump_rig(rig_data).encode()),)
        sinks.append(Recorder(record, attachments=attachments))
    if zenoh_out is not None:
        sinks.append(_zenoh_sink(zenoh_out, zenoh_domain))
    if web is not None:
        counted = [*sinks]
        sinks.append(WebServer(access, web, extra=lambda: _totals(counted)))
    if prior is not None and not prior.exists():
        raise SurecutError(f"{prior}: is not there; give the memory of an earlier run, or leave --prior out")
    stream = Stream(
        rig_data,
        sources,
        sinks,
        StreamSettings(),
        live=replay is None,
        prior=prior,
        checkpoint=checkpoint,
        validated=load_validated_range(validation),
    )
    for name in (signal.SIGINT, signal.SIGTERM):
        signal.signal(name, lambda *_: stream.stop())
    console = Console(stderr=True)
    for source in sources:
        console.print(f"in:  {source.name}")
    for sink in sinks:
        console.print(f"out: {sink.name}")
    stream.run()
    if json is not None:
        write_text(json, summary_json(stream))
    for line in summary_lines(stream):
        console.print(line)


def _rig(given: Path | None, replay: Path | None) -> Rig:
    if given is not None:
        return load_rig(given)
    if replay is None:
        raise typer.BadParameter("--rig is needed for live input")
    with LogReader(replay) as reader:
        text = reader.attachment("rig.yaml")
    if text is None:
        raise LogError(f"{replay}: carries no rig.yaml; give the rig file with --rig")
    return load_rig(text, f"{replay}: rig.yaml")


def _sources(
    rig: Rig, zenoh: str | None, domain: int, foxglove: list[str], mcap: list[str], replay: Path | None, rate: str,
    loop: int,
) -> list[Source]:  # fmt: skip
    sources: list[Source] = []
    expected = expected_bodies(rig)
    if zenoh is not None:
        from ...io.live.zenoh_source import ZenohSource  # loads a Rust runtime

        sources.append(ZenohSource(expected, zenoh, domain=domain))
    sources += [FoxgloveClient(url, expected) for url in foxglove]
    sources += [McapStream(address, expected) for address in mcap]
    if replay is not None:
        if sources:
            raise typer.BadParameter("--replay stands alone: its time is not that of live input")
        sources.append(Replay(replay, _rate(rate), wanted_topics(rig), repeat=loop))
    if not sources:
        raise typer.BadParameter("give an input: --zenoh, --foxglove, --mcap or --replay")
    return sources


def _rate(text: str) -> float | None:
    if text == "max":
        return None
    try:
        return float(text)
    except ValueError:
        raise typer.BadParameter(f"--rate is a number or max; got {text!r}") from None


def _zenoh_sink(router: str, domain: int) -> Sink:
    from ...io.live.zenoh_sink import ZenohSink  # loads a Rust runtime

    return ZenohSink(router, domain=domain)


def _totals(sinks: list[Sink]) -> Mapping[str, int]:
    return {f"sink{i}_{name}": n for i, sink in enumerate(sinks) for name, n in sink.counters().items()}
