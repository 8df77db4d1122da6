"""Message definitions of strangers are compared with our own, never compiled.

A log's definition may be turned into code, for a log is a file that somebody chose. What comes over a network is not:
the program's own definition of the type is used where the sender's agrees with it, and every other type is refused.
"""

from dataclasses import replace
from functools import cache

import foxglove_schemas_protobuf.CameraCalibration_pb2 as camera_calibration_pb2
import foxglove_schemas_protobuf.CompressedImage_pb2 as compressed_image_pb2
import foxglove_schemas_protobuf.PointCloud_pb2 as point_cloud_pb2
import foxglove_schemas_protobuf.PoseInFrame_pb2 as pose_in_frame_pb2
import foxglove_schemas_protobuf.RawImage_pb2 as raw_image_pb2
from mcap_protobuf.schema import build_file_descriptor_set

from ...factors.errors import LogError
from ..decode import ChannelInfo
from ..decode_foxglove import BODIES as FOXGLOVE_BODIES
from ..decode_ros import BODIES as ROS_BODIES
from ..decode_ros import full_name
from ..schemas import schema

MAXIMUM_DEFINITION = 1 << 18
_SECTION = "MSG: "
_PROTOBUF = {
    "foxglove.RawImage": raw_image_pb2.RawImage,
    "foxglove.CompressedImage": compressed_image_pb2.CompressedImage,
    "foxglove.CameraCalibration": camera_calibration_pb2.CameraCalibration,
    "foxglove.PointCloud": point_cloud_pb2.PointCloud,
    "foxglove.PoseInFrame": pose_in_frame_pb2.PoseInFrame,
}


class UnknownTypeError(LogError):
    """A type that no front end can use."""


def with_own_definition(channel: ChannelInfo) -> ChannelInfo:
    """The channel with the program's definition of its type.

    Raises:
        UnknownTypeError: no front end can use messages of that type.
        LogError: the sender's definition is another one, or the encoding is unknown.
    """
    if channel.message_encoding == "cdr" and channel.schema_encoding in ("ros2msg", ""):
        return _ros(channel)
    if channel.schema_name not in FOXGLOVE_BODIES:
        raise UnknownTypeError(f"{channel.topic}: nothing here uses messages of type {_shown(channel.schema_name)}")
    if channel.message_encoding == "protobuf" and channel.schema_encoding == "protobuf":
        # fields are known by number, so that older and newer definitions of one type read each other
        return replace(channel, schema_data=_protobuf(channel.schema_name))
    if channel.message_encoding == "json":
        return replace(channel, schema_data=b"")
    pair = f"{_shown(channel.message_encoding)}/{_shown(channel.schema_encoding)}"
    raise LogError(f"{channel.topic}: encoding {pair} is unknown; send ROS 2 CDR (cdr/ros2msg) or Foxglove protobuf")


def _ros(channel: ChannelInfo) -> ChannelInfo:
    name = full_name(channel.schema_name)
    if name not in ROS_BODIES:
        raise UnknownTypeError(f"{channel.topic}: nothing here uses messages of type {_shown(name)}")
    own = schema(name).text
    theirs = channel.schema_data
    if len(theirs) > MAXIMUM_DEFINITION:
        raise LogError(f"{channel.topic}: a definition of {len(theirs)} bytes is none")
    if theirs.strip() and not same_fields(own, theirs.decode(errors="replace")):
        raise LogError(
            f"{channel.topic}: the sender's definition of {name} is another one than ROS 2's; update the sender"
        )
    return replace(channel, schema_name=name, schema_encoding="ros2msg", schema_data=own.encode())


@cache
def _protobuf(name: str) -> bytes:
    return build_file_descriptor_set(_PROTOBUF[name]).SerializeToString()


def same_fields(own: str, theirs: str) -> bool:
    """Whether two `.msg` texts, with those of the types that they use, have the same fields in the same order.

    Comments, constants, defaults and the packages of types do not matter. Types that only `theirs` has do not either.
    """
    mine, others = _sections(own), _sections(theirs)
    return all(others.get(name) == fields for name, fields in mine.items())


def _sections(text: str) -> dict[str, list[tuple[str, str]]]:
    """Fields (type, name) of each type, by its name without the package; the first has the name `""`."""
    sections: dict[str, list[tuple[str, str]]] = {"": []}
    current = ""
    for raw in text.splitlines():
        line = raw.partition("#")[0].strip()
        if line.startswith(_SECTION):
            current = line.removeprefix(_SECTION).rpartition("/")[2].strip()
            # writers may begin with the name of the type itself
            current = "" if sections == {"": []} else current
            sections.setdefault(current, [])
            continue
        words = line.split()
        if len(words) >= 2 and not line.startswith("===") and "=" not in words[0] + words[1][:64]:
            if len(words) > 2 and words[2].startswith("="):
                continue  # a constant
            sections[current].append((words[0].rpartition("/")[2], words[1]))
    return sections


def _shown(name: str) -> str:
    """A stranger's word in an error: printable and short."""
    return repr(name[:80])
