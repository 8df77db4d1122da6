"""What an operator can ask the real process for: pick, freeze, save, reset, as services of the Foxglove server."""

import subprocess
import time
import urllib.request
from pathlib import Path

import numpy as np
import pytest
from live_foxglove import Viewer
from stream_process import free_port, lines, started

from surecut.estimator.stream.memory import load
from surecut.io.messages import PickBody
from surecut.io.reader import LogReader

pytestmark = pytest.mark.campaign
SAMPLE = Path(__file__).parents[1] / "logs" / "sample.mcap"


def until(port, wanted, seconds=40.0):
    """The first line that is as wanted."""
    for update in lines(port, seconds):
        if wanted(update):
            return update
    raise AssertionError(f"no such line within {seconds} s")


def named(update):
    return {point["id"]: np.array(point["position_m"]) for point in update["points"]}


def events(web):
    """Counters by name, from the metrics page."""
    text = urllib.request.urlopen(f"http://127.0.0.1:{web}/metrics", timeout=5).read().decode()
    rows = [line for line in text.splitlines() if line.startswith("surecut_events_total")]
    return {row.split('"')[1]: float(row.rsplit(" ", 1)[1]) for row in rows}


def counted(web, name, seconds=20.0):
    """Waits until something has been counted."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if events(web).get(name, 0) > 0:
            return
        time.sleep(0.2)
    raise AssertionError(f"{name} was not counted within {seconds} s")


def clicks():
    """The recorded clicks on P1, as an operator would make them, by another name."""
    with LogReader(SAMPLE) as reader:
        picks = [m for m in reader if isinstance(m.body, PickBody) and m.body.point_id == "P1"]
    return [
        {"camera": m.body.camera, "point_id": "X1", "role": "cut", "u": m.body.px[0], "v": m.body.px[1],
         "stamp_ns": m.stamp_ns, "sigma_px": 1.0}
        for m in picks
    ]  # fmt: skip


def test_services_of_the_running_process(tmp_path):
    tcp, web, view = free_port(), free_port(), free_port()
    memory = tmp_path / "memory.json"
    process = started(
        "--replay", SAMPLE, "--rate", 1, "--loop", 20, "--tcp", tcp, "--web", web, "--view", view,
        "--checkpoint", memory, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    try:
        until(tcp, lambda update: {"P1", "P2"} <= named(update).keys() and "m" in update["poses"])
        with Viewer(view) as viewer:
            while not viewer.of("advertiseServices"):
                time.sleep(0.05)
            service = {s["name"]: s["id"] for s in viewer.of("advertiseServices")[0]["services"]}
            asked = 0

            def ask(name, value):
                nonlocal asked
                asked += 1
                viewer.call(service[f"/surecut/{name}"], value, asked)
                end = time.monotonic() + 10
                while len(viewer.replies) < asked and time.monotonic() < end:
                    time.sleep(0.02)
                assert viewer.replies[-1][2]["accepted"], viewer.replies[-1]

            for click in clicks()[:2]:  # in pictures of some seconds ago
                ask("pick", click)
            found = named(until(tcp, lambda update: "X1" in named(update)))
            assert np.linalg.norm(found["X1"] - found["P1"]) < 0.03
            ask("freeze", {"frozen": True})
            counted(web, "freeze_done")
            ask("save", {})
            counted(web, "save_done")
            assert "X1" in {point["name"] for point in load(memory).points}
            ask("freeze", {"frozen": False})
            counted(web, "release_done")
            ask("reset", {})
            counted(web, "reset_done")
            until(tcp, lambda update: "X1" not in named(update))
            again = until(tcp, lambda update: "m" in update["poses"] and "b" in update["poses"])
            assert "X1" not in named(again)
            ask("pick", {**clicks()[0], "point_id": "X2", "stamp_ns": 1})  # a picture of long ago
            counted(web, "pick_failed")
    finally:
        process.kill()
        process.communicate()
