"""Does the stream stay as cheap as it began? A recording played again and again, as fast as it goes.

    python benchmarks/soak.py run.mcap --minutes 60 --wall 600

prints processor time per frame by tenths of the input and resident memory by process, and says whether the last tenth
costs at most 1.1 times the first and memory grows by less than 5 % after the first five minutes of input. Memory swings
by a tenth within a minute (copies of the process come and go, the allocator gives back late), so medians over five
minutes are compared. A second of processor time is not worth the same all the time where others use the computer too:
a piece of work that is always the same is timed beside, and costs are compared in units of it.
"""

import argparse
import contextlib
import json
import os
import shutil
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from surecut.estimator.items import wanted_topics
from surecut.estimator.optimise import rig_of
from surecut.estimator.stream.settings import StreamSettings
from surecut.estimator.stream.stream import Stream
from surecut.io.live.foxglove_server import FoxgloveServer
from surecut.io.live.json_server import JsonServer
from surecut.io.live.recorder import Recorder
from surecut.io.live.replay import Replay
from surecut.io.live.web_server import WebServer
from surecut.io.reader import LogReader

COST, MEMORY = 1.1, 1.05
WARM_UP_S = 300.0
MEDIAN_S = 300.0
TICKS = os.sysconf("SC_CLK_TCK")


@dataclass(frozen=True, slots=True)
class Sample:
    """One look at the four processes."""

    stamp_s: float
    """Of the input, since its start."""
    frames: int
    cpu_s: tuple[float, ...]
    """Of ordering and publishing, tracking, other front ends, graph."""
    rss_mb: tuple[float, ...]
    same_ms: float
    """Processor time of a piece of work that is always the same."""


class _Enough(Exception):
    """The run is long enough."""


def looked(stream: Stream, first_ns: int) -> Sample:
    pids = [os.getpid(), *stream.pids()]
    return Sample(
        (stream.stamp_ns() - first_ns) * 1e-9,
        stream.counts().get("frames", 0),
        tuple(cpu_s(pid) for pid in pids),
        tuple(rss_mb(pid) for pid in pids),
        same_work_ms(),
    )


def same_work_ms() -> float:
    """Half of it in Python, half in NumPy."""
    began, total = time.thread_time(), 0
    for i in range(40_000):
        total += i
    np.sort(np.random.default_rng(0).random(40_000))
    return 1e3 * (time.thread_time() - began)


def cpu_s(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / TICKS


def rss_mb(pid: int) -> float:
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def soak(log: Path, minutes: float, wall_s: float) -> list[Sample]:
    with LogReader(log) as reader:
        rig = rig_of(reader, None)
    source = Replay(log, None, wanted_topics(rig), repeat=10**6)
    folder = Path(tempfile.mkdtemp(prefix="surecut-soak-"))
    sinks = [FoxgloveServer(port=0), JsonServer(), WebServer(), Recorder(folder / "soak.mcap")]
    stream = Stream(rig, [source], sinks, StreamSettings(), live=False, checkpoint=folder / "memory.json")
    samples: list[Sample] = []
    began = time.monotonic()
    first: list[int] = []
    last = [0.0]
    problems = [""]

    def progress(_: Stream) -> None:
        if stream.last_problem != problems[0]:
            problems[0] = stream.last_problem
            print(problems[0], flush=True)
        if not stream.stamp_ns():
            return
        if not first:
            first.append(stream.stamp_ns())
        seconds = (stream.stamp_ns() - first[0]) * 1e-9
        if seconds - last[0] >= 2.0 or not samples:
            if int(seconds / 60) > int(last[0] / 60):
                print(f"{seconds / 60:.0f} min of input after {time.monotonic() - began:.0f} s", flush=True)
            last[0] = seconds
            samples.append(looked(stream, first[0]))
        if seconds >= 60 * minutes or time.monotonic() - began > wall_s:
            raise _Enough  # what still waits has been measured enough

    try:
        with contextlib.suppress(_Enough):
            stream.run(progress)
    finally:
        shutil.rmtree(folder)
    print(json.dumps({k: v for k, v in stream.counters().items() if not k.startswith("source")}))
    if stream.last_problem:
        print(stream.last_problem)
    return samples


def table(samples: list[Sample]) -> bool:
    """Prints cost by tenths and memory; whether both stay within their limits."""
    end = samples[-1].stamp_s
    print(f"{end / 60:.1f} minutes of input, {samples[-1].frames} frames")
    print("input min   cpu ms per frame: ordering  tracking  front ends  graph   same work   resident MB")
    costs, units = [], []
    for tenth in range(10):
        part = [s for s in samples if tenth * end / 10 <= s.stamp_s <= (tenth + 1) * end / 10]
        if len(part) < 2:
            continue  # less than a look at a time
        frames = max(part[-1].frames - part[0].frames, 1)
        cost = [1e3 * (b - a) / frames for a, b in zip(part[0].cpu_s, part[-1].cpu_s, strict=True)]
        costs.append(sum(cost))
        units.append(float(np.median([s.same_ms for s in part])))
        memory = " ".join(f"{m:.0f}" for m in np.median([s.rss_mb for s in part], axis=0))
        parts = f"{cost[0]:9.1f} {cost[1]:9.1f} {cost[2]:11.1f} {cost[3]:6.1f} {units[-1]:11.2f}"
        print(f"{part[-1].stamp_s / 60:9.1f} {sum(cost):18.1f} {parts}   {memory}")
    if not costs:
        print("too short to tell")
        return False
    seconds, ratio = costs[-1] / costs[0], costs[-1] / costs[0] * units[0] / units[-1]
    print(f"cost of the last tenth over the first: {ratio:.2f} (limit {COST}); in seconds {seconds:.2f}")
    if end < WARM_UP_S + 2 * MEDIAN_S:
        print("too short to tell how memory grows")
        return ratio <= COST
    memory = [(s.stamp_s, sum(s.rss_mb)) for s in samples]
    early = float(np.median([m for t, m in memory if WARM_UP_S <= t < WARM_UP_S + MEDIAN_S]))
    late = float(np.median([m for t, m in memory if t >= end - MEDIAN_S]))
    grown = late / early
    print(
        f"memory in the last five minutes {late:.0f} MB, in the second five {early:.0f}: {grown:.3f} (limit {MEMORY})"
    )
    return ratio <= COST and grown <= MEMORY


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("log", type=Path)
    parser.add_argument("--minutes", type=float, default=60.0, help="of input")
    parser.add_argument("--wall", type=float, default=float("inf"), help="seconds to run at most")
    given = parser.parse_args()
    raise SystemExit(0 if table(soak(given.log, given.minutes, given.wall)) else 1)


if __name__ == "__main__":
    main()
