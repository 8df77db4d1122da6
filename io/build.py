"""Messages to write, built from arrays: sensor data, picks, poses. Pure functions; `writer.McapSink` takes the result.

Views for the eye (clouds with columns, ellipsoids, diagnostics) are in `build_views`.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..factors.camera import CameraModel
from .rotations import quaternion_from_matrix
from .schemas import MARKER_DETECTIONS, PIXEL_PICK, POINT_ARRAY, POINT_WITH_COVARIANCE_ARRAY, typestore

Float = NDArray[np.float64]
RosMessage = Any
"""An object of a class that rosbags generated from a schema: no class that a checker could see."""

_CHANNELS = {"mono8": 1, "bgr8": 3, "rgb8": 3, "bgra8": 4, "rgba8": 4, "mono16": 1, "16UC1": 1, "32FC1": 1}
_DTYPES = {"mono16": np.uint16, "16UC1": np.uint16, "32FC1": np.float32}


def make(type_name: str, *fields: Any) -> RosMessage:
    """A message of a type in the store, its fields in the order of the definition."""
    return typestore().types[type_name](*fields)


def stamp(stamp_ns: int) -> RosMessage:
    """`builtin_interfaces/msg/Time`."""
    return make("builtin_interfaces/msg/Time", stamp_ns // 1_000_000_000, stamp_ns % 1_000_000_000)


def header(stamp_ns: int, frame_id: str) -> RosMessage:
    """`std_msgs/msg/Header`."""
    return make("std_msgs/msg/Header", stamp(stamp_ns), frame_id)


def point(xyz: ArrayLike) -> RosMessage:
    """`geometry_msgs/msg/Point`."""
    return make("geometry_msgs/msg/Point", *(float(value) for value in np.asarray(xyz, dtype=np.float64).reshape(3)))


def image(stamp_ns: int, frame_id: str, array: NDArray[Any], encoding: str) -> RosMessage:
    """`sensor_msgs/msg/Image`.

    Args:
        array: shape (height, width) or (height, width, channels), of the encoding's type.
        encoding: `mono8`, `bgr8`, `rgb8`, `bgra8`, `rgba8`, `mono16`, `16UC1` (mm) or `32FC1` (m).

    Raises:
        ValueError: the array does not fit the encoding.
    """
    dtype = np.dtype(_DTYPES.get(encoding, np.uint8))
    channels = _CHANNELS.get(encoding)
    if channels is None:
        raise ValueError(f"encoding {encoding!r}; known: {', '.join(_CHANNELS)}")
    expected = array.shape[:2] if channels == 1 else (*array.shape[:2], channels)
    if array.ndim < 2 or array.shape != expected or array.dtype != dtype:
        raise ValueError(f"an array of shape {array.shape}, {array.dtype} is no {encoding} image")
    height, width = array.shape[:2]
    data = np.ascontiguousarray(array).reshape(-1).view(np.uint8)
    step = width * channels * dtype.itemsize
    return make("sensor_msgs/msg/Image", header(stamp_ns, frame_id), height, width, encoding, 0, step, data)


def depth_image(stamp_ns: int, frame_id: str, depth_m: NDArray[np.floating[Any]]) -> RosMessage:
    """`sensor_msgs/msg/Image` 16UC1: millimetres, 0 where the depth is NaN, not positive or beyond 65.535 m."""
    millimetres = np.rint(np.asarray(depth_m, dtype=np.float64) * 1000.0)
    valid = np.isfinite(millimetres) & (millimetres > 0) & (millimetres <= 65535)
    return image(stamp_ns, frame_id, np.where(valid, millimetres, 0).astype(np.uint16), "16UC1")


def compressed_image(stamp_ns: int, frame_id: str, data: bytes, format_: str) -> RosMessage:
    """`sensor_msgs/msg/CompressedImage` of bytes that are compressed already; format `jpeg` or `png`."""
    pixels = np.frombuffer(data, dtype=np.uint8)
    return make("sensor_msgs/msg/CompressedImage", header(stamp_ns, frame_id), format_, pixels)


def camera_info(
    stamp_ns: int, frame_id: str, camera: CameraModel, *, rectified_focal_px: float | None = None
) -> RosMessage:
    """`sensor_msgs/msg/CameraInfo`; the baseline stands in `P[3] = -focal * baseline`.

    Args:
        rectified_focal_px: focal length of the rectified pair; none: the camera's own K is used for P.
    """
    names = {"none": "plumb_bob"}
    coefficients = np.asarray(camera.D, dtype=np.float64)
    if camera.distortion_model == "none":
        coefficients = np.zeros(5)
    projection = np.zeros((3, 4))
    projection[:, :3] = camera.K
    if rectified_focal_px is not None:
        projection[0, 0] = projection[1, 1] = rectified_focal_px
    projection[0, 3] = -projection[0, 0] * (camera.baseline_m or 0.0)
    return make(
        "sensor_msgs/msg/CameraInfo",
        header(stamp_ns, frame_id),
        camera.height,
        camera.width,
        names.get(camera.distortion_model, camera.distortion_model),
        coefficients,
        np.asarray(camera.K, dtype=np.float64).reshape(9),
        np.asarray(camera.rectification, dtype=np.float64).reshape(9),
        projection.reshape(12) + 0.0,  # no negative zero
        0,
        0,
        make("sensor_msgs/msg/RegionOfInterest", 0, 0, 0, 0, False),
    )


def pose(matrix: ArrayLike) -> RosMessage:
    """`geometry_msgs/msg/Pose` of a (4, 4) matrix."""
    m = np.asarray(matrix, dtype=np.float64)
    quaternion = make("geometry_msgs/msg/Quaternion", *(float(value) for value in quaternion_from_matrix(m[:3, :3])))
    return make("geometry_msgs/msg/Pose", point(m[:3, 3]), quaternion)


def pose_stamped(stamp_ns: int, frame_id: str, matrix: ArrayLike) -> RosMessage:
    """`geometry_msgs/msg/PoseStamped`: the pose `matrix`, shape (4, 4), in `frame_id`."""
    return make("geometry_msgs/msg/PoseStamped", header(stamp_ns, frame_id), pose(matrix))


def pose_with_covariance_stamped(stamp_ns: int, frame_id: str, matrix: ArrayLike, covariance: ArrayLike) -> RosMessage:
    """`geometry_msgs/msg/PoseWithCovarianceStamped`.

    Args:
        covariance: shape (6, 6), translation first, rotation about the fixed axes of `frame_id`.
    """
    flat = np.ascontiguousarray(covariance, dtype=np.float64).reshape(36)
    return make(
        "geometry_msgs/msg/PoseWithCovarianceStamped",
        header(stamp_ns, frame_id),
        make("geometry_msgs/msg/PoseWithCovariance", pose(matrix), flat),
    )


def tf_message(transforms: Sequence[tuple[int, str, str, ArrayLike]]) -> RosMessage:
    """`tf2_msgs/msg/TFMessage` of (stamp_ns, parent, child, `parent_T_child` of shape (4, 4))."""
    return make("tf2_msgs/msg/TFMessage", [_transform(*entry) for entry in transforms])


def _transform(stamp_ns: int, parent: str, child: str, matrix: ArrayLike) -> RosMessage:
    m = np.asarray(matrix, dtype=np.float64)
    translation = make("geometry_msgs/msg/Vector3", *(float(value) for value in m[:3, 3]))
    rotation = pose(m).orientation
    transform = make("geometry_msgs/msg/Transform", translation, rotation)
    return make("geometry_msgs/msg/TransformStamped", header(stamp_ns, parent), child, transform)


def pixel_pick(
    stamp_ns: int, camera: str, point_id: str, role: str, uv_px: tuple[float, float], sigma_px: float
) -> RosMessage:
    """`surecut_msgs/msg/PixelPick`: a click at `uv_px` (raw pixels) in `m_left`, `m_right` or `b_rgb`."""
    u, v = uv_px
    return make(PIXEL_PICK, header(stamp_ns, camera), point_id, role, float(u), float(v), float(sigma_px))


def point_array(stamp_ns: int, frame_id: str, points_m: dict[str, ArrayLike]) -> RosMessage:
    """`surecut_msgs/msg/PointArray` of points by id."""
    return make(POINT_ARRAY, header(stamp_ns, frame_id), list(points_m), [point(p) for p in points_m.values()])


def point_with_covariance_array(
    stamp_ns: int, frame_id: str, points: dict[str, tuple[ArrayLike, ArrayLike]]
) -> RosMessage:
    """`surecut_msgs/msg/PointWithCovarianceArray` of id -> (position (3,) m, covariance (3, 3) m^2)."""
    covariances = [np.asarray(covariance, dtype=np.float64).reshape(9) for _, covariance in points.values()]
    return make(
        POINT_WITH_COVARIANCE_ARRAY,
        header(stamp_ns, frame_id),
        list(points),
        [point(position) for position, _ in points.values()],
        np.concatenate(covariances) if covariances else np.zeros(0),
    )


def marker_detections(
    stamp_ns: int, frame_id: str, family: str, corners_px: dict[int, ArrayLike], hamming: dict[int, int] | None = None
) -> RosMessage:
    """`apriltag_msgs/msg/AprilTagDetectionArray` of id -> raw corners, shape (4, 2), counter-clockwise from lower left.

    What is not known is NaN: goodness, decision margin, homography. The centre is where the diagonals cross.
    """
    detections = []
    for marker, corners in corners_px.items():
        quad = np.asarray(corners, dtype=np.float64).reshape(4, 2)
        points = [make("apriltag_msgs/msg/Point", float(u), float(v)) for u, v in quad]
        centre = make("apriltag_msgs/msg/Point", *(float(value) for value in _crossing(quad)))
        detections.append(
            make(
                "apriltag_msgs/msg/AprilTagDetection",
                family,
                marker,
                (hamming or {}).get(marker, 0),
                float("nan"),
                float("nan"),
                centre,
                points,
                np.full(9, np.nan),
            )
        )
    return make(MARKER_DETECTIONS, header(stamp_ns, frame_id), detections)


def _crossing(quad: Float) -> Float:
    first, second = quad[2] - quad[0], quad[3] - quad[1]
    determinant = first[0] * second[1] - first[1] * second[0]
    if abs(determinant) < 1e-9:
        return quad.mean(axis=0)
    offset = quad[1] - quad[0]
    return quad[0] + first * (offset[0] * second[1] - offset[1] * second[0]) / determinant
