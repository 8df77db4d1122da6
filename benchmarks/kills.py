"""`kill -9` at random moments: is the recording readable, is the answer back, is it ever wrong?

    python benchmarks/kills.py run.mcap --kills 20

streams a recording in real time with checkpoint and recording, kills the process at random moments, starts it again,
and prints how long the points took to come back, how far they were from those before, how far any answer was from the
truth (where the recording carries it), and how much of the recording is lost. Status 1 when a limit does not hold.
"""

import argparse
import random
import signal
import subprocess
import tempfile
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from stream_process import free_port, lines, started

from surecut.io.messages import PointsBody
from surecut.io.reader import LogReader

BACK_S, LOST_S, SIGMAS = 5.0, 1.5, 3.0
WRONG_SIGMAS = 5.0
"""By chi-square of three: an honest answer is farther off than this in one of 60 000 cases."""


@dataclass(frozen=True, slots=True)
class Kill:
    """One death and what came after."""

    back_s: float
    """From the restart to the first line with points."""
    off_sigma: float
    """Largest difference from the points before, in their sigmas."""
    lost_s: float
    """Recorded before the kill and not readable."""
    wrong_sigma: float
    """Largest Mahalanobis distance of any answer from the truth; 0 without truth."""
    go: int
    """Verdicts GO before a board had been seen again."""


@dataclass(slots=True)
class Life:
    """What one process said between its start and its death."""

    began: float
    back_s: float = float("nan")
    off_sigma: float = 0.0
    oldest_ns: int = 0
    """Stamp of the first line, which may tell what is remembered: of that nothing is recorded again."""
    newest_ns: int = 0
    wrong_sigma: float = 0.0
    go: int = 0
    points: dict = field(default_factory=dict)


def streaming(log: Path, memory: Path, record: Path, port: int) -> "subprocess.Popen[bytes]":
    options = ["--replay", log, "--rate", 1, "--loop", 1000, "--tcp", port, "--checkpoint", memory, "--record", record]
    return started(*options, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def points_of(update: dict) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    return {
        p["id"]: (np.array(p["position_m"]), np.sqrt(np.diag(np.array(p["covariance_m2"])))) for p in update["points"]
    }


def difference(before: dict, after: dict) -> float:
    """Of two answers' points in sigmas of the less certain answer: what was learned since the last checkpoint is lost,
    so that the later one knows less."""
    found = [
        float((np.abs(after[n][0] - p) / np.maximum(after[n][1], s)).max())
        for n, (p, s) in before.items()
        if n in after
    ]
    return max(found, default=0.0)


def true_points(log: Path) -> dict[str, np.ndarray]:
    """In {b}, where the recording carries them."""
    with LogReader(log) as reader:
        bodies = [message.body for message in reader if message.topic == "/truth/points"]
    found = bodies[-1] if bodies else None
    return dict(zip(found.ids, found.points_m, strict=True)) if isinstance(found, PointsBody) else {}


def farthest(update: dict, truth: dict[str, np.ndarray]) -> float:
    """Mahalanobis distance of an update's points from the truth."""
    found = [0.0]
    for point in update["points"]:
        if point["id"] in truth:
            off = np.array(point["position_m"]) - truth[point["id"]]
            found.append(float(np.sqrt(off @ np.linalg.solve(np.array(point["covariance_m2"]), off))))
    return max(found)


def recorded_until_ns(record: Path) -> int:
    with LogReader(record) as reader:
        return max((message.stamp_ns for message in reader), default=0)


def lived(port: int, memory: Path, truth: dict[str, np.ndarray], until_s: float, before: dict) -> "Life":
    """Follows one life until a moment after it has had points and a checkpoint for a while."""
    life = Life(began=time.monotonic())
    stop = None
    for update in lines(port, 120.0):
        points = points_of(update)
        life.oldest_ns = life.oldest_ns or update["stamp_ns"]
        life.newest_ns = max(life.newest_ns, update["stamp_ns"])
        life.wrong_sigma = max(life.wrong_sigma, farthest(update, truth))
        life.go += update["verdict"].startswith("GO") and stop is None and bool(before)
        if points and np.isnan(life.back_s):
            life.back_s = time.monotonic() - life.began
            life.off_sigma = difference(before, points)
        if stop is None and memory.exists() and points:
            stop = time.monotonic() + until_s
        if stop is not None and time.monotonic() > stop:
            life.points = points
            return life
    return life


def kills(log: Path, number: int, seed: int) -> list[Kill]:
    draw, found, truth = random.Random(seed), [], true_points(log)
    with tempfile.TemporaryDirectory() as folder:
        memory, before = Path(folder) / "memory.json", {}
        for i in range(number + 1):
            port, record = free_port(), Path(folder) / f"{i}.mcap"
            process = streaming(log, memory, record, port)
            try:
                life = lived(port, memory, truth, draw.uniform(0.0, 8.0), before)
            finally:
                process.send_signal(signal.SIGKILL)
                process.wait()
            before = life.points
            if not i:
                continue
            lost_s = max(life.newest_ns - max(recorded_until_ns(record), life.oldest_ns), 0) * 1e-9
            found.append(Kill(life.back_s, life.off_sigma, lost_s, life.wrong_sigma, life.go))
            print(
                f"{i:3d}: back after {life.back_s:.1f} s, {life.off_sigma:.2f} sigma off, {lost_s:.2f} s lost, "
                f"farthest answer {life.wrong_sigma:.1f} sigma from the truth",
                flush=True,
            )
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("log", type=Path)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    found = kills(given.log, given.kills, given.seed)
    back = sorted(k.back_s for k in found)
    slowest, off, most, wrong = (
        max(getattr(k, n) for k in found) for n in ("back_s", "off_sigma", "lost_s", "wrong_sigma")
    )
    print(
        f"{len(found)} kills: back after {back[len(back) // 2]:.1f} s (median), {slowest:.1f} s (slowest, limit "
        f"{BACK_S}); "
        f"at most {off:.2f} sigma from the points before, {wrong:.1f} sigma from the truth, {most:.2f} s lost, "
        f"{sum(k.go for k in found)} times GO before a board was seen"
    )
    good = slowest <= BACK_S and off <= SIGMAS and most <= LOST_S and wrong <= WRONG_SIGMAS
    raise SystemExit(0 if good and not any(k.go for k in found) else 1)


if __name__ == "__main__":
    main()
