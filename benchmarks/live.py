"""How late is the pose, and does it go on when everything else goes wrong? The real process, looked at from outside.

    python benchmarks/live.py run.mcap --seconds 60
    python benchmarks/live.py run.mcap --seconds 60 --faults

sends a recording over TCP as a robot would, in real time, with all outputs on, and measures from the last byte of a
stereo pair to the JSON line that has the camera's pose at its stamp. With --faults there are also a viewer that
does not read, a robot link that is dead, a recording that the disk has no room for, and a second sender with a
thousand malformed messages a second. Status 1 when a limit does not hold.
"""

import argparse
import json
import resource
import socket
import struct
import subprocess
import tempfile
import threading
import time
import urllib.request
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from mcap.writer import Writer
from stream_process import free_port, lines, started
from websockets.sync.client import connect

from surecut.estimator.items import wanted_topics
from surecut.estimator.optimise import rig_of
from surecut.factors.rig import Rig, dump_rig
from surecut.io.decode import ChannelInfo
from surecut.io.reader import LogReader

P50_MS, P99_MS, WORST_MS = 20.0, 50.0, 150.0
ANSWERS_PER_S = 2.0
WARM_UP_S = 12.0
"""Left out: imports, first frames, the first view of the board."""
DISK_BYTES = 256 << 10
FLOOD_HZ = 1000


@dataclass(slots=True)
class Seen:
    """What passed outside the process."""

    sent: dict[int, float] = field(default_factory=dict)
    """Stamp of a pair to the moment at which its later image was sent."""
    came: dict[int, float] = field(default_factory=dict)
    """Stamp to the first line with the camera's pose at it."""
    answers: list[float] = field(default_factory=list)
    """When a line had points, with their joint covariance, of more measurements than the one before."""
    moved: list[float] = field(default_factory=list)
    """When a line had other points than the one before."""
    behind_s: list[float] = field(default_factory=list)
    """At each line with points: the time of the line's pose less that of the newest measurement in the points."""
    faults: set[str] = field(default_factory=set)


def serve_once(send: "Sender") -> int:
    """Listens for one receiver, which gets everything that is sent; the port."""
    server = socket.create_server(("127.0.0.1", 0))

    def run() -> None:
        connection, _ = server.accept()
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        send.to(connection)

    threading.Thread(target=run, daemon=True).start()
    return server.getsockname()[1]


class Sender:
    """A recording in real time, again and again, under stamps that go on."""

    def __init__(self, log: Path, rig: Rig, seen: Seen, stop: threading.Event, depths: int = 1) -> None:
        """
        Args:
            depths: how often each depth image is sent, under stamps evenly between its own and the next one's.
        """
        self._log, self._rig, self._seen, self._stop = log, rig, seen, stop
        self._images = {rig.cameras.m_left.image_topic, rig.cameras.m_right.image_topic}
        self._depths = depths

    def entries(self) -> Iterator[tuple[ChannelInfo, int, bytes]]:
        """With times and stamps shifted to now."""
        shift, wanted, left = 0, wanted_topics(self._rig), self._rig.cameras.m_left.image_topic
        while True:
            first = last = before = 0
            with LogReader(self._log) as reader:
                for channel, at_ns, data in reader.raw():
                    if channel.topic in wanted:
                        first = first or at_ns
                        shift = shift or time.time_ns() - at_ns
                        if channel.topic == left:
                            before, last = last, at_ns
                        yield channel, at_ns + shift, restamped(bytes(data), shift)
            shift += last + max(last - before, 0) - first  # the next picture comes when it would

    def with_more_depth(self) -> Iterator[tuple[ChannelInfo, int, bytes]]:
        """The entries, and depth images again."""
        topic, period_ns = self._rig.cameras.b_depth.image_topic, depth_period_ns(self._log, self._rig)
        waiting: list[tuple[int, ChannelInfo, bytes]] = []
        for channel, at_ns, data in self.entries():
            while waiting and waiting[0][0] <= at_ns:
                due_ns, kind, again = waiting.pop(0)
                yield kind, due_ns, again
            yield channel, at_ns, data
            if channel.topic == topic:
                for number in range(1, self._depths):
                    later_ns = number * period_ns // self._depths
                    waiting.append((at_ns + later_ns, channel, restamped(data, later_ns)))

    def to(self, connection: socket.socket) -> None:
        out = connection.makefile("wb")
        writer = Writer(out, use_chunking=False)
        writer.start()
        channels: dict[ChannelInfo, int] = {}
        for channel, at_ns, data in self.with_more_depth():
            if self._stop.is_set():
                return
            if channel not in channels:
                schema = writer.register_schema(channel.schema_name, channel.schema_encoding, channel.schema_data)
                channels[channel] = writer.register_channel(channel.topic, channel.message_encoding, schema)
            time.sleep(max(0.0, (at_ns - time.time_ns()) * 1e-9))
            try:
                writer.add_message(channels[channel], at_ns, data, at_ns)
                out.flush()
            except OSError:
                return
            if channel.topic in self._images:
                self._seen.sent[stamp_of(data)] = time.monotonic()


