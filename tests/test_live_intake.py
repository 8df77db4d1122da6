"""What a live link may bring, and what becomes of it: each kind is counted under its name and skipped, none is fatal.

Every case goes through the real decoders; after each a sound message still arrives.
"""

import base64
import json
import struct
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import cv2
import logmaker
import numpy as np
import pytest
import zstandard
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.timestamp_pb2 import Timestamp
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from live_helpers import Collector

from surecut.factors.rig import Rig
from surecut.io import build, build_views
from surecut.io.decode import ChannelInfo
from surecut.io.live.admission import Limits
from surecut.io.live.definitions import same_fields
from surecut.io.live.expected import expected_bodies
from surecut.io.live.intake import Intake
from surecut.io.live.sniff import image_size
from surecut.io.schemas import schema, typestore

SECOND = 1_000_000_000
START = logmaker.START_NS
IMAGE, INFO, PICK = "sensor_msgs/msg/Image", "sensor_msgs/msg/CameraInfo", "surecut_msgs/msg/PixelPick"
ZIP, CLOUD, TAGS = (
    "sensor_msgs/msg/CompressedImage",
    "sensor_msgs/msg/PointCloud2",
    "apriltag_msgs/msg/AprilTagDetectionArray",
)
LEFT, DEPTH = "/m/left/image_raw", "/b/depth/image_raw"
RIG = Rig.model_validate(
    {
        "version": 1,
        "boards": [{"id": "f0", "markers": [{"id": 7, "centre_m": [0, 0]}]}],
        "mount": {"board": "f0", "f_T_b": {}},
    }
)


def channel(topic: str, type_name: str, encoding: str = "cdr") -> ChannelInfo:
    if encoding == "cdr":
        return ChannelInfo(topic, "cdr", type_name, "ros2msg", schema(type_name).text.encode())
    return ChannelInfo(
        topic, encoding, type_name, {"protobuf": "protobuf", "json": "jsonschema"}.get(encoding, ""), b""
    )


def cdr(type_name: str, message: Any) -> bytes:
    return bytes(typestore().serialize_cdr(message, type_name))


