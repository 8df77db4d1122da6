"""Decoders: every encoding against values known by hand, and other formats than ours."""

import base64
import json
import struct
from dataclasses import replace

import cv2
import logmaker
import numpy as np
import pytest
import zstandard
from decode_helpers import TIME, cdr, foxglove, raw, ros, stamped
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage

from surecut.factors.errors import LogError
from surecut.io import build
from surecut.io.decode import ChannelInfo, DecodeError, decoder_for
from surecut.io.messages import CameraInfoBody, CloudBody, DepthBody, ImageBody, JsonBody, PoseBody
from surecut.io.pixels import CompressedPixels, PixelError, RawPixels, to_depth_m, to_uint8
from surecut.io.schemas import schema, typestore

RGB = np.array([[[10, 20, 30], [40, 50, 60]], [[70, 80, 90], [100, 110, 120]]], np.uint8)


@pytest.mark.parametrize("pad", [0, 3])
def test_colours_become_bgr(pad):
    bgr = RGB[..., ::-1]
    alpha = np.full((2, 2, 1), 255, np.uint8)
    assert np.array_equal(to_uint8(raw("rgb8", RGB, pad)), bgr)
    assert np.array_equal(to_uint8(raw("bgr8", bgr, pad)), bgr)
    assert np.array_equal(to_uint8(raw("rgba8", np.concatenate([RGB, alpha], 2), pad)), bgr)
    assert np.array_equal(to_uint8(raw("bgra8", np.concatenate([bgr, alpha], 2), pad)), bgr)


@pytest.mark.parametrize("big", [False, True])
def test_sixteen_bits(big):
    values = np.array([[256, 0x1234], [65535, 0]], ">u2" if big else "<u2")
    assert to_uint8(raw("mono16", values, 4, big)).tolist() == [[1, 0x12], [255, 0]]
    depth = to_depth_m(raw("16UC1", values, 0, big))
    assert depth[0] == pytest.approx([0.256, 4.660])
    assert np.isnan(depth[1]).all()


def test_depth_in_floats():
    values = np.array([[1.5, np.nan], [np.inf, -1.0]], np.float32)
    depth = to_depth_m(raw("32FC1", values, 8))
    assert depth[0, 0] == 1.5
    assert np.isnan(depth).sum() == 3


@pytest.mark.parametrize(("pattern", "first"), [("rggb", (0, 0)), ("bggr", (1, 1)), ("gbrg", (1, 0)), ("grbg", (0, 1))])
def test_bayer_patterns_have_red_where_their_name_says(pattern, first):
    mosaic = np.zeros((16, 16), np.uint8)
    mosaic[first[0] :: 2, first[1] :: 2] = 200  # red pixels only
    image = to_uint8(raw(f"bayer_{pattern}8", mosaic))
    assert image[4:12, 4:12, 2].min() == 200
    assert image[4:12, 4:12, 0].max() == 0


def test_yuv():
    grey = np.array([[[128, 90], [128, 200]]], np.uint8)  # U Y V Y
    assert to_uint8(raw("yuv422", grey))[0, 1].tolist() == pytest.approx([217] * 3, abs=5)


def test_compressed_depth():
    millimetres = np.array([[0, 1500], [2000, 65535]], np.uint16)
    png = cv2.imencode(".png", millimetres)[1].tobytes()
    data = np.frombuffer(struct.pack("<iff", 0, 0, 0) + png, np.uint8)
    depth = to_depth_m(CompressedPixels("16UC1; compressedDepth png", data))
    assert depth[0, 1] == pytest.approx(1.5)
    assert np.isnan(depth[[0, 1], [0, 1]]).all()
    # floats are kept as inverse depth: A / (value - B)
    inverse = cv2.imencode(".png", np.array([[0, 1100]], np.uint16))[1].tobytes()
    data = np.frombuffer(struct.pack("<iff", 0, 2000.0, 100.0) + inverse, np.uint8)
    depth = to_depth_m(CompressedPixels("32FC1; compressedDepth png", data))
    assert depth[0, 1] == pytest.approx(2.0)
    assert np.isnan(depth[0, 0])


