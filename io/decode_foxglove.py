"""Foxglove's message types in protobuf and in JSON; JSON of any other type as it is."""

import base64
import json
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from mcap.records import Schema
from mcap_protobuf.decoder import DecoderFactory

from ..factors.errors import LogError
from .calibration import Calibration, camera_model
from .clouds import RawCloud, checked
from .decode import Bytes, ChannelInfo, DecodeError, Decoder, in_one_line, label
from .messages import Body, CameraInfoBody, CloudBody, DepthBody, ImageBody, JsonBody, Message, OtherBody, PoseBody
from .pixels import DEPTH_ENCODINGS, CompressedPixels, RawPixels, normalised
from .rotations import pose_matrix

Get = Callable[[str], Any]
"""A message's field by name; sub-messages as `Get` too."""
Head = tuple[int, str]
"""Stamp (ns) and frame."""

_FIELD_TYPES = {1: "u1", 2: "i1", 3: "u2", 4: "i2", 5: "u4", 6: "i4", 7: "f4", 8: "f8"}


def protobuf_decoder(channel: ChannelInfo) -> Decoder:
    """A decoder for a `protobuf` channel, by the file descriptors that the log carries.

    Raises:
        LogError: the descriptors cannot be understood.
    """
    schema = Schema(id=1, name=channel.schema_name, encoding="protobuf", data=channel.schema_data)
    try:
        parse = DecoderFactory().decoder_for("protobuf", schema)
    except Exception as error:  # protobuf's own, for bytes that may be anything
        raise LogError(
            f"{channel.topic}: the log's definition of {channel.schema_name} is not understood ({in_one_line(error)})"
        ) from error
    assert parse is not None
    make = BODIES.get(channel.schema_name)

    def body(data: Bytes, where: str) -> tuple[Head | None, Body]:
        message = parse(bytes(data))
        if make is None:
            return None, OtherBody(channel.schema_name, message)
        get = _protobuf_get(message)
        return _protobuf_head(get), make(get, where)

    return _decoder(channel, body)


def json_decoder(channel: ChannelInfo) -> Decoder:
    """A decoder for a `json` channel; it needs no schema."""
    make = BODIES.get(channel.schema_name)

    def body(data: Bytes, where: str) -> tuple[Head | None, Body]:
        value = json.loads(bytes(data))
        if not isinstance(value, dict):
            raise ValueError("not a JSON object")
        get = _json_get(value)
        if make is None:
            return _json_head(get) if "timestamp" in value else None, JsonBody(channel.schema_name, value)
        return _json_head(get), make(get, where)

    return _decoder(channel, body)


def _decoder(channel: ChannelInfo, body: Callable[[Bytes, str], tuple[Head | None, Body]]) -> Decoder:
    def decode(data: Bytes, log_time_ns: int) -> Message:
        where = label(channel.topic, log_time_ns)
        # The bytes may be anything, and the parsers raise whatever they provoke.
        try:
            head, content = body(data, where)
            stamp_ns, frame_id = head or (log_time_ns, "")
        except LogError as error:
            if str(error).startswith(where):
                raise
            raise DecodeError(f"{where}: {error}") from error
        except Exception as error:
            name = channel.schema_name or "JSON message"
            raise DecodeError(f"{where}: the data is no {name} ({in_one_line(error)})") from error
        return Message(channel.topic, log_time_ns, stamp_ns, frame_id, content)

    return decode


def _protobuf_get(message: Any) -> Get:
    def get(name: str) -> Any:
        value = getattr(message, name)
        return _protobuf_get(value) if hasattr(value, "DESCRIPTOR") else value

    return get


def _json_get(value: Mapping[str, Any]) -> Get:
    def get(name: str) -> Any:
        # protobuf's JSON mapping leaves out what is zero, and some writers use lower case for K, D, R and P
        field = value.get(name, value.get(name.lower(), 0))
        return _json_get(field) if isinstance(field, dict) else field

    return get


def _protobuf_head(get: Get) -> Head:
    time = get("timestamp")
    return int(time("seconds")) * 1_000_000_000 + int(time("nanos")), str(get("frame_id"))


def _json_head(get: Get) -> Head:
    time = get("timestamp")
    if not time:
        raise ValueError("no timestamp")
    parts: list[Any] = [time("sec"), time("nsec")]
    return int(parts[0]) * 1_000_000_000 + int(parts[1]), str(get("frame_id") or "")


def _bytes(value: Any) -> np.ndarray[Any, np.dtype[np.uint8]]:
    data = base64.b64decode(value, validate=True) if isinstance(value, str) else value
    return np.frombuffer(data, dtype=np.uint8)


def _raw_image(get: Get, where: str) -> Body:
    encoding = normalised(get("encoding"))
    pixels = RawPixels(encoding, get("width"), get("height"), get("step"), False, _bytes(get("data")))
    pixels.array()  # a view: finds contradicting sizes now
    return DepthBody(pixels, where) if encoding in DEPTH_ENCODINGS else ImageBody(pixels, where)


def _compressed_image(get: Get, where: str) -> Body:
    return ImageBody(CompressedPixels(str(get("format")), _bytes(get("data"))), where)


def _calibration(get: Get, where: str) -> Body:
    calibration = Calibration(
        frame_id=str(get("frame_id") or ""),
        width=int(get("width")),
        height=int(get("height")),
        model=str(get("distortion_model") or ""),
        D=_numbers(get("D")),
        K=_numbers(get("K")),
        R=_numbers(get("R")),
        P=_numbers(get("P")),
    )
    return CameraInfoBody(camera_model(calibration, where))


def _numbers(value: Any) -> list[float]:
    return [float(number) for number in value] if value else []


def _cloud(get: Get, where: str) -> Body:
    data = _bytes(get("data"))
    step = int(get("point_stride"))
    fields = {}
    for field in get("fields"):
        part = _json_get(field) if isinstance(field, dict) else _protobuf_get(field)
        if part("name") in ("x", "y", "z"):
            fields[part("name")] = (part("name"), int(part("offset")), "<" + _FIELD_TYPES[int(part("type"))])
    if step <= 0:
        raise ValueError(f"point stride {step}")
    count = data.size // step
    ordered = tuple(fields[axis] for axis in "xyz" if axis in fields)
    return CloudBody(checked(RawCloud(count, 1, step, step * count, ordered, data, _pose_or_none(get("pose")))), where)


def _pose(get: Get, _: str) -> Body:
    matrix = _pose_or_none(get("pose"))
    return PoseBody(np.eye(4) if matrix is None else matrix, None)


def _pose_or_none(get: Any) -> np.ndarray[Any, np.dtype[np.float64]] | None:
    """None where the message has no pose, or only its defaults."""
    if not get:
        return None
    translation, quaternion = _vector(get("position"), "xyz"), _vector(get("orientation"), "xyzw")
    if not any(quaternion):
        if not any(translation):
            return None
        quaternion = [0.0, 0.0, 0.0, 1.0]
    return pose_matrix(translation, quaternion)


def _vector(get: Any, axes: str) -> list[float]:
    return [float(get(axis)) for axis in axes] if get else [0.0] * len(axes)


BODIES: dict[str, Callable[[Get, str], Body]] = {
    "foxglove.RawImage": _raw_image,
    "foxglove.CompressedImage": _compressed_image,
    "foxglove.CameraCalibration": _calibration,
    "foxglove.PointCloud": _cloud,
    "foxglove.PoseInFrame": _pose,
}
