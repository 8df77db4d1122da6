"""What a live link may bring, and what becomes of it: each kind is counted under its name and skipped, none is fatal.

Every case goes through the real decoders; after each a sound message still arrives.
"""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from live_bad_input import (
    CASES,
    CLOUD,
    IMAGE,
    INFO,
    LEFT,
    PICK,
    RIG,
    SECOND,
    START,
    ZIP,
    Case,
    channel,
    cloud,
    compressed,
    image,
    info,
    pick,
    picture_at,
)
from live_helpers import Collector

from surecut.io.live.admission import Limits
from surecut.io.live.definitions import same_fields
from surecut.io.live.expected import expected_bodies
from surecut.io.live.intake import Intake
from surecut.io.live.sniff import image_size
from surecut.io.schemas import schema


def take(intake: Intake, at: str, kind: str, data: bytes, encoding: str = "cdr", sender: str = "a") -> None:
    intake.take(channel(at, kind, encoding), data, sender, START)


@pytest.mark.parametrize("case", CASES, ids=[case.name for case in CASES])
def test_bad_input_is_counted_and_skipped(case: Case):
    intake, found = Intake(lambda: START, expected_bodies(RIG)), Collector()
    intake.open(found)
    for topic, kind, make in case.before:
        take(intake, topic, kind, make())
    assert len(found.messages) == len(case.before)
    take(intake, case.topic, case.type_name, case.data(), case.encoding, case.sender)
    assert len(found.messages) == len(case.before)
    counters = dict(intake.counters())
    assert counters.pop(case.expected) == 1
    assert counters == {"received": len(case.before) + 1, **({"delivered": len(case.before)} if case.before else {})}
    assert intake.by_topic()[case.expected] == {case.topic: 1}
    # the stream goes on
    take(intake, LEFT, IMAGE, image(2))
    take(intake, "/picks", PICK, pick())
    assert [message.topic for message in found.messages[-2:]] == [LEFT, "/picks"]


def test_the_schema_name_need_not_be_true():
    """A definition that is not the type's, and names that are none."""
    intake, found = Intake(lambda: START, expected_bodies(RIG)), Collector()
    intake.open(found)
    sound = channel("/picks", PICK)
    for bad in (
        replace(sound, schema_data=b"float64 u\nfloat64 v"),
        replace(sound, schema_data=schema(IMAGE).text.encode()),
        replace(sound, schema_data=b"\xff\xfe\x00" * 100),
        replace(sound, schema_data=b"# long\n" * 100_000),
        replace(sound, schema_encoding="ros2idl"),
    ):
        intake.take(bad, pick())
    assert intake.counters()["unknown_encoding"] + intake.counters().get("unknown_type", 0) == 5
    for name in (
        "",
        "PixelPick",
        "x/y/z/w",
        "surecut_msgs/msg/PixelPick'); import os #",
        "../../etc/passwd",
        "a" * 10_000,
    ):
        intake.take(replace(sound, schema_name=name), pick())
    assert intake.counters()["unknown_type"] >= 6
    intake.take(replace(sound, schema_name="surecut_msgs/PixelPick"), pick())
    intake.take(replace(sound, schema_data=b""), pick())
    assert len(found.messages) == 2


def test_definitions_are_compared_by_their_fields():
    text = schema(INFO).text
    assert same_fields(text, text.replace("std_msgs/Header header", "Header   header  # who and when"))
    assert same_fields(text, "# a comment\nuint8 CONSTANT=5\nuint8 OTHER = 6\n" + text)
    assert not same_fields(text, text.replace("uint32 height", "uint64 height"))
    assert not same_fields(text, text.replace("float64[9] k\n", ""))
    assert not same_fields(text, text.replace("int32 sec", "int64 sec"))


def test_a_clock_that_jumped_is_believed_after_a_while():
    intake, found = Intake(lambda: START, limits=Limits(stamp_confirmations=4)), Collector()
    intake.open(found)
    for number in range(5):
        take(intake, LEFT, IMAGE, image(number))
    for number in range(20):
        take(intake, LEFT, IMAGE, picture_at(START + 3600 * SECOND + number))
    counters = intake.counters()
    assert (counters["stamp_outlier"], counters["clock_jumps"], counters["delivered"]) == (3, 1, 5 + 16)


def test_a_click_in_an_old_image_and_a_calibration_of_long_ago_are_let_in():
    now = START + 60 * SECOND
    intake, found = Intake(lambda: now, expected_bodies(RIG)), Collector()
    intake.open(found)
    intake.take(channel("/picks", PICK), pick())
    for _ in range(3):
        intake.take(channel("/m/left/camera_info", INFO), info())
        now += 20 * SECOND
    assert [message.stamp_ns for message in found.messages] == [START, 0, 0, 0]


