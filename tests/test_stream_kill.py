"""The real process killed while it looks at the pipe: it goes on in the same {o} before it sees a board again."""

import signal
import subprocess
import time

import numpy as np
import pytest
from spoilt_log import rewritten, unchanged
from stream_process import free_port, lines, started

from surecut.estimator.stream.memory import load
from surecut.simulation.campaign_pixels import truth_of_log
from surecut.simulation.evaluate import normalised_square, pose_error
from surecut.simulation.recording import simulate
from surecut.simulation.scenario import Scenario
from surecut.simulation.session import stamp_ns

pytestmark = pytest.mark.campaign

SCENE = {
    "name": "killed",
    "place": "B",
    "duration_s": 30,
    "mobile": {"rate_hz": 10},
    "kinect": {"rate_hz": 1, "width": 160, "height": 120, "depth_focal_px": 146.25, "rgb_focal_px": 131.25},
}
CHECKPOINT_S, BREAK_S, BOARD_S = 20.0, 0.3, 25.0
"""The process is killed at the first checkpoint after; so long nobody looks; until then no board comes into view."""
RATE = 0.5
"""Slow enough for a machine that has other work."""
UNSEEN_S = 8.0
"""More than that before the first the board was seen last."""
NEES95 = 12.59
"""Chi-square of six degrees of freedom."""


def killed(log, memory):
    """The first life; it ends when a checkpoint is late enough."""
    port, end = free_port(), time.monotonic() + 120
    options = "--replay", log, "--rate", RATE, "--tcp", port, "--checkpoint", memory
    process = started(*options, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        while time.monotonic() < end:
            time.sleep(0.2)
            if memory.exists() and load(memory).stamp_ns >= stamp_ns(CHECKPOINT_S):
                break
        process.send_signal(signal.SIGKILL)
        process.wait()
    finally:
        process.kill()
        process.communicate()
    return load(memory)


def poses(port, seconds, until_ns):
    """Poses of the camera that are told before a board is seen again, by stamp."""
    found = {}
    for update in lines(port, seconds):
        if update["stamp_ns"] >= until_ns:
            break
        seen_again = update["age_s"] is not None and update["age_s"] < UNSEEN_S
        if "m" in update["poses"] and not seen_again:
            pose = update["poses"]["m"]
            found[update["stamp_ns"]] = np.array(pose["matrix"]), np.array(pose["covariance"])
    return found


def test_camera_goes_on_in_the_same_origin_without_a_board(tmp_path):
    log, rest, memory = tmp_path / "whole.mcap", tmp_path / "rest.mcap", tmp_path / "memory.json"
    simulate(log, Scenario.model_validate(SCENE), 5)
    before = killed(log, memory)
    assert stamp_ns(CHECKPOINT_S) <= before.stamp_ns < stamp_ns(BOARD_S - 2.0)
    assert len(before.atlas.tracks) > 100
    begin_ns = before.stamp_ns + round(BREAK_S * 1e9)
    rewritten(log, rest, unchanged, begin_ns, stamp_ns(BOARD_S + 1.0))
    port = free_port()
    options = "--replay", rest, "--rate", RATE, "--tcp", port, "--checkpoint", memory
    process = started(*options, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        found = poses(port, 60, stamp_ns(BOARD_S))
    finally:
        process.kill()
        process.communicate()
    truth = truth_of_log(log)
    true = dict(zip(truth.stamps_ns, truth.o_T_m, strict=True))
    errors = {stamp: pose_error(matrix, true[stamp]) for stamp, (matrix, _) in found.items() if stamp in true}
    assert len(errors) > 10
    nees = np.array([normalised_square(error, found[stamp][1]) for stamp, error in errors.items()])
    assert (nees < NEES95).mean() > 0.9, np.round(nees, 1)
    off_m = [np.linalg.norm(error[:3]) for error in errors.values()]
    assert max(off_m) < 0.15  # a graph that is a second behind has not told yet that ways are too short
    assert min(off_m) < 0.02
