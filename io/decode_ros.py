"""ROS 2 messages (CDR), decoded by the definition that the log carries."""

import struct
from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np
import zstandard
from numpy.typing import NDArray
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from ..factors.errors import LogError
from .calibration import Calibration, camera_model
from .clouds import RawCloud, checked
from .decode import Bytes, ChannelInfo, DecodeError, Decoder, in_one_line, label
from .messages import (
    Body,
    CameraInfoBody,
    CloudBody,
    DepthBody,
    DetectionsBody,
    ImageBody,
    Message,
    OtherBody,
    PickBody,
    PointsBody,
    PoseBody,
)
from .pixels import DEPTH_ENCODINGS, CompressedPixels, RawPixels, normalised
from .rotations import pose_matrix
from .schemas import (
    MARKER_DETECTIONS,
    PIXEL_PICK,
    POINT_ARRAY,
    POINT_WITH_COVARIANCE_ARRAY,
    typestore,
)

Float = NDArray[np.float64]
RosMessage = Any
"""An object of a class that rosbags generated from the log's own definition."""

_ZSTD = b"\x28\xb5\x2f\xfd"
_MAXIMUM_MESSAGE = 1 << 30
_STAMP_END = 12
"""A message begins with its encoding, four bytes, and where it has a header, with seconds and nanoseconds of four."""
_FIELD_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}


def ros_decoder(channel: ChannelInfo) -> Decoder:
    """A decoder for a `cdr` channel.

    Raises:
        LogError: the channel's definition cannot be understood.
    """
    name = full_name(channel.schema_name)
    try:
        store = _store(name, channel.schema_encoding, channel.schema_data)
    except LogError as error:
        raise LogError(f"{channel.topic}: {error}") from error
    fields = store.fielddefs[name][1]
    has_header = bool(fields) and fields[0][0] == "header" and fields[0][1][1] == "std_msgs/msg/Header"
    make = BODIES.get(name, _other(name))
    topic = channel.topic

    def decode(data: Bytes, log_time_ns: int) -> Message:
        where = label(topic, log_time_ns)
        # The bytes may be anything, and the generated code raises whatever they provoke.
        try:
            message = store.deserialize_cdr(_plain(data), name)
            stamp_ns, frame_id = log_time_ns, ""
            if has_header:
                header: RosMessage = message.header  # pyright: ignore[reportAttributeAccessIssue]
                stamp_ns = header.stamp.sec * 1_000_000_000 + header.stamp.nanosec
                frame_id = header.frame_id
            body = make(message, where)
        except LogError as error:
            if str(error).startswith(where):
                raise
            raise DecodeError(f"{where}: {error}") from error
        except Exception as error:
            raise DecodeError(f"{where}: the data is no {name} ({in_one_line(error)})") from error
        return Message(topic, log_time_ns, stamp_ns, frame_id, body)

    return _once(decode) if has_header and make is _camera_info else decode


def _once(decode: Decoder) -> Decoder:
    """Decodes a message that repeats the last one but for its stamp no second time, as calibrations do."""
    last = b""
    known: Message | None = None

    def decode_new(data: Bytes, log_time_ns: int) -> Message:
        nonlocal last, known
        if known is not None and data[:4] == last[:4] and data[_STAMP_END:] == last[_STAMP_END:]:
            seconds, nanoseconds = struct.unpack_from("<iI" if data[1] else ">iI", data, 4)
            stamp_ns = seconds * 1_000_000_000 + nanoseconds
            return Message(known.topic, log_time_ns, stamp_ns, known.frame_id, known.body)
        known = None
        message = decode(data, log_time_ns)
        if data[0] == 0:  # else it is compressed
            last, known = bytes(data), message
        return message

    return decode_new


def full_name(name: str) -> str:
    """`package/msg/Type` also for the older `package/Type`."""
    parts = name.split("/")
    return f"{parts[0]}/msg/{parts[1]}" if len(parts) == 2 else name


@lru_cache(maxsize=256)
def _store(name: str, schema_encoding: str, schema_data: bytes) -> Typestore:
    """A store with the log's own definitions; the built-in ones where the log has none. Parsing them takes a while.

    Raises:
        LogError: the text is not understood.
    """
    if not schema_data.strip():
        if name in typestore().fielddefs:
            return typestore()
        # an empty definition is right for an empty type
        if schema_encoding != "ros2msg":
            raise LogError(f"the log holds no definition of {name}; record it with its definition")
    store = get_typestore(Stores.EMPTY)
    try:
        store.register(get_types_from_msg(schema_data.decode(), name))
        store.get_msgdef(name)
    except Exception as error:  # the parser's and the code generator's own, for a text that may be anything
        raise LogError(f"the definition of {name} in the log is not understood ({in_one_line(error)})") from error
    return store