def depth_period_ns(log: Path, rig: Rig) -> int:
    """Of a recording's depth images; 0 where there are no two."""
    with LogReader(log) as reader:
        times = [at_ns for channel, at_ns, _ in reader.raw() if channel.topic == rig.cameras.b_depth.image_topic]
    return int(np.median(np.diff(times))) if len(times) > 1 else 0


class Flood(Sender):
    """A thousand malformed messages a second."""

    def entries(self) -> Iterator[tuple[ChannelInfo, int, bytes]]:
        rng = np.random.default_rng(1)
        kinds = {
            c.topic: (c, bytes(d)) for c, _, d in LogReader(self._log).raw() if c.topic in wanted_topics(self._rig)
        }
        began = time.time_ns()
        for number in range(10**9):
            channel, data = kinds[sorted(kinds)[number % len(kinds)]]
            cut = data[:4] + rng.bytes(int(rng.integers(9, 3000)))
            yield channel, began + number * 1_000_000_000 // FLOOD_HZ, cut


def restamped(data: bytes, shift_ns: int) -> bytes:
    """A CDR message that begins with a header, at another time."""
    sec, nanosec = struct.unpack_from("<iI", data, 4)
    if not sec:
        return data
    total = sec * 1_000_000_000 + nanosec + shift_ns
    return data[:4] + struct.pack("<iI", total // 1_000_000_000, total % 1_000_000_000) + data[12:]


def stamp_of(data: bytes) -> int:
    sec, nanosec = struct.unpack_from("<iI", data, 4)
    return sec * 1_000_000_000 + nanosec


def follow(port: int, seen: Seen, stop: threading.Event) -> None:
    """Reads the lines as an inverse kinematics program does."""
    told, newest_ns = "", 0
    while not stop.is_set():
        for update in lines(port, 1e6):
            now = time.monotonic()
            if "m" in update["poses"]:
                seen.came.setdefault(update["stamp_ns"], now)
            places = json.dumps([p["position_m"] for p in update["points"]])
            if update["points"] and update["points_covariance_m2"] is not None:
                if update["points_stamp_ns"] > newest_ns:
                    seen.answers.append(now)
                if places != told:
                    seen.moved.append(now)
                newest_ns = update["points_stamp_ns"]
                seen.behind_s.append(1e-9 * (update["stamp_ns"] - newest_ns))
            told = places
            seen.faults |= {fault["name"] for fault in update["health"]["faults"]}
            if stop.is_set():
                return


def stalled_viewer(port: int, stop: threading.Event) -> None:
    """Subscribes to everything and reads nothing more."""
    with connect(f"ws://127.0.0.1:{port}", subprotocols=["foxglove.sdk.v1"], max_queue=1, ping_interval=None) as viewer:  # type: ignore[list-item]
        time.sleep(5.0)
        wanted = [{"id": n, "channelId": n} for n in range(1, 20)]
        viewer.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))
        stop.wait()


def small_disk() -> None:
    """As if there were no more room."""
    resource.setrlimit(resource.RLIMIT_FSIZE, (DISK_BYTES, DISK_BYTES))


