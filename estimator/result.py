"""The answer: what the estimator hands to the report, the log and the JSON file. Frozen, in SI units.

Covariances of poses are 6x6 in the ROS order: translation (x, y, z), then rotation about fixed axes (X, Y, Z) of
the parent frame. Covariances of points in {b} come from the joint of `o_T_b` and the point.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ..factors.measurements import Event, Rejection

Float = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class PoseEstimate:
    """`parent_T_name` with its covariance."""

    name: str
    parent: str
    stamp_ns: int
    matrix: Float
    """Shape (4, 4)."""
    covariance: Float | None
    """Shape (6, 6), translation first, fixed axes of the parent, m and rad; None where it was not asked for."""


@dataclass(frozen=True, slots=True)
class MotionEstimate:
    """The mobile camera at one keyframe in itself at an earlier one, `from_T_to`."""

    from_ns: int
    to_ns: int
    matrix: Float
    """Shape (4, 4)."""
    covariance: Float
    """Shape (6, 6), from the joint of both poses: translation first, fixed axes of the earlier one, m and rad."""


@dataclass(frozen=True, slots=True)
class NearestSurface:
    """The mapped surface next to a point that is not the point's own pipe."""

    what: str
    distance_m: float
    """From the point (on the axis, where there is one) to the surface."""
    sigma_m: float
    """Of the distance, from the joint of point and surface."""
    direction: Float
    """Shape (3,), unit, from the point to the surface, in the point's frame."""


@dataclass(frozen=True, slots=True)
class PointEstimate:
    """A pipe point in the robot's frame."""

    id: str
    role: str
    frame: str
    """`b`, or `b0`, `b1`, ... where the base was moved: the station that asked."""
    position_m: Float
    """Shape (3,)."""
    covariance_m2: Float
    """Shape (3, 3)."""
    radius95_m: float
    """Radius of the sphere about the position that holds the point with 95 %."""
    measurements: int
    axis: Float | None = None
    """Shape (3,), direction of the pipe's axis at the point, where a pipe is known."""
    pipe_id: str | None = None
    budget: dict[str, Float] = field(default_factory=dict)
    """Contribution of each source to `covariance_m2`, shape (3, 3) each; they sum to it exactly."""
    nearest_surface: NearestSurface | None = None
    """None: the map was not asked, or shows nothing but the pipe itself."""


@dataclass(frozen=True, slots=True)
class PipeEstimate:
    """A pipe's cylinder in {b}."""

    id: str
    frame: str
    point_m: Float
    """Shape (3,), the point of the axis nearest to the picks."""
    axis: Float
    """Shape (3,), unit."""
    radius_m: float
    covariance: Float
    """Shape (7, 7), of (point, axis, radius)."""


@dataclass(frozen=True, slots=True)
class CalibrationEstimate:
    """One calibration state against its prior."""

    name: str
    unit: str
    value: float
    sigma: float
    prior: float
    prior_sigma: float
    frozen: bool


@dataclass(frozen=True, slots=True)
class FamilyConsistency:
    """Chi-square of one factor family at the estimate, robust weights off, rejected measurements left out."""

    family: str
    chi2: float
    dof: float
    """Number of residuals less their share of the estimated parameters."""
    lower: float
    upper: float
    """Acceptance limits of chi2 / dof."""
    residuals: int
    downweighted: int
    tenths: tuple[int, ...] = ()
    """Number of residuals in each tenth of the chi-square distribution that they ought to have: even where the stated
    uncertainties are right, leaning to the left where they are cautious, piled up at the right where they are not."""


@dataclass(frozen=True, slots=True)
class Consistency:
    """Does the model agree with its own data?"""

    chi2: float
    dof: float
    by_family: tuple[FamilyConsistency, ...]
    paths: dict[str, float]
    """Disagreement of independent ways to the same quantity, in sigmas."""
    passed: bool
    reasons: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class DistanceEstimate:
    """Distance between two marker points, given or asked for."""

    name: str
    distance_m: float
    sigma_m: float
    given_m: float | None = None
    given_sigma_m: float | None = None


@dataclass(frozen=True, slots=True)
class Advice:
    """A further measurement, and what it is predicted to do for one point."""

    action: str
    """What to do, as an order to the operator."""
    detail: str
    """From where, how often, with what."""
    predicted_radius95_m: float
    """The point's `radius95_m` once the predicted factors are in the graph."""
    gain: float
    """1 less the ratio of predicted and present radius: 0 changes nothing, 1 removes all doubt."""


@dataclass(frozen=True, slots=True)
class PickView:
    """The image that was clicked, with the estimate's uncertainty as that camera sees it."""

    camera: str
    stamp_ns: int
    point_id: str
    image: bytes
    """PNG or JPEG, whole or cut out round the pick."""
    pixel: Float
    """Shape (2,), the estimate in this image, OpenCV convention."""
    ellipse_px2: Float
    """Shape (2, 2), covariance of the estimate in this image."""


@dataclass(frozen=True, slots=True)
class PickRecord:
    """One click of the operator, also where it was refused."""

    point_id: str
    role: str
    camera: str
    stamp_ns: int
    pixel: Float
    """Shape (2,), as clicked, OpenCV convention."""
    sigma_px: float


@dataclass(frozen=True, slots=True)
class SurfaceMap:
    """What was seen of the surroundings: landmarks of the mobile camera and the Kinect's surface."""

    frame: str
    points: bytes
    """Rows of (x, y, z, sigma) in m, float32, little-endian. Sigma is the point's own, as if all poses were known."""
    landmarks: int
    """The first so many rows are landmarks, the rest is the Kinect's."""


@dataclass(frozen=True, slots=True)
class Result:
    """Everything that was estimated from one recording."""

    points: tuple[PointEstimate, ...]
    poses: tuple[PoseEstimate, ...]
    """`b`, boards, and the mobile camera at the last keyframe (`m`)."""
    trajectory: tuple[PoseEstimate, ...]
    """`o_T_m` at every processed frame; covariance at keyframes."""
    pipes: tuple[PipeEstimate, ...]
    calibration: tuple[CalibrationEstimate, ...]
    distances: tuple[DistanceEstimate, ...]
    consistency: Consistency
    rejected: tuple[Rejection, ...]
    events: tuple[Event, ...]
    streaming_difference_sigma: dict[str, float]
    """Largest difference between the iSAM2 and the batch estimate, in sigmas of the batch, by quantity."""
    timing: dict[str, float]
    provenance: dict[str, str]
    """Versions, hashes, command."""
    config_yaml: str
    """The effective rig."""
    last_board_view_ns: int | None
    end_ns: int
    advice: dict[str, tuple[Advice, ...]] = field(default_factory=dict)
    """What to measure next, by point id, best first."""
    pick_views: tuple[PickView, ...] = ()
    picks: tuple[PickRecord, ...] = ()
    surroundings: SurfaceMap | None = None
    motions: tuple[MotionEstimate, ...] = ()
    """Of the mobile camera, over windows of a second."""
    memory: str = ""
    """What a later run may begin with (`surecut stream --prior`): boards, machine, calibration, pipes and points with
    their joint covariance, as the text of a checkpoint; empty where no board is known."""
