"""What a live link may bring, one case of each kind: how it is made, and under which name it is to be counted."""

import base64
import json
import struct
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import cv2
import logmaker
import numpy as np
import zstandard
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.timestamp_pb2 import Timestamp

from surecut.factors.rig import Rig
from surecut.io import build, build_views
from surecut.io.decode import ChannelInfo
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
