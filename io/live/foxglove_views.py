"""An update as what Foxglove and Lichtblick draw: frames, ellipsoids and pipes, outlines on images, diagnostics."""

import base64
import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache, partial

import foxglove_schemas_protobuf.Color_pb2 as color_pb2
import foxglove_schemas_protobuf.FrameTransforms_pb2 as frame_transforms_pb2
import foxglove_schemas_protobuf.ImageAnnotations_pb2 as image_annotations_pb2
import foxglove_schemas_protobuf.PointsAnnotation_pb2 as points_annotation_pb2
import foxglove_schemas_protobuf.RawImage_pb2 as raw_image_pb2
import foxglove_schemas_protobuf.SceneEntity_pb2 as scene_entity_pb2
import foxglove_schemas_protobuf.SceneUpdate_pb2 as scene_update_pb2
import numpy as np
from google.protobuf.message import Message as Protobuf
from google.protobuf.timestamp_pb2 import Timestamp
from mcap_protobuf.schema import build_file_descriptor_set
from numpy.typing import ArrayLike

from ..build import RosMessage, pose_with_covariance_stamped
from ..build_views import ellipsoid_axes
from ..rotations import quaternion_from_matrix
from ..schemas import schema, typestore
from .interfaces import LiveImage, LivePoint, LivePose, LiveUpdate, Outline
from .views import diagnostics, json_object

ANNOTATIONS = "/annotations"
_POSE = "geometry_msgs/msg/PoseWithCovarianceStamped"
_DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"
_GREEN, _AMBER, _RED, _GREY = (0.1, 0.8, 0.3), (1.0, 0.7, 0.1), (0.9, 0.2, 0.2), (0.6, 0.6, 0.6)
_COLOURS = {"GO": _GREEN, "NO-GO": _RED, "MEASURE MORE": _AMBER}
_PIPE_SHOWN_M = 0.4
_HALF_PIXEL = 0.5
"""Foxglove's origin is the corner of the top left pixel, OpenCV's is its centre."""
_PROTOBUF: dict[str, type[Protobuf]] = {
    "foxglove.FrameTransforms": frame_transforms_pb2.FrameTransforms,
    "foxglove.SceneUpdate": scene_update_pb2.SceneUpdate,
    "foxglove.ImageAnnotations": image_annotations_pb2.ImageAnnotations,
    "foxglove.RawImage": raw_image_pb2.RawImage,
}


@dataclass(frozen=True, slots=True)
class View:
    """One message to send, encoded when somebody subscribes to it."""

    topic: str
    schema_name: str
    stamp_ns: int
    encode: Callable[[], bytes]


@cache
def description(schema_name: str) -> dict[str, str]:
    """Encoding, name, encoding and text of the schema, as a server advertises them."""
    if schema_name in _PROTOBUF:
        descriptors = build_file_descriptor_set(_PROTOBUF[schema_name]).SerializeToString()
        parts = ("protobuf", "protobuf", base64.b64encode(descriptors).decode())
    elif schema_name in typestore().fielddefs:
        parts = ("cdr", "ros2msg", schema(schema_name).text)
    else:
        parts = ("json", "jsonschema", '{"type": "object"}')
    return {"encoding": parts[0], "schemaName": schema_name, "schemaEncoding": parts[1], "schema": parts[2]}


def views_of(update: LiveUpdate) -> Iterator[View]:
    """Everything that there is to show of an update."""
    t = update.stamp_ns
    yield View("/tf", "foxglove.FrameTransforms", t, lambda: _transforms(update))
    yield View("/surecut/points", "foxglove.SceneUpdate", t, lambda: _scene(update))
    yield View("/surecut/update", "surecut.Update", t, lambda: _json(update))
    yield View("/diagnostics", _DIAGNOSTICS, t, lambda: _cdr(diagnostics(update), _DIAGNOSTICS))
    for name, pose in update.poses.items():
        if pose.covariance is not None:
            yield View(f"/surecut/pose/{name}", _POSE, t, partial(_pose, t, pose))


def image_views(image: LiveImage) -> Iterator[View]:
    """The image, and what was found in it."""
    t = image.stamp_ns
    yield View(image.topic, "foxglove.RawImage", t, lambda: _raw_image(image))
    yield View(image.topic + ANNOTATIONS, "foxglove.ImageAnnotations", t, lambda: _annotations(image))


def _json(update: LiveUpdate) -> bytes:
    return json.dumps(json_object(update), allow_nan=False).encode()


def _pose(stamp_ns: int, pose: LivePose) -> bytes:
    assert pose.covariance is not None
    return _cdr(pose_with_covariance_stamped(stamp_ns, pose.parent, pose.matrix, pose.covariance), _POSE)


def _cdr(message: RosMessage, type_name: str) -> bytes:
    return bytes(typestore().serialize_cdr(message, type_name))


def _transforms(update: LiveUpdate) -> bytes:
    message = frame_transforms_pb2.FrameTransforms()
    for name, pose in update.poses.items():
        entry = message.transforms.add(parent_frame_id=pose.parent, child_frame_id=name)
        entry.timestamp.CopyFrom(_time(update.stamp_ns))
        _set_xyz(entry.translation, pose.matrix[:3, 3])
        _set_rotation(entry.rotation, pose.matrix[:3, :3])
    return message.SerializeToString()