@pytest.mark.parametrize(
    "pixels",
    [
        RawPixels("mono8", 4, 4, 3, False, np.zeros(16, np.uint8)),
        RawPixels("mono8", 4, 4, 4, False, np.zeros(15, np.uint8)),
        RawPixels("mono8", 0, 4, 4, False, np.zeros(15, np.uint8)),
        RawPixels("mono8", 1 << 31, 1 << 31, 1 << 31, False, np.zeros(15, np.uint8)),
        RawPixels("what", 4, 4, 4, False, np.zeros(16, np.uint8)),
        RawPixels("32FC1", 1, 1, 4, False, np.zeros(4, np.uint8)),
        CompressedPixels("jpeg", np.zeros(0, np.uint8)),
        CompressedPixels("png", np.frombuffer(b"\x89PNG\r\n\x1a\n", np.uint8)),
        CompressedPixels("16UC1; compressedDepth png", np.zeros(5, np.uint8)),
    ],
)
def test_images_that_are_none(pixels):
    with pytest.raises(PixelError):
        to_uint8(pixels)


def test_a_huge_png_is_refused_before_it_is_decoded():
    png = bytearray(cv2.imencode(".png", np.zeros((2, 2), np.uint8))[1].tobytes())
    png[16:24] = struct.pack(">II", 1_000_000, 1_000_000)
    with pytest.raises(PixelError, match="1000000x1000000"):
        to_uint8(CompressedPixels("png", np.frombuffer(bytes(png), np.uint8)))


def test_errors_name_topic_and_time():
    message = build.compressed_image(TIME, "m", b"no image", "jpeg")
    body = ros("sensor_msgs/msg/CompressedImage")(cdr("sensor_msgs/msg/CompressedImage", message), TIME).body
    assert isinstance(body, ImageBody)
    with pytest.raises(LogError, match=r"/t at 5\.000 s: 8 bytes are no JPEG or PNG image"):
        body.pixels()
    with pytest.raises(DecodeError, match=r"/t at 5\.000 s: .*no plain CDR"):
        ros("sensor_msgs/msg/CompressedImage")(b"what", TIME)


def test_messages_that_rosbag2_compressed_one_by_one():
    data = cdr("geometry_msgs/msg/PoseStamped", build.pose_stamped(TIME, "o", np.eye(4)))
    decode = ros("geometry_msgs/msg/PoseStamped")
    plain = decode(data, 1)
    for packed in (zstandard.compress(data), zstandard.ZstdCompressor(write_content_size=False).compress(data)):
        unpacked = decode(packed, 1)
        assert isinstance(unpacked.body, PoseBody)
        assert isinstance(plain.body, PoseBody)
        assert np.array_equal(unpacked.body.matrix, plain.body.matrix)
        assert (unpacked.stamp_ns, unpacked.frame_id) == (TIME, "o")


def test_older_type_names_and_missing_definitions():
    data = cdr("geometry_msgs/msg/PoseStamped", build.pose_stamped(TIME, "o", np.eye(4)))
    text = schema("geometry_msgs/msg/PoseStamped").text
    for name, definition in (("geometry_msgs/PoseStamped", text), ("geometry_msgs/msg/PoseStamped", "")):
        message = decoder_for(ChannelInfo("/t", "cdr", name, "ros2msg", definition.encode()))(data, 1)
        assert isinstance(message.body, PoseBody)


def cloud_message(height: int, width: int, big: bool, padding: int):
    """x as double at 4, z before y, rows padded, one NaN."""
    order = ">" if big else "<"
    layout = np.dtype(
        {
            "names": ["x", "y", "z"],
            "formats": [order + "f8", order + "f4", order + "f4"],
            "offsets": [4, 16, 12],
            "itemsize": 24,
        }
    )
    table = np.zeros((height, width), layout)
    table["x"], table["y"], table["z"] = np.arange(width), 2, 3
    table["y"][0, 1] = np.nan
    rows = np.pad(table.view(np.uint8).reshape(height, -1), ((0, 0), (0, padding)))
    fields = [
        build.make("sensor_msgs/msg/PointField", name, offset, kind, 1)
        for name, offset, kind in (("z", 12, 7), ("rgb", 0, 7), ("x", 4, 8), ("y", 16, 7))
    ]
    head = build.header(TIME, "b")
    return build.make(
        "sensor_msgs/msg/PointCloud2", head, height, width, fields, big, 24, rows.shape[1], rows.reshape(-1), False
    )


@pytest.mark.parametrize("big", [False, True])
@pytest.mark.parametrize("padding", [0, 8])
def test_clouds_of_any_layout(big, padding):
    name = "sensor_msgs/msg/PointCloud2"
    body = ros(name)(cdr(name, cloud_message(2, 3, big, padding)), 1).body
    assert isinstance(body, CloudBody)
    expected = [[0, 2, 3], [2, 2, 3], [0, 2, 3], [1, 2, 3], [2, 2, 3]]
    assert body.points_m().tolist() == expected


