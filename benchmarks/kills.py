"""`kill -9` at random moments: is the recording readable, is the answer back, is it ever wrong?

    python benchmarks/kills.py run.mcap --kills 20

streams a recording in real time with checkpoint and recording, kills the process at random moments, starts it again,
and prints how long the points took to come back, how far they were from those before, and how much of the recording
is lost. Ends with status 1 when one of the limits does not hold.
"""

import argparse
import json
import random
import signal
import socket
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from surecut.io.reader import LogReader

BACK_S, LOST_S, SIGMAS = 5.0, 1.5, 3.0


@dataclass(frozen=True, slots=True)
class Kill:
    """One death and what came after."""

    back_s: float
    """From the restart to the first line with points."""
    off_sigma: float
    """Largest difference from the points before, in their sigmas."""
    lost_s: float
    """Recorded before the kill and not readable."""


def started(log: Path, memory: Path, record: Path, port: int) -> subprocess.Popen[bytes]:
    options = [
        "--replay",
        log,
        "--rate",
        "1",
        "--loop",
        "1000",
        "--tcp",
        port,
        "--checkpoint",
        memory,
        "--record",
        record,
    ]
    script = "from surecut.estimator.cli import main; main()"
    return subprocess.Popen(
        [sys.executable, "-c", script, "stream", *map(str, options)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )


def lines(port: int, seconds: float):  # noqa: ANN201
    """Updates as they come, for so long."""
    until = time.monotonic() + seconds
    while time.monotonic() < until:
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


def points_of(update: dict) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    return {
        p["id"]: (np.array(p["position_m"]), np.sqrt(np.diag(np.array(p["covariance_m2"])))) for p in update["points"]
    }


def free_port() -> int:
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        return s.getsockname()[1]


def difference(before: dict, after: dict) -> float:
    return max((float((np.abs(after[n][0] - p) / s).max()) for n, (p, s) in before.items() if n in after), default=0.0)


def recorded_until_ns(record: Path) -> int:
    with LogReader(record) as reader:
        return max((message.stamp_ns for message in reader), default=0)


def kills(log: Path, number: int, seed: int) -> list[Kill]:
    draw, found = random.Random(seed), []
    with tempfile.TemporaryDirectory() as folder:
        memory = Path(folder) / "memory.json"
        before: dict = {}
        for i in range(number + 1):
            port, record = free_port(), Path(folder) / f"{i}.mcap"
            process = started(log, memory, record, port)
            began, back, off, newest = time.monotonic(), float("nan"), 0.0, 0
            stop = None
            for update in lines(port, 120.0):
                points = points_of(update)
                newest = max(newest, update["stamp_ns"])
                if points and np.isnan(back):
                    back = time.monotonic() - began
                    off = difference(before, points)
                if stop is None and memory.exists() and points:
                    stop = time.monotonic() + draw.uniform(0.0, 8.0)
                if stop is not None and time.monotonic() > stop:
                    before = points
                    break
            process.send_signal(signal.SIGKILL)
            process.wait()
            if i:
                found.append(Kill(back, off, max(newest - recorded_until_ns(record), 0) * 1e-9))
                print(
                    f"{i:3d}: back after {back:.1f} s, {off:.2f} sigma off, {found[-1].lost_s:.2f} s lost", flush=True
                )
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("log", type=Path)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    found = kills(given.log, given.kills, given.seed)
    slowest, farthest, most = (max(getattr(k, n) for k in found) for n in ("back_s", "off_sigma", "lost_s"))
    print(f"slowest {slowest:.1f} s (limit {BACK_S}), farthest {farthest:.2f} sigma, most lost {most:.2f} s")
    raise SystemExit(0 if slowest <= BACK_S and farthest <= SIGMAS and most <= LOST_S else 1)


if __name__ == "__main__":
    main()
