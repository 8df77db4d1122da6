"""The recording: readable up to the last second after a kill, honest on a full disk, never overwriting."""

import errno
import os
import random
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from live_helpers import frozen_camera, live_image, update, wait_for

from surecut.factors.errors import LogError
from surecut.io.live.interfaces import HealthState
from surecut.io.live.recorder import Recorder
from surecut.io.messages import ImageBody, PointsBody, PoseBody
from surecut.io.reader import LogReader


def test_what_is_published_is_read_back(tmp_path: Path):
    path = tmp_path / "run.mcap"
    recorder = Recorder(path, images=True, attachments=(("rig.yaml", "application/yaml", b"version: 1"),))
    recorder.start()
    for number in range(5):
        recorder.publish(update(number, HealthState.DEGRADED, (frozen_camera(),)))
        recorder.image(live_image(number))
    recorder.stop()
    recorder.stop()
    with LogReader(path) as reader:
        assert reader.attachment("rig.yaml") == b"version: 1"
        messages = list(reader)
        assert reader.warnings == []
    last = {message.topic: message for message in messages}
    points = last["/estimate/points"]
    assert points.frame_id == "b"
    assert isinstance(points.body, PointsBody)
    assert points.body.ids == ("P1", "P2")
    assert points.body.points_m[0].tolist() == [0.1, 0.2, 5.5]
    assert points.body.covariances_m2 is not None
    assert np.diag(points.body.covariances_m2[0]).tolist() == [1e-6, 4e-6, 9e-6]
    pose = last["/estimate/pose_with_covariance/m"].body
    assert isinstance(pose, PoseBody)
    assert pose.covariance is not None
    assert "/estimate/pose_with_covariance/b" not in last
    image = last["/m/left/image_raw"].body
    assert isinstance(image, ImageBody)
    assert np.array_equal(image.pixels(), live_image(4).pixels)
    assert {"/tf", "/estimate/health", "/estimate/points_ellipsoids", "/estimate/points_cloud"} <= set(last)
    assert recorder.counters() == {"published": 5, "images": 5, "sent": 10}


WRITER = r"""
import sys, time
sys.path.insert(0, sys.argv[2])
from pathlib import Path
from live_helpers import live_image, update
from surecut.io.live.recorder import Recorder
recorder = Recorder(Path(sys.argv[1]), images=True, flush_s=0.25)
recorder.start()
number = 0
while True:
    recorder.publish(update(number))
    recorder.image(live_image(number))
    sys.stdout.write(f"{number} {time.time()}\n")  # one piece, whatever the buffering
    sys.stdout.flush()
    number += 1
    time.sleep(0.02)
"""


def killed_after(process: subprocess.Popen[str], seconds: float) -> str:
    """What the process had printed."""
    time.sleep(seconds)
    process.kill()
    process.wait(10)
    assert process.stdout is not None
    with process.stdout:
        return process.stdout.read()


def test_after_kill_9_all_but_the_last_second_is_there(tmp_path: Path):
    """Four processes, killed at random moments."""
    chance = random.Random(7)
    paths = [tmp_path / f"{number}.mcap" for number in range(4)]
    folder = str(Path(__file__).parent)
    processes = [
        subprocess.Popen([sys.executable, "-c", WRITER, str(path), folder], stdout=subprocess.PIPE, text=True)
        for path in paths
    ]
    try:
        for process in processes:
            assert process.stdout is not None
            for _ in range(80):  # however long that takes on a busy machine
                assert process.stdout.readline()
        said = [killed_after(process, chance.uniform(0.1, 0.7)) for process in processes]
    finally:
        for process in processes:
            process.kill()
            process.wait(10)
            if process.stdout is not None:
                process.stdout.close()
    for text, path in zip(said, paths, strict=True):
        written = [line.split() for line in text.splitlines()]
        assert written
        killed_at = float(written[-1][1])
        reader = LogReader(path)
        stamps = {m.stamp_ns for m in reader if m.topic == "/estimate/points"}
        assert len(reader.warnings) == 1
        for number, at in written:
            if float(at) < killed_at - 1.2:  # a quarter of a second, and a machine that is busy
                assert update(int(number)).stamp_ns in stamps
    assert len(stamps) > 50