def _plain(data: Bytes) -> Bytes:
    """The message itself: rosbag2 may have compressed it."""
    if bytes(data[:4]) == _ZSTD:
        size = zstandard.frame_content_size(bytes(data[:18]))
        if size > _MAXIMUM_MESSAGE:
            raise ValueError(f"a compressed message of {size} bytes")
        data = zstandard.ZstdDecompressor().decompress(data, max_output_size=_MAXIMUM_MESSAGE if size < 0 else 0)
    if len(data) < 4 or data[0] != 0 or data[1] not in (0, 1):
        raise ValueError(f"starts with {bytes(data[:4]).hex() or 'nothing'}, no plain CDR")
    return data


def _image(message: RosMessage, where: str) -> Body:
    encoding = normalised(message.encoding)
    pixels = RawPixels(encoding, message.width, message.height, message.step, bool(message.is_bigendian), message.data)
    pixels.array()  # a view: finds contradicting sizes now
    return DepthBody(pixels, where) if encoding in DEPTH_ENCODINGS else ImageBody(pixels, where)


def _compressed_image(message: RosMessage, where: str) -> Body:
    pixels = CompressedPixels(message.format, message.data)
    is_depth = "compressedDepth" in message.format or message.format.strip().startswith(DEPTH_ENCODINGS)
    return DepthBody(pixels, where) if is_depth else ImageBody(pixels, where)


def _camera_info(message: RosMessage, where: str) -> Body:
    roi = message.roi
    calibration = Calibration(
        frame_id=message.header.frame_id,
        width=message.width,
        height=message.height,
        model=message.distortion_model,
        D=message.d,
        K=message.k,
        R=message.r,
        P=message.p,
        binning=(message.binning_x, message.binning_y),
        roi=(roi.x_offset, roi.y_offset, roi.width, roi.height),
    )
    return CameraInfoBody(camera_model(calibration, where))


def _cloud(message: RosMessage, where: str) -> Body:
    order = ">" if message.is_bigendian else "<"
    known = {f.name: (f.name, f.offset, order + _FIELD_TYPES[f.datatype]) for f in message.fields if f.name in "xyz"}
    fields = tuple(known[axis] for axis in "xyz" if axis in known)
    cloud = RawCloud(message.width, message.height, message.point_step, message.row_step, fields, message.data)
    return CloudBody(checked(cloud), where)


def _detections(message: RosMessage, _: str) -> Body:
    found = message.detections
    return DetectionsBody(
        families=tuple(d.family for d in found),
        ids=np.array([d.id for d in found], dtype=np.int64),
        corners_px=np.array([[(c.x, c.y) for c in d.corners] for d in found], dtype=np.float64).reshape(-1, 4, 2),
        centres_px=np.array([(d.centre.x, d.centre.y) for d in found], dtype=np.float64).reshape(-1, 2),
        hamming=np.array([d.hamming for d in found], dtype=np.int64),
    )


def _pick(message: RosMessage, _: str) -> Body:
    px = np.array([message.u, message.v])
    if not (np.isfinite(px).all() and np.isfinite(message.sigma_px) and message.sigma_px >= 0):
        raise ValueError(f"pick {message.point_id} at ({message.u}, {message.v}), sigma {message.sigma_px} px")
    return PickBody(message.header.frame_id, message.point_id, message.role, px, float(message.sigma_px))


def _pose_stamped(message: RosMessage, _: str) -> Body:
    return PoseBody(_pose(message.pose), None)


def _pose_with_covariance(message: RosMessage, _: str) -> Body:
    return PoseBody(_pose(message.pose.pose), np.array(message.pose.covariance).reshape(6, 6))


def _pose(pose: RosMessage) -> Float:
    p, q = pose.position, pose.orientation
    return pose_matrix((p.x, p.y, p.z), (q.x, q.y, q.z, q.w))


def _points(message: RosMessage, _: str) -> Body:
    points = np.array([(p.x, p.y, p.z) for p in message.points], dtype=np.float64).reshape(-1, 3)
    if len(message.ids) != len(points):
        raise ValueError(f"{len(message.ids)} ids for {len(points)} points")
    return PointsBody(tuple(message.ids), points)


def _points_with_covariance(message: RosMessage, where: str) -> Body:
    body = _points(message, where)
    assert isinstance(body, PointsBody)
    covariances = np.array(message.covariances).reshape(len(body.ids), 3, 3)
    return PointsBody(body.ids, body.points_m, covariances)


def _other(name: str) -> Callable[[RosMessage, str], Body]:
    return lambda message, _: OtherBody(name, message)


BODIES: dict[str, Callable[[RosMessage, str], Body]] = {
    "sensor_msgs/msg/Image": _image,
    "sensor_msgs/msg/CompressedImage": _compressed_image,
    "sensor_msgs/msg/CameraInfo": _camera_info,
    "sensor_msgs/msg/PointCloud2": _cloud,
    MARKER_DETECTIONS: _detections,
    PIXEL_PICK: _pick,
    "geometry_msgs/msg/PoseStamped": _pose_stamped,
    "geometry_msgs/msg/PoseWithCovarianceStamped": _pose_with_covariance,
    "nav_msgs/msg/Odometry": _pose_with_covariance,
    POINT_ARRAY: _points,
    POINT_WITH_COVARIANCE_ARRAY: _points_with_covariance,
}
