"""The result as an MCAP log of its own: poses, points, ellipsoids, diagnostics, and the whole result as attachment."""

from collections.abc import Callable
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from ..factors.errors import ObservabilityError, RigError
from ..factors.geometry import pose_from_vectors
from ..factors.rig import load_rig
from ..io.build import (
    point_with_covariance_array,
    pose_stamped,
    pose_with_covariance_stamped,
    tf_message,
)
from ..io.build_views import covariance_cloud, diagnostic_array, marker_array_ellipsoids, point_cloud2
from ..io.writer import McapSink
from .result import PoseEstimate, Result
from .result_json import to_json
from .surroundings import map_rows

Float = NDArray[np.float64]

POSE = "geometry_msgs/msg/PoseStamped"
Level = Literal["ok", "warn", "error", "stale"]
POSE_COVARIANCE = "geometry_msgs/msg/PoseWithCovarianceStamped"


def write_result(path: Path, result: Result, json: Callable[[], str] | None = None) -> None:
    """Writes the log of estimates; it appears only when it is whole.

    Args:
        json: gives the result as text, where it is made elsewhere too; it is called last.

    Raises:
        LogError: the folder is missing, no permission, or the disk is full.
    """
    with McapSink(path) as sink:
        _write_poses(sink, result)
        _write_points(sink, result)
        _write_map(sink, result)
        _write_diagnostics(sink, result)
        sink.attach("result.json", "application/json", to_json(result) if json is None else json(), result.end_ns)
        sink.attach("rig.yaml", "application/yaml", result.config_yaml, result.end_ns)
        sink.metadata("run", {k: str(v) for k, v in result.provenance.items()})


def _write_poses(sink: McapSink, result: Result) -> None:
    start = result.trajectory[0].stamp_ns if result.trajectory else result.end_ns
    moving = {"m", *(p.name for p in result.trajectory)}
    static = [(start, "o", p.name, p.matrix) for p in result.poses if p.name not in moving]
    if static:
        sink.write("/tf_static", "tf2_msgs/msg/TFMessage", tf_message(static), start)
    for pose in result.poses:
        if pose.name not in moving:
            _write_pose(sink, pose, start)
    for pose in result.trajectory:
        sink.write(
            "/tf", "tf2_msgs/msg/TFMessage", tf_message([(pose.stamp_ns, "o", pose.name, pose.matrix)]), pose.stamp_ns
        )
        _write_pose(sink, pose, pose.stamp_ns)


def _write_pose(sink: McapSink, pose: PoseEstimate, stamp_ns: int) -> None:
    sink.write(f"/estimate/pose/{pose.name}", POSE, pose_stamped(stamp_ns, pose.parent, pose.matrix), stamp_ns)
    if pose.covariance is not None:
        message = pose_with_covariance_stamped(stamp_ns, pose.parent, pose.matrix, pose.covariance)
        sink.write(f"/estimate/pose_with_covariance/{pose.name}", POSE_COVARIANCE, message, stamp_ns)


def _write_points(sink: McapSink, result: Result) -> None:
    if not result.points:
        return
    stamp, frame = result.end_ns, "b"
    named: dict[str, tuple[ArrayLike, ArrayLike]] = {p.id: (p.position_m, p.covariance_m2) for p in result.points}
    pairs = list(named.values())
    array = "surecut_msgs/msg/PointWithCovarianceArray"
    sink.write("/estimate/points", array, point_with_covariance_array(stamp, frame, named), stamp)
    sink.write("/estimate/points_cloud", "sensor_msgs/msg/PointCloud2", covariance_cloud(stamp, frame, pairs), stamp)
    ellipsoids = marker_array_ellipsoids(stamp, frame, "points", pairs)
    sink.write("/estimate/points_ellipsoids", "visualization_msgs/msg/MarkerArray", ellipsoids, stamp)


