"""The real streaming process from outside: how it is started, and how its lines are read."""

import json
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any

SCRIPT = "from surecut.estimator.cli import main; main()"


def started(
    *options: object,
    stdout: int | None = None,
    stderr: int | None = None,
    preexec_fn: Callable[[], object] | None = None,
) -> "subprocess.Popen[bytes]":
    """`surecut stream` with these options; the rest as for `subprocess.Popen`."""
    command = [sys.executable, "-c", SCRIPT, "stream", *map(str, options)]
    return subprocess.Popen(command, stdout=stdout, stderr=stderr, preexec_fn=preexec_fn)


def free_port() -> int:
    """Of this machine."""
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return s.getsockname()[1]


def lines(port: int, seconds: float, process: "subprocess.Popen[bytes] | None" = None) -> Iterator[dict[str, Any]]:
    """Updates as they come, for so long; who ends or starts meanwhile is called again.

    Args:
        process: whose end is the end.
    """
    until = time.monotonic() + seconds
    while time.monotonic() < until and (process is None or process.poll() is None):
        try:
            with socket.create_connection(("127.0.0.1", port), timeout=1) as connection:
                connection.settimeout(2)
                with connection.makefile("rb") as file:
                    for line in file:
                        yield json.loads(line)
                        if time.monotonic() > until:
                            return
        except (OSError, json.JSONDecodeError):
            time.sleep(0.02)
