"""What the front ends hand to the graph: frozen, with units and covariances, and the sensor's time in ns.

Pixels are ideal pinhole pixels (undistorted, see `camera.CameraModel`) unless a field says `raw`.
"""

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]
Int = NDArray[np.int64]
CameraName = Literal["m_left", "m_right", "b_rgb", "b_depth"]


@dataclass(frozen=True, slots=True)
class MarkerSighting:
    """Four corners of one marker in one image.

    Corner order is 0..3 = (-,-), (+,-), (+,+), (-,+) in the marker's frame (x right, y up on the upright marker):
    counter-clockwise from the lower left, the order of the AprilTag library.
    """

    stamp_ns: int
    camera: CameraName
    board: str
    marker: int
    corners_px: Float
    """Shape (4, 2), ideal pixels."""
    covariance_px2: Float
    """Shape (4, 2, 2), of the ideal pixels."""
    raw_px: Float
    """Shape (4, 2), as found in the image, for drawing."""
    common_px: float | None = None
    """Sigma of the part of it that views from the same place have in common, where the front end knows; the rig's
    `marker_common_px` is the least."""
    independent_scale: float = 1.0
    """Factor on the covariances of corners that are used as if their errors were independent of each other; below 1
    where the marker as a whole is known better than such corners say."""
    gross: tuple[int, ...] = ()
    """Corners that contradict the rest of their board: they are not used."""

    @property
    def good(self) -> Int:
        """The corners that are used, in order."""
        return np.array([corner for corner in range(4) if corner not in self.gross], dtype=np.int64)

    @property
    def diagonal_px(self) -> float:
        """Length of the marker's diagonal, from corners that are used where they span one."""
        spans = [(a, b) for a, b in ((0, 2), (1, 3)) if not {a, b} & set(self.gross)] or [(0, 2), (1, 3)]
        return float(np.mean([np.linalg.norm(self.corners_px[a] - self.corners_px[b]) for a, b in spans]))


@dataclass(frozen=True, slots=True)
class StereoFrame:
    """Feature tracks of one stereo pair, and the front end's own motion estimate (a first guess, no factor)."""

    stamp_ns: int
    is_keyframe: bool
    track_ids: Int
    """Shape (n,). An id names one physical point as long as its track lives; ids are never used again."""
    left_px: Float
    """Shape (n, 2), ideal pixels."""
    left_covariance_px2: Float
    """Shape (n, 2, 2)."""
    right_px: Float
    """Shape (n, 2), ideal pixels; NaN where the feature was not found in the right image."""
    right_covariance_px2: Float
    """Shape (n, 2, 2); meaningless where `right_px` is NaN."""
    last_T_this: Float
    """Shape (4, 4): pose of this left camera in the previous frame's, from the front end's robust motion estimate."""
    motion_inliers: int
    """Number of tracks that the motion estimate rests on; 0 when there was none (lost: `last_T_this` is a guess)."""
    lost: bool = False
    """True when the tracks do not connect this frame to the previous one."""


@dataclass(frozen=True, slots=True)
class CloudFrame:
    """One Kinect depth image as surface samples with normals, in {b} (depth optical frame).

    `points_m` are as measured; the depth offset and scale states act on them along the ray.
    """

    stamp_ns: int
    points_m: Float
    """Shape (n, 3)."""
    normals: Float
    """Shape (n, 3), unit, towards the camera."""
    sigma_m: Float
    """Shape (n,), standard deviation along the normal."""
    planarity_m: Float
    """Shape (n,), rms of the neighbourhood about its plane."""
    bias_m: Float
    """Shape (n,), the part of `sigma_m` that neighbours share (quantisation): it does not average out."""


@dataclass(frozen=True, slots=True)
class Pick:
    """One operator's click. Roles `cut` and `grasp` name the point on the pipe's axis, `other` the surface point."""

    stamp_ns: int
    camera: CameraName
    point_id: str
    role: Literal["grasp", "cut", "other"]
    px: Float
    """Shape (2,), ideal pixels."""
    raw_px: Float
    """Shape (2,), as clicked."""
    covariance_px2: Float
    """Shape (2, 2)."""


@dataclass(frozen=True, slots=True)
class CylinderSighting:
    """A cylinder seen in one view: the least-squares fit's own parameters and their covariance.

    The cylinder is given by two points of its axis and the radius; parameters are ordered
    (point_a xyz, point_b xyz, radius), all in metres in the frame of `camera`.
    The covariance is of full size but of rank 5: a slide of either point along the axis means nothing.
    """

    stamp_ns: int
    camera: CameraName
    pipe_id: str
    point_a_m: Float
    """Shape (3,)."""
    point_b_m: Float
    """Shape (3,)."""
    radius_m: float
    information: Float
    """Shape (7, 7), of (point_a, point_b, radius); zero along slides of the points on the axis."""
    inliers: int
    rms_m: float
    source: Literal["silhouette", "stereo_cloud", "kinect_cloud"]
    by_depth: Float | None = None
    """Shape (7, 5), d (point_a, point_b, radius) / d (depth states, `cloud.depth_moves`); None: no depth camera's."""


@dataclass(frozen=True, slots=True)
class OutlineSighting:
    """The two occluding edges of a pipe in one image, left and right of its axis.

    A line is l = (l0, l1, l2) with l0^2 + l1^2 = 1 and l . (u, v, 1) = 0 on the edge, in ideal pixels; it is positive
    outside the pipe. The plane through the camera centre and the edge touches the cylinder: with the unit normal
    n ~ K^T l, every point p of the axis has n . p = -radius (camera frame, see `factors.outline`).
    """

    stamp_ns: int
    camera: CameraName
    pipe_id: str
    lines: Float
    """Shape (2, 3)."""
    covariance: Float
    """Shape (2, 2, 2), of each line's (offset in px along (l0, l1) at the foot, direction in rad, about the foot)."""
    foot_px: Float
    """Shape (2, 2): the point of each line that its covariance refers to."""
    extent_px: Float
    """Shape (2, 2, 2): first and last supported point of each line."""
    pick_px: Float
    """Shape (2,), the pick, or the predicted middle of the outline, that the search began at."""
    quality: float
    """Probability that no other pair of edges is the outline, by the search's own score (0 to 1)."""


@dataclass(frozen=True, slots=True)
class BaseMove:
    """The machine was moved from one station to the next."""

    start_ns: int
    """When it began to move."""
    stamp_ns: int
    """Since when it has stood again."""
    before_T_after: Float
    """Shape (4, 4), pose of the new {b} in the old one."""
    covariance: Float
    """Shape (6, 6), rotation first, body frame of the new {b}; wide where the clouds do not hold it."""


@dataclass(frozen=True, slots=True)
class Rejection:
    """A measurement that did not enter the graph, or was switched off there, and why."""

    stamp_ns: int
    family: str
    what: str
    reason: str
    value: float
    """The number that decided, in the unit that `reason` names."""
    limit: float


@dataclass(frozen=True, slots=True)
class Event:
    """Something that a user has to know: a contradiction between rig and log, a knock, a gap."""

    stamp_ns: int
    kind: str
    """Short machine-readable name, such as `side_length_wrong`."""
    text: str
    """One sentence with numbers and units."""
    severity: Literal["info", "warning", "error"]
    values: dict[str, float] = field(default_factory=dict)