def _write_map(sink: McapSink, result: Result) -> None:
    """The surroundings as a cloud with each point's own sigma, for viewers."""
    if result.surroundings is None:
        return
    rows = map_rows(result.surroundings)
    columns = {name: np.ascontiguousarray(rows[:, i]) for i, name in enumerate(("x", "y", "z", "sigma"))}
    cloud = point_cloud2(result.end_ns, result.surroundings.frame, columns)
    sink.write("/estimate/map", "sensor_msgs/msg/PointCloud2", cloud, result.end_ns)


def _write_diagnostics(sink: McapSink, result: Result) -> None:
    consistency = result.consistency
    rows: list[tuple[Level, str, str, dict[str, str]]] = []
    for family in consistency.by_family:
        ratio = family.chi2 / family.dof if family.dof > 0 else float("nan")
        level: Level = "warn" if ratio > family.upper else "ok"
        values = {"chi2": f"{family.chi2:.3f}", "dof": f"{family.dof:.1f}", "limit": f"{family.upper:.3f}"}
        values["residuals"] = str(family.residuals)
        rows.append((level, f"residuals/{family.family}", f"chi2/dof {ratio:.2f}", values))
    overall: Level = "ok" if consistency.passed else "error"
    text = "consistent" if consistency.passed else "; ".join(consistency.reasons)
    rows.append((overall, "health", text, {}))
    sink.write(
        "/estimate/health", "diagnostic_msgs/msg/DiagnosticArray", diagnostic_array(result.end_ns, rows), result.end_ns
    )
    severity: dict[str, Level] = {"info": "ok", "warning": "warn", "error": "error"}
    for event in result.events:
        values = {k: f"{v:.6g}" for k, v in event.values.items()}
        status = diagnostic_array(event.stamp_ns, [(severity[event.severity], event.kind, event.text, values)])
        sink.write("/estimate/events", "diagnostic_msgs/msg/DiagnosticArray", status, event.stamp_ns)
    for rejection in result.rejected:
        values = {"value": f"{rejection.value:.6g}", "limit": f"{rejection.limit:.6g}", "family": rejection.family}
        status = diagnostic_array(rejection.stamp_ns, [("warn", rejection.what, rejection.reason, values)])
        sink.write("/estimate/rejected", "diagnostic_msgs/msg/DiagnosticArray", status, rejection.stamp_ns)


def tum_text(result: Result, frame: Literal["o", "world"] = "o") -> str:
    """The trajectory of {m} in TUM format: time [s], translation [m], quaternion x y z w; one line per frame.

    Args:
        frame: `o`, or the frame that the rig's `world_board` defines.

    Raises:
        SurecutError: there is no such frame.
    """
    frame_T_o = world_T_o(result) if frame == "world" else np.eye(4)
    lines = ["# timestamp tx ty tz qx qy qz qw"]
    for pose in result.trajectory:
        matrix = frame_T_o @ pose.matrix
        q = Rotation.from_matrix(matrix[:3, :3]).as_quat()
        numbers = " ".join(f"{x:.9f}" for x in np.concatenate([matrix[:3, 3], q]))
        lines.append(f"{pose.stamp_ns // 10**9}.{pose.stamp_ns % 10**9:09d} {numbers}")
    return "\n".join(lines) + "\n"


def world_T_o(result: Result) -> Float:
    """{o} in the frame that the rig's `world_board` defines, shape (4, 4): `world_T_f * o_T_f^-1`.

    Raises:
        RigError: the rig gives no such board. ObservabilityError: the log never placed it.
    """
    world = load_rig(result.config_yaml.encode()).world_board
    if world is None:
        raise RigError("the rig defines no frame world; add the section `world_board` (board, world_T_f)")
    o_T_f = next((pose.matrix for pose in result.poses if pose.name == world.board), None)
    if o_T_f is None:
        raise ObservabilityError(
            f"the frame world is not observable: its board {world.board} was never seen well enough to be placed"
        )
    world_T_f = pose_from_vectors(world.world_T_f.translation_m, world.world_T_f.rotation_vector_rad).matrix()
    return world_T_f @ np.linalg.inv(o_T_f)