def image(number: int = 0, **changes: Any) -> bytes:
    message = build.image(START + number * SECOND // 20, "m_left", logmaker.picture(number), "mono8")
    for name, value in changes.items():
        setattr(message, name, value)
    return cdr(IMAGE, message)


def info(**changes: Any) -> bytes:
    return cdr(INFO, build.camera_info(START, "m_left", replace(logmaker.LEFT, **changes)))


def pick(**changes: Any) -> bytes:
    message = build.pixel_pick(START, "m_left", "P1", "cut", (3.0, 4.0), 1.0)
    for name, value in changes.items():
        setattr(message, name, value)
    return cdr(PICK, message)


def picture_at(stamp_ns: int) -> bytes:
    return cdr(IMAGE, build.image(stamp_ns, "m_left", logmaker.picture(0), "mono8"))


def compressed(data: bytes, format_: str = "png") -> bytes:
    return cdr(ZIP, build.compressed_image(START, "m_left", data, format_))


def tags(corners: Any) -> bytes:
    return cdr(TAGS, build.marker_detections(START, "m_left", "tag36h11", {7: corners}))


def png(width: int, height: int) -> bytes:
    """A sound picture whose header lies about its size."""
    data = bytearray(cv2.imencode(".png", np.zeros((4, 4), np.uint8))[1].tobytes())
    data[16:24] = struct.pack(">II", width, height)
    return bytes(data)


def proto_image(**changes: Any) -> bytes:
    fields = {
        "frame_id": "m_left",
        "width": 4,
        "height": 2,
        "encoding": "mono8",
        "step": 4,
        "data": bytes(8),
        **changes,
    }
    message = RawImage(**fields)
    message.timestamp.CopyFrom(Timestamp(seconds=START // SECOND))
    return message.SerializeToString()


def cloud() -> bytes:
    points = {axis: np.zeros(3, np.float32) for axis in "xyz"}
    message = build_views.point_cloud2(START, "b", points)
    message.width = 1000
    return cdr(CLOUD, message)


def with_length(data: bytes, at: int, length: int) -> bytes:
    return data[:at] + struct.pack("<I", length) + data[at + 4 :]


@dataclass(frozen=True)
class Case:
    name: str
    expected: str
    topic: str
    type_name: str
    data: Callable[[], bytes]
    encoding: str = "cdr"
    before: tuple[tuple[str, str, Callable[[], bytes]], ...] = field(default=())
    sender: str = "a"


GOOD_INFO = ("/m/left/camera_info", INFO, info)
GOOD_IMAGE = (LEFT, IMAGE, image)
CASES = [
    Case("another type on the topic", "wrong_type", LEFT, INFO, info),
    Case(
        "depth on a picture's topic",
        "wrong_type",
        LEFT,
        IMAGE,
        lambda: cdr(IMAGE, build.depth_image(START, "b", np.ones((4, 4)))),
    ),
    Case("a picture on a topic of depth", "wrong_type", DEPTH, IMAGE, image),
    Case(
        "size changes in mid-stream",
        "size_changed",
        LEFT,
        IMAGE,
        lambda: cdr(IMAGE, build.image(START, "m_left", np.zeros((24, 32), np.uint8), "mono8")),
        before=(GOOD_IMAGE,),
    ),
    Case(
        "calibration changes",
        "calibration_changed",
        "/m/left/camera_info",
        INFO,
        lambda: info(K=logmaker.K * np.array([[1.01], [1.01], [1]])),
        before=(GOOD_INFO,),
    ),
    Case(
        "calibration for another size",
        "calibration_changed",
        "/m/left/camera_info",
        INFO,
        lambda: info(width=128),
        before=(GOOD_INFO,),
    ),
    Case("two publishers", "other_publisher", LEFT, IMAGE, lambda: image(1), before=(GOOD_IMAGE,), sender="b"),
    Case(
        "a stamp from the future",
        "stamp_outlier",
        LEFT,
        IMAGE,
        lambda: picture_at(START + 3600 * SECOND),
        before=(GOOD_IMAGE,),
    ),
    Case("a stamp from long ago", "stamp_outlier", LEFT, IMAGE, lambda: picture_at(1), before=(GOOD_IMAGE,)),
    Case("a stamp of zero", "unstamped", LEFT, IMAGE, lambda: picture_at(0)),
    Case("a negative stamp", "unstamped", LEFT, IMAGE, lambda: picture_at(-5 * SECOND)),
    Case("NaN in a pick", "malformed", "/picks", PICK, lambda: pick(u=float("nan"))),
    Case("infinite pick", "malformed", "/picks", PICK, lambda: pick(v=float("inf"))),
    Case("negative sigma", "malformed", "/picks", PICK, lambda: pick(sigma_px=-1.0)),
    Case("NaN in a calibration", "malformed", "/m/left/camera_info", INFO, lambda: info(K=logmaker.K * np.nan)),
    Case("a calibration of zeros", "malformed", "/m/left/camera_info", INFO, lambda: info(K=np.zeros((3, 3)))),
    Case(
        "NaN in marker corners",
        "not_finite",
        "/m/left/markers",
        TAGS,
        lambda: tags([[np.nan, 1], [2, 1], [2, 2], [1, 2]]),
    ),
    Case("empty", "malformed", LEFT, IMAGE, lambda: b""),
    Case("header alone", "malformed", LEFT, IMAGE, lambda: b"\x00\x01\x00\x00"),
    Case("100 MB", "oversized", LEFT, IMAGE, lambda: bytes(100 << 20)),
    Case("bad CDR header", "malformed", LEFT, IMAGE, lambda: b"\x07\x07\x00\x00" + image()[4:]),
    Case("truncated CDR", "malformed", LEFT, IMAGE, lambda: image()[:-700]),
    Case("bytes behind the message", "malformed", LEFT, IMAGE, lambda: image() + bytes(64)),
    Case(
        "huge array length in CDR",
        "malformed",
        LEFT,
        IMAGE,
        lambda: with_length(image(), len(image()) - 48 * 64 - 4, 0xFFFFFFF0),
    ),
    Case("huge string length in CDR", "malformed", LEFT, IMAGE, lambda: with_length(image(), 12, 0x7FFFFFFF)),
    Case("a string that is not UTF-8", "malformed", LEFT, IMAGE, lambda: image().replace(b"m_left", b"m\xff\xfeeft")),
    Case("size zero", "malformed", LEFT, IMAGE, lambda: image(width=0, height=0, step=0, data=np.zeros(0, np.uint8))),
    Case("step smaller than a row", "malformed", LEFT, IMAGE, lambda: image(step=10)),
    Case("fewer bytes than pixels", "malformed", LEFT, IMAGE, lambda: image(data=np.zeros(100, np.uint8))),
    Case("width that overflows", "malformed", LEFT, IMAGE, lambda: image(width=0xFFFFFFFF, height=0xFFFFFFFF)),
    Case("unknown pixel encoding", "malformed", LEFT, IMAGE, lambda: image(encoding="h264")),
    Case("truncated protobuf", "malformed", LEFT, "foxglove.RawImage", lambda: proto_image()[:-3], "protobuf"),
    Case("protobuf of random bytes", "malformed", LEFT, "foxglove.RawImage", lambda: b"\xff" * 64, "protobuf"),
    Case("empty protobuf", "malformed", LEFT, "foxglove.RawImage", lambda: b"", "protobuf"),
    Case(
        "protobuf of another type",
        "wrong_type",
        LEFT,
        "foxglove.CameraCalibration",
        lambda: CameraCalibration(width=4, height=2, frame_id="x", K=[5, 0, 1, 0, 5, 1, 0, 0, 1]).SerializeToString(),
        "protobuf",
    ),
    Case("JSON garbage", "malformed", LEFT, "foxglove.RawImage", lambda: b'{"width": ', "json"),
    Case("JSON nested too deeply", "malformed", LEFT, "foxglove.RawImage", lambda: b"[" * 100_000, "json"),
    Case(
        "JSON with strings for numbers",
        "malformed",
        LEFT,
        "foxglove.RawImage",
        lambda: json.dumps(
            {"timestamp": {"sec": 1, "nsec": 0}, "width": "wide", "data": base64.b64encode(b"x").decode()}
        ).encode(),
        "json",
    ),
    Case("unknown message encoding", "unknown_encoding", LEFT, "foxglove.RawImage", lambda: b"x", "flatbuffer"),
    Case("a type that nobody needs", "unknown_type", LEFT, "tf2_msgs/msg/TFMessage", lambda: b"\x00\x01\x00\x00"),
    Case("a topic that nobody needs", "ignored", "/somewhere/else", IMAGE, image),
    Case(
        "PNG that claims a gigapixel", "oversized", LEFT + "/compressed", ZIP, lambda: compressed(png(1 << 16, 1 << 15))
    ),
    Case("PNG without pixels", "malformed", LEFT + "/compressed", ZIP, lambda: compressed(png(0, 7))),
    Case(
        "JPEG cut off in its header",
        "malformed",
        LEFT + "/compressed",
        ZIP,
        lambda: compressed(b"\xff\xd8\xff\xe0\x00\x10JFIF", "jpeg"),
    ),
    Case(
        "a picture in a format that is not JPEG or PNG",
        "malformed",
        LEFT + "/compressed",
        ZIP,
        lambda: compressed(b"RIFF\x00\x00\x00\x00WEBPVP8 ", "webp"),
    ),
    Case(
        "a message that unpacks to more than it may",
        "oversized",
        LEFT,
        IMAGE,
        lambda: zstandard.ZstdCompressor().compress(bytes(80 << 20)),
    ),
    Case(
        "a compressed message of unknown size",
        "oversized",
        LEFT,
        IMAGE,
        lambda: zstandard.ZstdCompressor(write_content_size=False).compress(bytes(1000)),
    ),
    Case("a cloud that is smaller than it says", "malformed", "/b/points", CLOUD, cloud),
]


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
