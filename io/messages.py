"""What is read from a log or a stream, free of the wire format: one `Message` with one of a few bodies."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from ..factors.camera import CameraModel
from ..factors.errors import LogError
from .clouds import RawCloud, to_points
from .pixels import CompressedPixels, PixelError, RawPixels, to_depth_m, to_uint8

Float = NDArray[np.float64]
Int = NDArray[np.int64]
Scalar = TypeVar("Scalar", bound=np.generic)


@dataclass(frozen=True, slots=True)
class ImageBody:
    """A picture, decoded when asked for: most of a log's images are not needed."""

    source: RawPixels | CompressedPixels
    label: str
    """Topic and time, for errors."""

    def pixels(self) -> NDArray[np.uint8]:
        """Grey (height, width) or BGR (height, width, 3), uint8, possibly a read-only view of the message.

        Raises:
            LogError: the bytes are no image; names topic and time.
        """
        return _labelled(to_uint8, self.source, self.label)


@dataclass(frozen=True, slots=True)
class DepthBody:
    """A depth image, decoded when asked for."""

    source: RawPixels | CompressedPixels
    label: str
    """Topic and time, for errors."""

    def depth_m(self) -> NDArray[np.float32]:
        """Depth along the optical axis, shape (height, width), NaN where there is none.

        Raises:
            LogError: the bytes are no depth image; names topic and time.
        """
        return _labelled(to_depth_m, self.source, self.label)


@dataclass(frozen=True, slots=True)
class CameraInfoBody:
    """A calibration. `camera.name` is the message's frame; `dataclasses.replace` gives it another."""

    camera: CameraModel


@dataclass(frozen=True, slots=True)
class CloudBody:
    """A point cloud, decoded when asked for."""

    source: RawCloud
    label: str
    """Topic and time, for errors."""

    def points_m(self) -> Float:
        """The finite points, shape (n, 3), in the message's frame."""
        return to_points(self.source)


@dataclass(frozen=True, slots=True)
class DetectionsBody:
    """Markers that were detected elsewhere, in raw pixels, corners in the order of the message."""

    families: tuple[str, ...]
    """One per marker, such as `tag36h11`."""
    ids: Int
    """Shape (n,)."""
    corners_px: Float
    """Shape (n, 4, 2)."""
    centres_px: Float
    """Shape (n, 2)."""
    hamming: Int
    """Shape (n,), corrected bits."""


@dataclass(frozen=True, slots=True)
class PickBody:
    """One click of the operator, raw pixels, in the camera that the message's `frame_id` names."""

    camera: str
    point_id: str
    role: str
    px: Float
    """Shape (2,)."""
    sigma_px: float


@dataclass(frozen=True, slots=True)
class PoseBody:
    """The pose of what the topic is about, in the message's frame."""

    matrix: Float
    """Shape (4, 4)."""
    covariance: Float | None
    """Shape (6, 6), translation first, fixed axes, where the message has one."""


@dataclass(frozen=True, slots=True)
class PointsBody:
    """Points by name in the message's frame."""

    ids: tuple[str, ...]
    points_m: Float
    """Shape (n, 3)."""
    covariances_m2: Float | None = None
    """Shape (n, 3, 3), where the message has them."""


@dataclass(frozen=True, slots=True)
class JsonBody:
    """A JSON message of a type that has no body of its own."""

    type_name: str
    value: Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class OtherBody:
    """A message of any other type, as its decoder gives it; None where the type has no decoder."""

    type_name: str
    value: Any


Body = (
    ImageBody
    | DepthBody
    | CameraInfoBody
    | CloudBody
    | DetectionsBody
    | PickBody
    | PoseBody
    | PointsBody
    | JsonBody
    | OtherBody
)


@dataclass(frozen=True, slots=True)
class Message:
    """One message."""

    topic: str
    log_time_ns: int
    """When it was recorded."""
    stamp_ns: int
    """When it was measured: the header's stamp, the log time where the type has no header."""
    frame_id: str
    body: Body


def _labelled(
    decode: Callable[[RawPixels | CompressedPixels], NDArray[Scalar]], source: RawPixels | CompressedPixels, label: str
) -> NDArray[Scalar]:
    try:
        return decode(source)
    except PixelError as error:
        raise LogError(f"{label}: {error}") from error
