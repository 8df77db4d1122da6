"""The real process names what is wrong within two seconds: a frozen camera, a clock that jumps, a stereo pair that is
knocked, and a board that is."""

import subprocess

import pytest
from spoilt_log import clock_set, frozen, rewritten, turned, unchanged
from stream_process import free_port, lines, started

from surecut.simulation.recording import simulate
from surecut.simulation.scenario import Scenario
from surecut.simulation.session import stamp_ns

pytestmark = pytest.mark.campaign

SCENE = {
    "name": "faults",
    "place": "B",
    "duration_s": 16,
    "return_to_board": False,
    "mobile": {"rate_hz": 10},
    "kinect": {"rate_hz": 1, "width": 160, "height": 120, "depth_focal_px": 146.25, "rgb_focal_px": 131.25},
}
LEFT, RIGHT, SIZE = "/m/left/image_raw", "/m/right/image_raw", (240, 360)
AT_S, END_S = 7.0, 10.0
IN_VIEW_S, OUT_OF_VIEW_S, BACK_S = 2.0, 3.0, 12.9
"""A knock while the camera sees the board; one while the panel hides it, and when the camera sees it again."""
WITHIN_S = 2.0


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("faults")
    scenes = {
        "sound": SCENE,
        "in_view": SCENE | {"duration_s": 24, "board": {"knock": {"at_s": IN_VIEW_S}}},
        "out_of_view": SCENE | {"board": {"knock": {"at_s": OUT_OF_VIEW_S}}},
    }
    for name, scene in scenes.items():
        simulate(folder / f"{name}.mcap", Scenario.model_validate(scene), 3)
    return folder


def named(log):
    """When each fault was named first, in seconds of receipt since the start: the process is shown the time by it."""
    port, found = free_port(), {}
    process = started("--replay", log, "--rate", 1, "--tcp", port, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        for update in lines(port, 90, process):
            for fault in update["health"]["faults"]:
                found.setdefault(fault["name"], (fault["since_ns"] - stamp_ns(0.0)) * 1e-9)
    finally:
        process.kill()
        process.communicate()
    return found


@pytest.mark.parametrize(
    ("change", "faults"),
    [
        (frozen(LEFT, stamp_ns(AT_S)), {f"camera_frozen {LEFT}"}),
        (clock_set("/m/", stamp_ns(AT_S), 1_000_000_000), {f"clock_jump {LEFT}", f"clock_jump {RIGHT}"}),
        (clock_set("/m/", stamp_ns(AT_S), -30_000_000_000), {f"clock_jump {LEFT}", f"clock_jump {RIGHT}"}),
        (turned(RIGHT, stamp_ns(AT_S), 1, SIZE), {"calibration_drift"}),
        (turned(RIGHT, stamp_ns(AT_S), -5, SIZE), {"calibration_drift"}),
    ],
    ids=["frozen", "clock ahead", "clock back", "pair a little", "pair much"],
)
def test_fault_is_named_within_two_seconds(logs, change, faults, tmp_path):
    spoilt = tmp_path / "spoilt.mcap"
    rewritten(logs / "sound.mcap", spoilt, change, end_ns=stamp_ns(END_S))
    found = named(spoilt)
    for fault in faults:
        assert AT_S <= found[fault] < AT_S + WITHIN_S, found
    assert all(since_s >= AT_S for since_s in found.values()), found  # nothing before


@pytest.mark.parametrize(("log", "seen_s"), [("in_view", IN_VIEW_S), ("out_of_view", BACK_S)])
def test_knocked_board_is_named_within_two_seconds_of_view(logs, log, seen_s):
    found = named(logs / f"{log}.mcap")
    assert seen_s < found["board_knocked"] < seen_s + WITHIN_S, found


def test_sound_recording_is_not_suspected(logs, tmp_path):
    part = tmp_path / "part.mcap"
    rewritten(logs / "sound.mcap", part, unchanged, end_ns=stamp_ns(END_S))
    assert not named(part)
