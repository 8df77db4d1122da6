"""Estimate live, from sensors or a replay, with the numbers of `optimise`; to viewers, robot and files."""

from pathlib import Path
from typing import Annotated

import typer

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
    from ..stream.forking import prepare

    prepare()  # before anything else is loaded
    from ..stream.service import Given, serve

    serve(
        Given(
            rig=rig,
            zenoh=zenoh,
            zenoh_domain=zenoh_domain,
            foxglove=foxglove or [],
            mcap=mcap or [],
            replay=replay,
            rate=rate,
            loop=loop,
            view=view,
            tcp=tcp,
            web=web,
            zenoh_out=zenoh_out,
            record=record,
            checkpoint=checkpoint,
            prior=prior,
            host=host,
            allow_remote=allow_remote,
            token=token,
            validation=validation,
            json=json,
        )
    )