def measured(log: Path, seconds: float, faults: bool, kinect_hz: float) -> tuple[Seen, dict[str, float]]:
    with LogReader(log) as reader:
        rig = rig_of(reader, None)
    seen, stop = Seen(), threading.Event()
    tcp, web, view = free_port(), free_port(), free_port()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "rig.yaml").write_text(dump_rig(rig))
        depths = max(1, round(kinect_hz * 1e-9 * depth_period_ns(log, rig)))
        port = serve_once(Sender(log, rig, seen, stop, depths))
        options = ["--rig", folder / "rig.yaml", "--mcap", f"tcp://127.0.0.1:{port}", "--tcp", tcp, "--web", web]
        options += ["--view", view, "--record", folder / "r.mcap", "--checkpoint", folder / "memory.json"]
        if faults:
            flood = serve_once(Flood(log, rig, Seen(), stop))
            options += ["--mcap", f"tcp://127.0.0.1:{flood}", "--zenoh-out", f"tcp/127.0.0.1:{free_port()}"]
        process = started(*options, stderr=subprocess.DEVNULL, preexec_fn=small_disk if faults else None)
        try:
            threading.Thread(target=follow, args=(tcp, seen, stop), daemon=True).start()
            while not seen.came:
                time.sleep(0.1)
                if process.poll() is not None:
                    raise SystemExit("the stream has ended")
            if faults:
                threading.Thread(target=stalled_viewer, args=(view, stop), daemon=True).start()
            time.sleep(seconds + WARM_UP_S)
            text = urllib.request.urlopen(f"http://127.0.0.1:{web}/metrics", timeout=5).read().decode()
        finally:
            stop.set()
            process.kill()
            process.wait()
    lines = [line for line in text.splitlines() if line.startswith("surecut_events_total")]
    return seen, {line.split('"')[1]: float(line.rsplit(" ", 1)[1]) for line in lines}


def told(seen: Seen, counters: dict[str, float]) -> bool:
    """Prints the figures; whether they are within their limits."""
    begin = min(seen.came.values()) + WARM_UP_S
    end = max(seen.came.values())
    pairs = [s for s, at in seen.sent.items() if begin <= at <= end - 0.5]
    late = np.array([1e3 * (seen.came[s] - seen.sent[s]) for s in pairs if s in seen.came])
    p50, p99, worst = np.percentile(late, 50), np.percentile(late, 99), late.max()
    answers = [at for at in seen.answers if at >= begin]
    rate = len(answers) / max(end - max(begin, min(answers, default=begin)), 1e-9)
    moved = [at for at in seen.moved if at >= begin]
    print(
        f"{len(late)} of {len(pairs)} pairs have a pose; last byte to line: "
        f"p50 {p50:.1f} ms, p99 {p99:.1f}, worst {worst:.1f}"
    )
    print(
        f"points in b with their joint covariance {rate:.2f} times a second, longest gap {gap(answers):.2f} s "
        f"({len(moved)} of {len(answers)} with measurements that changed them, the others say that nothing has)"
    )
    if seen.behind_s:
        print(
            f"newest measurement in the points behind the pose: median {np.median(seen.behind_s):.2f} s, "
            f"longest {max(seen.behind_s):.2f}"
        )
    print("faults named:", ", ".join(sorted(seen.faults)) or "none")
    kept = ("drop", "malformed", "error", "lost", "wrong_type", "left_out", "restarts", "late", "outlier", "refused")
    print({k: int(v) for k, v in sorted(counters.items()) if v and any(word in k for word in kept)})
    whole = len(late) >= 0.995 * len(pairs)
    return whole and p50 <= P50_MS and p99 <= P99_MS and worst <= WORST_MS and rate >= ANSWERS_PER_S


def gap(times: list[float]) -> float:
    return float(np.diff(times).max()) if len(times) > 1 else float("nan")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("log", type=Path)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--faults", action="store_true")
    parser.add_argument("--kinect-hz", type=float, default=10.0, help="depth images are repeated until so many come")
    given = parser.parse_args()
    raise SystemExit(0 if told(*measured(given.log, given.seconds, given.faults, given.kinect_hz)) else 1)


if __name__ == "__main__":
    main()
