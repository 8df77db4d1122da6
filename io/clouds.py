"""Point clouds as bytes with named fields, and their points."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..factors.errors import LogError

Float = NDArray[np.float64]


class CloudError(LogError):
    """The bytes of one cloud contradict its description."""


@dataclass(frozen=True, slots=True)
class RawCloud:
    """`height` rows of `row_step` bytes with `width` points of `point_step` bytes each."""

    width: int
    height: int
    point_step: int
    row_step: int
    fields: tuple[tuple[str, int, str], ...]
    """Name, offset in bytes, and numpy type with byte order of x, y and z."""
    data: NDArray[np.uint8]
    pose: Float | None = None
    """Shape (4, 4): pose of the cloud in the message's frame; None for the identity."""


def checked(cloud: RawCloud) -> RawCloud:
    """The same cloud.

    Raises:
        CloudError: a field is missing or the sizes contradict each other.
    """
    names = [name for name, _, _ in cloud.fields]
    if names != ["x", "y", "z"]:
        raise CloudError(f"a point cloud needs fields x, y and z; it has {', '.join(names) or 'none of them'}")
    ends = [offset + np.dtype(kind).itemsize for _, offset, kind in cloud.fields]
    if cloud.width < 0 or cloud.height < 0 or min(offset for _, offset, _ in cloud.fields) < 0:
        raise CloudError(f"a point cloud of {cloud.width}x{cloud.height} points")
    if cloud.width * cloud.height == 0:
        return cloud
    row = cloud.width * cloud.point_step
    if max(ends) > cloud.point_step or cloud.row_step < row:
        raise CloudError(f"point step {cloud.point_step} and row step {cloud.row_step} do not fit {cloud.width} points")
    if cloud.data.size < cloud.row_step * (cloud.height - 1) + row:
        raise CloudError(f"{cloud.data.size} bytes are no cloud of {cloud.width}x{cloud.height} points")
    return cloud


def to_points(cloud: RawCloud) -> Float:
    """The finite points, shape (n, 3), in the message's frame. `cloud` is a checked one."""
    shape = (cloud.height, cloud.width)
    points = np.empty((*shape, 3))
    if points.size == 0:
        return points.reshape(-1, 3)
    layout = np.dtype(
        {
            "names": [name for name, _, _ in cloud.fields],
            "formats": [kind for _, _, kind in cloud.fields],
            "offsets": [offset for _, offset, _ in cloud.fields],
            "itemsize": cloud.point_step,
        }
    )
    table = np.ndarray(shape, layout, cloud.data, strides=(cloud.row_step, cloud.point_step))
    for axis, (name, _, _) in enumerate(cloud.fields):
        points[..., axis] = table[name]
    points = points.reshape(-1, 3)
    points = points[np.isfinite(points).all(axis=1)]
    if cloud.pose is not None:
        points = points @ cloud.pose[:3, :3].T + cloud.pose[:3, 3]
    return points