def test_foxglove_protobuf_images_and_depth():
    picture = logmaker.picture(1)
    message = stamped(RawImage(width=64, height=48, encoding="mono8", step=64, data=picture.tobytes()))
    decoded = foxglove(RawImage)(message.SerializeToString(), 1)
    assert (decoded.stamp_ns, decoded.frame_id) == (TIME, "cam")
    assert isinstance(decoded.body, ImageBody)
    assert np.array_equal(decoded.body.pixels(), picture)
    depth = stamped(RawImage(width=1, height=1, encoding="16UC1", step=2, data=b"\xe8\x03"))
    body = foxglove(RawImage)(depth.SerializeToString(), 1).body
    assert isinstance(body, DepthBody)
    assert body.depth_m().tolist() == [[1.0]]
    png = cv2.imencode(".png", picture)[1].tobytes()
    body = foxglove(CompressedImage)(stamped(CompressedImage(format="png", data=png)).SerializeToString(), 1).body
    assert isinstance(body, ImageBody)
    assert np.array_equal(body.pixels(), picture)


@pytest.mark.parametrize("big", [False, True])
def test_calibrations_that_differ_are_told_apart_and_each_has_its_own_stamp(big):
    def info(stamp_ns: int, K: np.ndarray = logmaker.LEFT.K) -> bytes:
        message = build.camera_info(stamp_ns, "cam", replace(logmaker.LEFT, K=K))
        return bytes(typestore().serialize_cdr(message, kind, little_endian=not big))

    kind = "sensor_msgs/msg/CameraInfo"
    decode, other = ros(kind), logmaker.LEFT.K.copy()
    other[0, 0] += 1e-9
    sent = [(TIME, logmaker.LEFT.K), (TIME + 7, logmaker.LEFT.K), (TIME, other), (TIME - 1, logmaker.LEFT.K)]
    for stamp_ns, K in sent:
        message = decode(info(stamp_ns, K), 1)
        assert isinstance(message.body, CameraInfoBody)
        assert (message.stamp_ns, message.frame_id, message.log_time_ns) == (stamp_ns, "cam", 1)
        assert message.body.camera.K.tolist() == K.tolist()
    with pytest.raises(DecodeError):
        decode(info(TIME)[:60], 1)


def test_foxglove_protobuf_calibration_pose_and_cloud():
    K, R = logmaker.K.reshape(-1), np.eye(3).reshape(-1)
    P = [60, 0, 31.5, -6, 0, 60, 23.5, 0, 0, 0, 1, 0]
    message = CameraCalibration(width=64, height=48, distortion_model="kannala_brandt", D=[1, 2, 3, 4], K=K, R=R, P=P)
    body = foxglove(CameraCalibration)(stamped(message).SerializeToString(), 1).body
    assert isinstance(body, CameraInfoBody)
    assert body.camera.distortion_model == "equidistant"
    assert body.camera.baseline_m == pytest.approx(0.1)
    pose = stamped(PoseInFrame())
    pose.pose.position.x = 3
    pose.pose.orientation.w = 1
    body = foxglove(PoseInFrame)(pose.SerializeToString(), 1).body
    assert isinstance(body, PoseBody)
    assert body.matrix[:3, 3].tolist() == [3, 0, 0]
    fields = [PackedElementField(name=n, offset=4 * i, type=PackedElementField.FLOAT32) for i, n in enumerate("xyz")]
    cloud = stamped(PointCloud(point_stride=12, fields=fields, data=np.array([1, 2, 3], "<f4").tobytes()))
    cloud.pose.position.z = 10
    cloud.pose.orientation.w = 1
    body = foxglove(PointCloud)(cloud.SerializeToString(), 1).body
    assert isinstance(body, CloudBody)
    assert body.points_m().tolist() == [[1, 2, 13]]


def test_json_images_and_other_json():
    png = cv2.imencode(".png", logmaker.picture(2))[1].tobytes()
    value = {
        "timestamp": {"sec": 5, "nsec": 123},
        "frame_id": "c",
        "format": "png",
        "data": base64.b64encode(png).decode(),
    }
    decode = decoder_for(ChannelInfo("/t", "json", "foxglove.CompressedImage", "jsonschema", b""))
    message = decode(json.dumps(value).encode(), 1)
    assert (message.stamp_ns, message.frame_id) == (TIME, "c")
    assert isinstance(message.body, ImageBody)
    assert np.array_equal(message.body.pixels(), logmaker.picture(2))
    other = decoder_for(ChannelInfo("/t", "json", "", "", b""))(b'{"a": 1}', 7)
    assert other.stamp_ns == 7
    assert isinstance(other.body, JsonBody)
    assert other.body.value == {"a": 1}
