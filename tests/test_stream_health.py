"""What is wrong is named, within two seconds: cameras, clocks, topics, refusals, calibration, boards."""

from dataclasses import replace

import numpy as np
import pytest
from live_bad_input import CASES
from live_bad_input import RIG as CELL
from live_bad_input import START as CELL_START
from live_bad_input import channel as channel_of
from stream_messages import LEFT, MS, RIG, RIGHT, START, image

from surecut.estimator.result import CalibrationEstimate
from surecut.estimator.stream.health import Monitor
from surecut.estimator.stream.ordering import LiveOrder
from surecut.estimator.stream.settings import StreamSettings
from surecut.estimator.stream.track_process import TrackLoop
from surecut.estimator.stream.wire import Answer, Group, Tracked, Worked
from surecut.factors.measurements import Event
from surecut.io.live.expected import expected_bodies
from surecut.io.live.intake import Intake
from surecut.io.live.interfaces import HealthState
from surecut.io.messages import ImageBody
from surecut.io.pairing import StereoPair
from surecut.io.pixels import CompressedPixels

NAMED = ("size_changed", "calibration_changed", "other_publisher", "stamp_outlier", "malformed", "wrong_type")


def names(health):
    return {fault.name for fault in health.faults}


def fed(monitor, start_ms, stop_ms, value=lambda ms: ms, shift_ms=0):
    for ms in range(start_ms, stop_ms, 50):
        for topic in (LEFT, RIGHT):
            monitor.heard(image(topic, ms + shift_ms, value(ms), ms), START + ms * MS)


@pytest.fixture
def monitor():
    monitor = Monitor(RIG, StreamSettings())
    fed(monitor, 0, 2000)
    monitor.answered(Answer(START, START, {}))
    return monitor


def state(monitor, ms):
    return monitor.health(START + ms * MS, START + ms * MS)


def test_healthy(monitor):
    assert state(monitor, 2000).state is HealthState.OK


def test_frozen_camera_is_named_within_two_seconds(monitor):
    fed(monitor, 2000, 4000, value=lambda ms: 7)
    assert f"camera_frozen {LEFT}" in names(state(monitor, 4000))
    fed(monitor, 4000, 4500)
    assert not names(state(monitor, 4500))


def test_silent_topic_is_named_within_two_seconds(monitor):
    assert f"topic_missing {RIGHT}" in names(state(monitor, 3950))
    assert state(monitor, 3950).state is HealthState.FAILED


@pytest.mark.parametrize("seconds", [1.0, -30.0])
def test_clock_jump_is_named_within_two_seconds(monitor, seconds):
    fed(monitor, 2000, 4000, shift_ms=round(1e3 * seconds))
    assert f"clock_jump {LEFT}" in names(state(monitor, 4000))


def test_jitter_is_no_clock_jump(monitor):
    for i in range(60):
        ms = 2000 + 50 * i
        late = 800 if i % 5 else 0  # most messages come late, some do not
        monitor.heard(image(LEFT, ms, i, ms + late), START + (ms + late) * MS)
    assert not any(name.startswith("clock_jump") for name in names(state(monitor, 5000)))


def test_pairs_apart_and_knocks_are_named(monitor):
    order = LiveOrder(RIG, 100 * MS)
    for i in range(60):
        order.add(image(LEFT, 50 * i), START + 50 * i * MS)
        order.add(image(RIGHT, 50 * i + 20), START + (50 * i + 20) * MS)
    monitor.paired(order.unpaired)
    knock = Event(START + 1000 * MS, "board_knocked", "board f0 was knocked", "warning")
    monitor.answered(Answer(START, START, {}, events=(knock,)))
    fed(monitor, 2000, 2200)
    assert {"pair_apart", "board_knocked"} <= names(state(monitor, 2200))


@pytest.mark.parametrize("reason", NAMED)
def test_what_a_source_refuses_is_named_and_forgotten(reason):
    case = next(case for case in CASES if case.expected == reason)
    intake = Intake(lambda: CELL_START, expected_bodies(CELL))
    intake.open(lambda message: None)
    monitor = Monitor(CELL, StreamSettings())
    for topic, kind, make in case.before:
        intake.take(channel_of(topic, kind), make(), "a", CELL_START)
    monitor.counted(intake.by_topic(), CELL_START, "source")
    name = f"{reason} {case.topic}"
    assert name not in names(monitor.health(CELL_START, CELL_START))
    intake.take(channel_of(case.topic, case.type_name, case.encoding), case.data(), case.sender, CELL_START)
    monitor.counted(intake.by_topic(), CELL_START, "source")
    assert name in names(monitor.health(CELL_START, CELL_START))
    later = CELL_START + 2500 * MS
    monitor.counted(intake.by_topic(), later, "source")
    assert name not in names(monitor.health(later, later))


def test_two_sources_of_one_topic_are_counted_apart(monitor):
    monitor.counted({"malformed": {LEFT: 50}}, START, "one")
    state(monitor, 2000)
    now = START + 6000 * MS
    fed(monitor, 2000, 6000)
    monitor.counted({"malformed": {LEFT: 50}}, now, "one")
    assert f"malformed {LEFT}" not in names(state(monitor, 6000))
    monitor.counted({"malformed": {LEFT: 1}}, now, "other")
    assert f"malformed {LEFT}" in names(state(monitor, 6000))


def test_dropped_messages_are_named(monitor):
    monitor.counted({"dropped": {LEFT: 3}}, START + 1900 * MS, "stream")
    assert f"dropped {LEFT}" in names(state(monitor, 2000))


def test_calibration_drift_is_named_with_the_next_answer(monitor):
    row = CalibrationEstimate("m_left.fx", "px", 300.0, 0.1, 300.0, 1.0, False)
    monitor.answered(Answer(START, START, {}, calibration=(row,)))
    assert not names(state(monitor, 2000))
    monitor.answered(Answer(START, START, {}, calibration=(replace(row, value=305.0),)))
    assert names(state(monitor, 2000)) == {"calibration_drift m_left.fx"}
    assert state(monitor, 2000).state is HealthState.DEGRADED


def test_camera_that_has_not_found_itself_is_named(monitor):
    monitor.answered(Answer(START, None, {}))
    assert "relocalising" in names(state(monitor, 2000))


class Said(list):
    """A queue that keeps what it is given."""

    put = list.append

    def qsize(self):
        return 0


def test_images_that_cannot_be_decoded_are_counted_by_topic():
    """A compressed image is decoded where it is used: there it turns out to be none."""
    out, look = Said(), Said()
    loop = TrackLoop(RIG, StreamSettings(), False, look, out)
    whole, broken = image(LEFT, 0), image(RIGHT, 0)
    pixels = CompressedPixels("png", np.frombuffer(b"\x89PNG\r\n\x1a\n no more", np.uint8))
    broken = replace(broken, body=ImageBody(pixels, RIGHT))
    loop.take(Group([StereoPair(whole, broken)]))
    assert [said.unreadable for said in out if isinstance(said, Worked)] == [(RIGHT,)]
    assert not [handed for handed in look if isinstance(handed, Tracked)]
