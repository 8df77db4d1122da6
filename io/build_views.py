"""Messages to look at: clouds with named columns, covariance ellipsoids, diagnostics."""

from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .build import Float, RosMessage, header, make, point
from .rotations import quaternion_from_matrix

CHI_95_3D = 2.795483
"""Square root of the 95 % quantile of chi-square with 3 degrees of freedom."""
COVARIANCE_COLUMNS = ("cov_xx", "cov_xy", "cov_xz", "cov_yy", "cov_yz", "cov_zz")
Colour = tuple[float, float, float, float]

_POINT_FIELD_TYPES = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
_LEVELS = {"ok": 0, "warn": 1, "error": 2, "stale": 3}


def point_cloud2(stamp_ns: int, frame_id: str, columns: Mapping[str, NDArray[Any]]) -> RosMessage:
    """`sensor_msgs/msg/PointCloud2` of columns of equal length by name (`x`, `y`, `z`, then anything), packed tightly.

    Raises:
        ValueError: columns of different length, or of a type that the message does not know.
    """
    arrays = {name: np.asarray(column).reshape(-1) for name, column in columns.items()}
    lengths = {array.size for array in arrays.values()}
    if len(lengths) != 1:
        raise ValueError(f"columns of lengths {sorted(lengths)}")
    count = lengths.pop()
    layout = np.dtype([(name, array.dtype.newbyteorder("<")) for name, array in arrays.items()])
    table = np.zeros(count, dtype=layout)
    fields = []
    offset = 0
    for name, array in arrays.items():
        kind = array.dtype.str[1:]
        if kind not in _POINT_FIELD_TYPES:
            raise ValueError(f"column {name} has type {array.dtype}")
        table[name] = array
        fields.append(make("sensor_msgs/msg/PointField", name, offset, _POINT_FIELD_TYPES[kind], 1))
        offset += array.dtype.itemsize
    dense = all(bool(np.isfinite(array).all()) for array in arrays.values())
    data = table.view(np.uint8).reshape(-1)
    return make(
        "sensor_msgs/msg/PointCloud2",
        header(stamp_ns, frame_id),
        1,
        count,
        fields,
        False,
        layout.itemsize,
        layout.itemsize * count,
        data,
        dense,
    )


def covariance_cloud(stamp_ns: int, frame_id: str, points: Sequence[tuple[ArrayLike, ArrayLike]]) -> RosMessage:
    """`sensor_msgs/msg/PointCloud2` of (position (3,), covariance (3, 3)): x, y, z in f4 and six covariance columns."""
    xyz = np.array([np.asarray(p, dtype=np.float64) for p, _ in points]).reshape(-1, 3)
    covariance = np.array([np.asarray(c, dtype=np.float64) for _, c in points]).reshape(-1, 3, 3)
    columns: dict[str, NDArray[Any]] = {axis: xyz[:, i].astype(np.float32) for i, axis in enumerate("xyz")}
    rows, cols = np.triu_indices(3)
    for name, row, col in zip(COVARIANCE_COLUMNS, rows, cols, strict=True):
        columns[name] = covariance[:, row, col].astype(np.float32)
    return point_cloud2(stamp_ns, frame_id, columns)


def marker_array_ellipsoids(
    stamp_ns: int,
    frame_id: str,
    namespace: str,
    points: Sequence[tuple[ArrayLike, ArrayLike]],
    colour: Colour = (0.1, 0.6, 1.0, 0.5),
) -> RosMessage:
    """`visualization_msgs/msg/MarkerArray`: the 95 % ellipsoid of each (position (3,), covariance (3, 3)).

    A SPHERE's `scale` is its diameters: 2 * 2.795 * sqrt(eigenvalue).
    """
    markers = [
        _ellipsoid(header(stamp_ns, frame_id), namespace, index, position, covariance, colour)
        for index, (position, covariance) in enumerate(points)
    ]
    return make("visualization_msgs/msg/MarkerArray", markers)


def _ellipsoid(
    head: RosMessage, namespace: str, index: int, position: ArrayLike, covariance: ArrayLike, colour: Colour
) -> RosMessage:
    diameters, axes = ellipsoid_axes(covariance)
    quaternion = make("geometry_msgs/msg/Quaternion", *(float(value) for value in quaternion_from_matrix(axes)))
    return make(
        "visualization_msgs/msg/Marker",
        head,
        namespace,
        index,
        2,  # SPHERE
        0,  # ADD
        make("geometry_msgs/msg/Pose", point(position), quaternion),
        make("geometry_msgs/msg/Vector3", *(float(value) for value in diameters)),
        make("std_msgs/msg/ColorRGBA", *colour),
        make("builtin_interfaces/msg/Duration", 0, 0),
        False,
        [],
        [],
        "",
        make("sensor_msgs/msg/CompressedImage", header(0, ""), "", np.zeros(0, np.uint8)),
        [],
        "",
        "",
        make("visualization_msgs/msg/MeshFile", "", np.zeros(0, np.uint8)),
        False,
    )


def ellipsoid_axes(covariance: ArrayLike) -> tuple[Float, Float]:
    """Diameters, shape (3,), and right-handed axes (columns), shape (3, 3), of the 95 % ellipsoid."""
    values, axes = np.linalg.eigh(np.asarray(covariance, dtype=np.float64))
    # eigh leaves the signs open; fixing them keeps equal input equal in the file
    axes = axes * np.where(axes[np.abs(axes).argmax(axis=0), range(3)] < 0, -1.0, 1.0)
    axes[:, 0] *= np.sign(np.linalg.det(axes))
    return 2 * CHI_95_3D * np.sqrt(np.maximum(values, 0.0)), axes


def diagnostic_array(
    stamp_ns: int,
    statuses: Sequence[tuple[Literal["ok", "warn", "error", "stale"], str, str, Mapping[str, str]]],
    hardware_id: str = "surecut",
) -> RosMessage:
    """`diagnostic_msgs/msg/DiagnosticArray` of (level, name, message, values)."""
    entries = [
        make(
            "diagnostic_msgs/msg/DiagnosticStatus",
            _LEVELS[level],
            name,
            message,
            hardware_id,
            [make("diagnostic_msgs/msg/KeyValue", key, value) for key, value in values.items()],
        )
        for level, name, message, values in statuses
    ]
    return make("diagnostic_msgs/msg/DiagnosticArray", header(stamp_ns, ""), entries)