class FullDisk:
    """Files that take `room` bytes in all, then none until there is room again."""

    def __init__(self, room: int) -> None:
        self.room = room

    def open(self, path: Path):
        disk = self
        file = path.open("xb", buffering=0)

        class Limited:
            fileno = file.fileno
            close = file.close

            def write(self, data) -> int:
                if disk.room <= 0:
                    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
                taken = min(len(data), disk.room)  # as a file system does: part of it fits
                disk.room -= taken
                return file.write(data[:taken])

        return Limited()


def test_a_full_disk_is_counted_and_recording_goes_on_when_there_is_room(tmp_path: Path, monkeypatch):
    monkeypatch.setattr("surecut.io.live.recorder._RETRY_S", 0.05)
    disk = FullDisk(30_000)
    path = tmp_path / "run.mcap"
    recorder = Recorder(path, images=True, flush_s=0.02, open_file=disk.open)
    recorder.start()
    number = 0

    def more() -> None:
        nonlocal number
        noise = np.random.default_rng(number).integers(0, 256, (50, 50), dtype=np.uint8)
        recorder.publish(update(number))
        recorder.image(type(live_image())("/i", number + 1, "m_left", noise))
        number += 1
        time.sleep(0.005)

    while not recorder.counters().get("dropped"):
        more()
    assert "No space left" in recorder.status()
    disk.room = 1 << 30
    wait_for(lambda: (more(), recorder.status().endswith("writing run-1.mcap"))[1])
    for _ in range(5):
        more()
    recorder.stop()
    for part in (path, tmp_path / "run-1.mcap"):
        reader = LogReader(part)
        assert sum(message.topic == "/estimate/points" for message in reader) > 0
        # the first part ends after a whole chunk
        assert all("corrupt" not in warning for warning in reader.warnings)
    counters = recorder.counters()
    assert counters["errors"] >= 1
    assert counters["sent"] + counters["dropped"] == counters["published"] + counters["images"]


def test_a_long_recording_is_ended_and_goes_on_in_the_next_part(tmp_path: Path):
    path = tmp_path / "run.mcap"
    rig = ("rig.yaml", "application/yaml", b"version: 1")
    recorder = Recorder(path, flush_s=0.02, part_s=0.1, attachments=(rig,))
    recorder.start()
    number = 0
    while not (tmp_path / "run-2.mcap").exists():
        recorder.publish(update(number))
        number += 1
        time.sleep(0.01)
    recorder.stop()
    found: list[int] = []
    for part in sorted(tmp_path.glob("*.mcap"), key=lambda p: (len(p.name), p.name)):
        with LogReader(part) as reader:
            assert reader.attachment("rig.yaml") == b"version: 1"
            found += [message.stamp_ns for message in reader if message.topic == "/estimate/points"]
            assert reader.warnings == []
    assert found == [update(n).stamp_ns for n in range(number)]
    assert recorder.counters() == {"published": number, "sent": number}


def test_nothing_is_overwritten(tmp_path: Path):
    path = tmp_path / "run.mcap"
    path.write_bytes(b"dear")
    for _ in range(2):
        recorder = Recorder(path)
        recorder.start()
        recorder.publish(update())
        recorder.stop()
    assert path.read_bytes() == b"dear"
    assert len(list(LogReader(tmp_path / "run-1.mcap"))) == len(list(LogReader(tmp_path / "run-2.mcap"))) > 0


def test_a_place_that_cannot_be_written_is_told_at_the_start(tmp_path: Path):
    with pytest.raises(LogError, match="cannot be created"):
        Recorder(tmp_path / "no" / "run.mcap").start()


def test_publishing_does_not_wait_for_the_disk(tmp_path: Path):
    class Slow(FullDisk):
        def open(self, path: Path):
            file = super().open(path)
            write = file.write
            file.write = lambda data: (time.sleep(0.2), write(data))[1]  # pyright: ignore
            return file

    recorder = Recorder(tmp_path / "run.mcap", flush_s=0.01, open_file=Slow(1 << 30).open)
    recorder.start()
    begun = time.monotonic()
    for number in range(2000):
        recorder.publish(update(number))
    assert time.monotonic() - begun < 10.0
    recorder.stop()
    assert recorder.counters()["dropped"] > 1000
