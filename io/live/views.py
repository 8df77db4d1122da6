"""An update as messages: ROS 2 types for recordings and robots, one JSON object for other programs."""

import math
from collections.abc import Iterator
from typing import Any

from numpy.typing import ArrayLike

from .. import build, build_views
from ..build import RosMessage
from .interfaces import Fault, Health, HealthState, LiveImage, LivePoint, LiveUpdate, Severity

Entry = tuple[str, str, RosMessage]
"""Topic, type, message."""

_LEVELS = {Severity.INFORMATION: "ok", Severity.WARNING: "warn", Severity.ERROR: "error"}
_STATE_LEVELS = {
    HealthState.STARTING: "warn",
    HealthState.OK: "ok",
    HealthState.DEGRADED: "warn",
    HealthState.FAILED: "error",
}


def ros_messages(update: LiveUpdate) -> Iterator[Entry]:
    """Everything in an update, on the topics on which an offline result has it."""
    t = update.stamp_ns
    yield (
        "/tf",
        "tf2_msgs/msg/TFMessage",
        build.tf_message([(t, pose.parent, name, pose.matrix) for name, pose in update.poses.items()]),
    )
    for name, pose in update.poses.items():
        stamped = build.pose_stamped(t, pose.parent, pose.matrix)
        yield f"/estimate/pose/{name}", "geometry_msgs/msg/PoseStamped", stamped
        if pose.covariance is not None:
            yield (
                f"/estimate/pose_with_covariance/{name}",
                "geometry_msgs/msg/PoseWithCovarianceStamped",
                build.pose_with_covariance_stamped(t, pose.parent, pose.matrix, pose.covariance),
            )
    if update.points:
        yield from _points(update)
    yield "/estimate/health", "diagnostic_msgs/msg/DiagnosticArray", diagnostics(update)


def _points(update: LiveUpdate) -> Iterator[Entry]:
    t, frame = update.stamp_ns, update.robot_frame
    named: dict[str, tuple[ArrayLike, ArrayLike]] = {
        point.name: (point.xyz_m, point.covariance_m2) for point in update.points
    }
    pairs = list(named.values())
    array = build.point_with_covariance_array(t, frame, named)
    yield "/estimate/points", "surecut_msgs/msg/PointWithCovarianceArray", array
    cloud = build_views.covariance_cloud(t, frame, pairs)
    yield "/estimate/points_cloud", "sensor_msgs/msg/PointCloud2", cloud
    ellipsoids = build_views.marker_array_ellipsoids(t, frame, "points", pairs)
    yield "/estimate/points_ellipsoids", "visualization_msgs/msg/MarkerArray", ellipsoids


def diagnostics(update: LiveUpdate) -> RosMessage:
    """`diagnostic_msgs/msg/DiagnosticArray`: the process, each fault, each point's verdict."""
    counters = {name: str(number) for name, number in sorted(update.counters.items())}
    state = update.health.state
    rows: list[Any] = [(_STATE_LEVELS[state], "surecut: state", f"{state}: {update.verdict}", counters)]
    for fault in update.health.faults:
        since = {"since_s": f"{fault.since_ns / 1e9:.3f}"}
        rows.append((_LEVELS[fault.severity], f"surecut: {fault.name}", fault.text, since))
    for point in update.points:
        level = "ok" if point.verdict == "GO" else "warn"
        age = {"age_s": f"{point.age_s:.3f}", "role": point.role}
        rows.append((level, f"surecut: point {point.name}", point.verdict, age))
    return build_views.diagnostic_array(update.stamp_ns, rows)


def image_message(image: LiveImage) -> Entry:
    """The image as it is recorded."""
    encoding = "mono8" if image.pixels.ndim == 2 else "bgr8"
    return image.topic, "sensor_msgs/msg/Image", build.image(image.stamp_ns, image.frame_id, image.pixels, encoding)


def json_object(update: LiveUpdate) -> dict[str, Any]:
    """One update as plain JSON values; what is not finite is null."""
    poses = {
        name: {
            "frame": pose.parent,
            "matrix": _plain(pose.matrix),
            "covariance": None if pose.covariance is None else _plain(pose.covariance),
        }
        for name, pose in update.poses.items()
    }
    return {
        "stamp_ns": update.stamp_ns,
        "sent_ns": update.sent_ns,
        "verdict": update.verdict,
        "age_s": _finite(update.age_s),
        "health": health_object(update.health),
        "points": [_point(point, update.robot_frame) for point in update.points],
        "points_stamp_ns": update.points_stamp_ns,
        "points_covariance_m2": None if update.points_covariance_m2 is None else _plain(update.points_covariance_m2),
        "poses": poses,
    }


def health_object(health: Health) -> dict[str, Any]:
    """State and faults as plain JSON values."""
    return {"state": str(health.state), "faults": [_fault(fault) for fault in health.faults]}


def _fault(fault: Fault) -> dict[str, Any]:
    return {"name": fault.name, "since_ns": fault.since_ns, "text": fault.text, "severity": str(fault.severity)}


def _point(point: LivePoint, frame: str) -> dict[str, Any]:
    return {
        "id": point.name,
        "role": point.role,
        "frame": frame,
        "position_m": _plain(point.xyz_m),
        "covariance_m2": _plain(point.covariance_m2),
        "axis": None if point.axis is None else _plain(point.axis),
        "radius_m": None if point.radius_m is None else _finite(point.radius_m),
        "verdict": point.verdict,
        "age_s": _finite(point.age_s),
    }


def _plain(array: Any) -> Any:
    """Nested lists of a numpy array."""
    if array.ndim == 1:
        return [_finite(float(value)) for value in array]
    return [_plain(row) for row in array]


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