def _scene(update: LiveUpdate) -> bytes:
    message = scene_update_pb2.SceneUpdate()
    for point in update.points:
        entity = message.entities.add(id=f"point {point.name}", frame_id=update.robot_frame)
        entity.timestamp.CopyFrom(_time(update.stamp_ns))
        _add_point(entity, point)
    return message.SerializeToString()


def _add_point(entity: scene_entity_pb2.SceneEntity, point: LivePoint) -> None:
    """The 95 % ellipsoid, the pipe through it where it is known, the name and the verdict."""
    colour = _COLOURS.get(point.verdict, _GREY)
    diameters, axes = ellipsoid_axes(point.covariance_m2)
    sphere = entity.spheres.add(color=_colour(colour, 0.6))
    _set_xyz(sphere.pose.position, point.xyz_m)
    _set_rotation(sphere.pose.orientation, axes)
    _set_xyz(sphere.size, diameters)
    if point.axis is not None and point.radius_m is not None:
        cylinder = entity.cylinders.add(color=_colour(_GREY, 0.3), bottom_scale=1.0, top_scale=1.0)
        _set_xyz(cylinder.pose.position, point.xyz_m)
        _set_rotation(cylinder.pose.orientation, _frame_along(point.axis))
        _set_xyz(cylinder.size, (2 * point.radius_m, 2 * point.radius_m, _PIPE_SHOWN_M))
    text = f"{point.name}: {point.verdict}, {point.age_s:.1f} s"
    label = entity.texts.add(
        text=text, font_size=14.0, billboard=True, scale_invariant=True, color=_colour(colour, 1.0)
    )
    _set_xyz(label.pose.position, point.xyz_m)
    _set_rotation(label.pose.orientation, np.eye(3))


def _frame_along(axis: ArrayLike) -> np.ndarray:
    """A rotation whose z axis is the given direction."""
    z = np.asarray(axis, dtype=np.float64)
    z = z / max(float(np.linalg.norm(z)), 1e-12)
    x = np.cross(np.eye(3)[int(np.abs(z).argmin())], z)
    x = x / max(float(np.linalg.norm(x)), 1e-12)
    return np.column_stack([x, np.cross(z, x), z])


def _raw_image(image: LiveImage) -> bytes:
    height, width = image.pixels.shape[:2]
    channels = 1 if image.pixels.ndim == 2 else 3
    message = raw_image_pb2.RawImage(
        frame_id=image.frame_id,
        width=width,
        height=height,
        encoding="mono8" if channels == 1 else "bgr8",
        step=width * channels,
        data=np.ascontiguousarray(image.pixels).tobytes(),
    )
    message.timestamp.CopyFrom(_time(image.stamp_ns))
    return message.SerializeToString()


def _annotations(image: LiveImage) -> bytes:
    message = image_annotations_pb2.ImageAnnotations()
    time = _time(image.stamp_ns)
    for outline in image.outlines:
        _add_outline(message, outline, time)
    for name, (u, v) in image.points_px.items():
        circle = message.circles.add(diameter=9.0, thickness=2.0, outline_color=_colour(_AMBER, 1.0))
        circle.timestamp.CopyFrom(time)
        circle.position.x, circle.position.y = u + _HALF_PIXEL, v + _HALF_PIXEL
        _add_text(message, name, (u + 8, v - 8), _AMBER, time)
    return message.SerializeToString()


def _add_outline(message: image_annotations_pb2.ImageAnnotations, outline: Outline, time: Timestamp) -> None:
    colour = _GREEN if outline.used else _RED
    points = message.points.add(type=points_annotation_pb2.PointsAnnotation.LINE_LOOP, thickness=2.0)
    points.timestamp.CopyFrom(time)
    points.outline_color.CopyFrom(_colour(colour, 1.0))
    for u, v in outline.corners_px:
        points.points.add(x=float(u) + _HALF_PIXEL, y=float(v) + _HALF_PIXEL)
    u, v = outline.corners_px.mean(axis=0)
    _add_text(message, outline.label, (float(u), float(v)), colour, time)


def _add_text(
    message: image_annotations_pb2.ImageAnnotations,
    text: str,
    at_px: tuple[float, float],
    colour: tuple[float, float, float],
    time: Timestamp,
) -> None:
    note = message.texts.add(text=text, font_size=10.0, text_color=_colour(colour, 1.0))
    note.timestamp.CopyFrom(time)
    note.position.x, note.position.y = at_px[0] + _HALF_PIXEL, at_px[1] + _HALF_PIXEL


def _colour(rgb: tuple[float, float, float], alpha: float) -> color_pb2.Color:
    return color_pb2.Color(r=rgb[0], g=rgb[1], b=rgb[2], a=alpha)


def _time(stamp_ns: int) -> Timestamp:
    return Timestamp(seconds=stamp_ns // 1_000_000_000, nanos=stamp_ns % 1_000_000_000)


def _set_xyz(target: Protobuf, xyz: ArrayLike) -> None:
    for name, value in zip("xyz", np.asarray(xyz, dtype=np.float64), strict=True):
        setattr(target, name, float(value))


def _set_rotation(target: Protobuf, rotation: ArrayLike) -> None:
    for name, value in zip("xyzw", quaternion_from_matrix(rotation), strict=True):
        setattr(target, name, float(value))
