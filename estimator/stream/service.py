"""A stream as a command line asks for it: its inputs and outputs are opened here."""

import signal
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

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
from ..items import wanted_topics
from ..output_files import write_text
from ..validated_range import load_validated_range
from .report import summary_json, summary_lines
from .settings import StreamSettings
from .stream import Stream


@dataclass(frozen=True, slots=True)
class Given:
    """The options, see `commands/stream.py`."""

    rig: Path | None
    zenoh: str | None
    zenoh_domain: int
    foxglove: list[str]
    mcap: list[str]
    replay: Path | None
    rate: str
    loop: int
    view: int | None
    tcp: int | None
    web: int | None
    zenoh_out: str | None
    record: Path | None
    checkpoint: Path | None
    prior: Path | None
    host: str
    allow_remote: bool
    token: str | None = field(repr=False)
    validation: Path | None
    json: Path | None


def serve(given: Given) -> None:
    """Runs until the input ends or a signal comes.

    Raises:
        SurecutError: an input or output cannot be opened, or the processes die again and again.
    """
    rig = _rig(given)
    sources, sinks = _sources(rig, given), _sinks(rig, given)
    if given.prior is not None and not given.prior.exists():
        raise SurecutError(f"{given.prior}: is not there; give the memory of an earlier run, or leave --prior out")
    stream = Stream(
        rig,
        sources,
        sinks,
        StreamSettings(),
        live=given.replay is None,
        prior=given.prior,
        checkpoint=given.checkpoint,
        validated=load_validated_range(given.validation),
    )
    for name in (signal.SIGINT, signal.SIGTERM):
        signal.signal(name, lambda *_: stream.stop())
    console = Console(stderr=True)
    for source in sources:
        console.print(f"in:  {source.name}")
    for sink in sinks:
        console.print(f"out: {sink.name}")
    stream.run()
    if given.json is not None:
        write_text(given.json, summary_json(stream))
    for line in summary_lines(stream):
        console.print(line)


def _rig(given: Given) -> Rig:
    if given.rig is not None:
        return load_rig(given.rig)
    if given.replay is None:
        raise typer.BadParameter("--rig is needed for live input")
    with LogReader(given.replay) as reader:
        text = reader.attachment("rig.yaml")
    if text is None:
        raise LogError(f"{given.replay}: carries no rig.yaml; give the rig file with --rig")
    return load_rig(text, f"{given.replay}: rig.yaml")


def _sources(rig: Rig, given: Given) -> list[Source]:
    sources: list[Source] = []
    expected = expected_bodies(rig)
    if given.zenoh is not None:
        from ...io.live.zenoh_source import ZenohSource  # loads a Rust runtime

        sources.append(ZenohSource(expected, given.zenoh, domain=given.zenoh_domain))
    sources += [FoxgloveClient(url, expected) for url in given.foxglove]
    sources += [McapStream(address, expected) for address in given.mcap]
    if given.replay is not None:
        if sources:
            raise typer.BadParameter("--replay stands alone: its time is not that of live input")
        sources.append(Replay(given.replay, _rate(given.rate), wanted_topics(rig), repeat=given.loop))
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


def _sinks(rig: Rig, given: Given) -> list[Sink]:
    access = Access(given.host, given.allow_remote, given.token)
    sinks: list[Sink] = []
    if given.view is not None:
        sinks.append(FoxgloveServer(access, given.view, picks_topic=rig.picks_topic))
    if given.tcp is not None:
        sinks.append(JsonServer(access, given.tcp))
    if given.record is not None:
        attachments = (("rig.yaml", "application/yaml", dump_rig(rig).encode()),)
        sinks.append(Recorder(given.record, attachments=attachments))
    if given.zenoh_out is not None:
        sinks.append(_zenoh_sink(given.zenoh_out, given.zenoh_domain))
    if given.web is not None:
        counted = [*sinks]
        sinks.append(WebServer(access, given.web, extra=lambda: _totals(counted)))
    return sinks


def _zenoh_sink(router: str, domain: int) -> Sink:
    from ...io.live.zenoh_sink import ZenohSink  # loads a Rust runtime

    return ZenohSink(router, domain=domain)


def _totals(sinks: list[Sink]) -> Mapping[str, int]:
    return {f"sink{i}_{name}": n for i, sink in enumerate(sinks) for name, n in sink.counters().items()}