def test_an_image_in_two_forms_is_taken_once():
    now = START
    intake, found = Intake(lambda: now, expected_bodies(RIG)), Collector()
    intake.open(found)
    small = compressed(cv2.imencode(".png", np.zeros((48, 64), np.uint8))[1].tobytes())
    second = channel(LEFT + "/compressed", ZIP)
    intake.take(second, small)
    intake.take(channel(LEFT, IMAGE), image())
    intake.take(second, small)
    now += 3 * SECOND  # the other form has ended
    intake.take(second, small)
    assert [message.topic.endswith("/compressed") for message in found.messages] == [True, False, True]
    assert intake.counters()["redundant"] == 1


def test_scattered_stamps_are_never_believed():
    intake, found = Intake(lambda: START), Collector()
    intake.open(found)
    take(intake, LEFT, IMAGE, image())
    for number in range(40):
        take(intake, LEFT, IMAGE, picture_at(START + 100 * number * SECOND + 60 * SECOND))
    assert "clock_jumps" not in intake.counters()
    assert len(found.messages) == 1


def test_a_sender_who_is_silent_is_replaced():
    now = [START]
    intake, found = Intake(lambda: now[0]), Collector()
    intake.open(found)
    for at_s, sender in [(0, "a"), (1, "b"), (1.5, "a"), (3, "b"), (3.6, "b"), (3.7, "a")]:
        now[0] = START + int(at_s * SECOND)
        intake.take(channel(LEFT, IMAGE), picture_at(now[0]), sender)
    assert [(m.stamp_ns - START) / SECOND for m in found.messages] == [0, 1.5, 3.6]
    assert intake.counters()["other_publisher"] == 3


def test_a_receiver_that_fails_does_not_end_the_source():
    intake = Intake(lambda: START)

    def broken(_):
        raise RuntimeError("a defect")

    intake.open(broken)
    take(intake, LEFT, IMAGE, image())
    assert intake.counters() == {"received": 1, "undeliverable": 1}
    assert "a defect" in intake.last_problem()


def test_channels_of_strangers_cannot_fill_the_memory():
    intake, found = Intake(lambda: START, limits=Limits(channels=50)), Collector()
    intake.open(found)
    for number in range(200):
        take(intake, f"/t{number}", IMAGE, image())
    assert len(found.messages) == 50
    assert intake.counters()["ignored"] == 150
    take(intake, "/t" * 400, IMAGE, image())
    assert intake.counters()["oversized"] == 1


KINDS = [
    (LEFT, IMAGE, image()),
    ("/picks", PICK, pick()),
    ("/m/left/camera_info", INFO, info()),
    ("/b/points", CLOUD, cloud()),
]


@settings(max_examples=150, suppress_health_check=[HealthCheck.too_slow], deadline=None)
@given(
    st.sampled_from(KINDS),
    st.lists(st.tuples(st.integers(0, 1 << 20), st.integers(0, 255)), max_size=8),
    st.integers(0, 4000),
)
def test_any_bytes_are_survived(kind, flips, cut):
    topic, type_name, data = kind
    damaged = bytearray(data[: max(len(data) - cut, 0)] if cut % 2 else data)
    for at, value in flips:
        if damaged:
            damaged[at % len(damaged)] = value
    intake, found = Intake(lambda: START, expected_bodies(RIG)), Collector()
    intake.open(found)
    take(intake, topic, type_name, bytes(damaged))
    assert intake.counters()["received"] == 1
    assert "undeliverable" not in intake.counters()


@settings(max_examples=100, deadline=None)
@given(st.binary(max_size=300))
def test_any_start_of_an_image_is_survived(data):
    for start in (b"", b"\xff\xd8", b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff\xe0\x00\x10"):
        size = image_size(start + data)
        assert size is None or min(size) >= 0


@pytest.mark.parametrize(
    ("extension", "quality"), [(".png", []), (".jpg", []), (".jpg", [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])]
)
def test_the_size_of_a_picture_is_found(extension, quality):
    data = cv2.imencode(extension, np.zeros((37, 53, 3), np.uint8), quality)[1].tobytes()
    assert image_size(data) == (53, 37)
    assert image_size(data[:3]) is None


def test_a_thousand_malformed_messages_cost_less_than_a_second():
    """So that they can come every second."""
    import time

    intake, found = Intake(lambda: START, expected_bodies(RIG)), Collector()
    intake.open(found)
    bad = [(LEFT, IMAGE, image()[:-700]), ("/picks", PICK, pick(u=float("nan"))), (LEFT, IMAGE, b"")]
    begun = time.process_time()
    for number in range(1000):
        take(intake, *bad[number % 3])
    assert time.process_time() - begun < 1.0
    assert intake.counters()["malformed"] == 1000
