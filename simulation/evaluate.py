"""One estimate against the truth: the error of every quantity, and how well its covariance foretold it.

Errors are truth less estimate, in the tangent in which the covariance is given: for points in {b} the difference;
for poses, as in ROS, the difference of translations in the parent's axes, then the rotation about the parent's fixed
axes that turns the estimate into the truth.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from ..estimator.result import MotionEstimate, PoseEstimate, Result
from .measurement_level_truth import Truth

Float = NDArray[np.float64]
Group = Literal["point", "pose_b", "pose_f", "pose_m", "trajectory", "motion", "calibration", "pipe"]


@dataclass(frozen=True, slots=True)
class Quantity:
    """One estimated quantity of one run."""

    group: Group
    name: str
    dof: int
    nees: float
    """Squared error in sigmas: error^T covariance^-1 error; NaN where there is no usable covariance."""
    probability: float
    """The smallest region of the estimate that holds the truth has this probability content; NaN as above."""
    error: float
    """Norm of the translation's or the value's error."""
    unit: str
    error_rad: float | None = None
    """Angle of a pose's error."""
    sigma: float = math.nan
    """Root of the covariance's trace over the same components as `error`."""


def evaluate(result: Result, truth: Truth) -> tuple[Quantity, ...]:
    """Every quantity of a result that the truth knows. Quantities that one of them lacks are left out."""
    return (
        *_points(result, truth.points_b_m),
        *_poses(result, truth),
        *_trajectory(result, truth),
        *motion_quantities(result.motions, truth),
        *_calibration(result, calibration_truth(truth) | extrinsics_truth(result, truth)),
        *_pipe_radii(result, truth),
    )


def point_quantity(name: str, position_m: Float, covariance_m2: Float, true_m: Float) -> Quantity:
    """A point in {b}; shapes (3,), (3, 3), (3,)."""
    error = true_m - position_m
    return _quantity("point", name, error, covariance_m2, "m", float(np.linalg.norm(error)), covariance_m2)


def pose_quantity(group: Group, name: str, estimate: Float, covariance: Float, true: Float) -> Quantity:
    """A pose with its covariance in the ROS order; shapes (4, 4), (6, 6), (4, 4)."""
    error = pose_error(estimate, true)
    quantity = _quantity(group, name, error, covariance, "m", float(np.linalg.norm(error[:3])), covariance[:3, :3])
    return _with_angle(quantity, float(np.linalg.norm(error[3:])))


def scalar_quantity(group: Group, name: str, value: float, sigma: float, true: float, unit: str) -> Quantity:
    """A single number with its standard deviation."""
    covariance = np.array([[sigma**2]])
    return _quantity(group, name, np.array([true - value]), covariance, unit, abs(true - value), covariance)


def pose_error(estimate: Float, true: Float) -> Float:
    """`true` seen from `estimate`, shape (6,): translation in the parent's axes, rotation about its fixed axes."""
    rotation = Rotation.from_matrix(true[:3, :3] @ estimate[:3, :3].T).as_rotvec()
    return np.r_[true[:3, 3] - estimate[:3, 3], rotation]


def normalised_square(error: Float, covariance: Float) -> float:
    """error^T covariance^-1 error, shapes (n,), (n, n). NaN for a covariance that is not positive definite."""
    scale = np.sqrt(np.diag(covariance))
    if not np.isfinite(covariance).all() or not (scale > 0).all():
        return math.nan
    try:
        root = np.linalg.cholesky(covariance / np.outer(scale, scale))
    except np.linalg.LinAlgError:
        return math.nan
    return float(np.sum(np.linalg.solve(root, error / scale) ** 2))


def calibration_truth(truth: Truth) -> dict[str, float]:
    """Calibration states by the names and in the units of `Result.calibration`."""
    rig = truth.rig
    values: dict[str, float] = {"depth_offset": rig.depth_offset_m, "depth_scale": rig.depth_scale}
    values |= dict(zip(("depth_ray_x", "depth_ray_y", "depth_ray_scale"), map(float, rig.depth_rays), strict=True))
    values["baseline"] = float(np.linalg.norm(rig.m_left_T_m_right[:3, 3]))
    for name, camera in rig.cameras.items():
        values |= {f"{name}.fx": camera.K[0, 0], f"{name}.fy": camera.K[1, 1]}
        values |= {f"{name}.cx": camera.K[0, 2], f"{name}.cy": camera.K[1, 2]}
    for board in rig.boards.values():
        values |= {f"{board.id}.side": board.side_m, f"{board.id}.print_scale": board.print_scale}
    return {name: float(value) for name, value in values.items()}


def extrinsics_truth(result: Result, truth: Truth) -> dict[str, float]:
    """The right camera's and the Kinect colour camera's pose, in the coordinates of `Result.calibration`.

    These are the tangent coordinates of the pose about its prior, plus the prior's own translation. Priors that turn
    the camera are left out: their translation would have to be known in two frames.
    """
    prior = {state.name: state.prior for state in result.calibration}
    found: dict[str, float] = {}
    for name, pose in (("m_left_T_m_right", truth.rig.m_left_T_m_right), ("b_T_rgb", truth.rig.b_T_rgb)):
        parts = [f"{name}.{part}" for part in ("tx", "ty", "tz", "rx", "ry", "rz")]
        if not all(part in prior for part in parts):
            continue
        mean = gtsam.Pose3(gtsam.Rot3(), np.array([prior[part] for part in parts[:3]]))
        moved = gtsam.Pose3.Logmap(mean.between(gtsam.Pose3(pose)))
        values = [*(prior[part] + moved[3 + i] for i, part in enumerate(parts[:3])), *moved[:3]]
        found |= dict(zip(parts, map(float, values), strict=True))
    return found


def _points(result: Result, true_m: dict[str, Float]) -> list[Quantity]:
    return [
        point_quantity(point.id, point.position_m, point.covariance_m2, true_m[point.id])
        for point in result.points
        if point.id in true_m
    ]


def _poses(result: Result, truth: Truth) -> list[Quantity]:
    quantities = []
    for pose in result.poses:
        true = _true_pose(pose, truth)
        if true is None or pose.covariance is None:
            continue
        group: Group = "pose_b" if pose.name == "b" else "pose_m" if pose.name == "m" else "pose_f"
        quantities.append(pose_quantity(group, pose.name, pose.matrix, pose.covariance, true))
    return quantities


def _true_pose(pose: PoseEstimate, truth: Truth) -> Float | None:
    if pose.parent != "o":
        return None
    if pose.name == "b":
        return truth.o_T_b
    if pose.name == "m":
        return _true_mobile(pose.stamp_ns, truth)
    return truth.o_T_f.get(pose.name)


def _trajectory(result: Result, truth: Truth) -> list[Quantity]:
    """`o_T_m` at the keyframes. The first one is {o} itself and left out."""
    quantities = []
    for pose in result.trajectory:
        true = _true_mobile(pose.stamp_ns, truth)
        if true is None or pose.covariance is None or pose.stamp_ns == truth.stamps_ns[0]:
            continue
        quantities.append(pose_quantity("trajectory", "o_T_m", pose.matrix, pose.covariance, true))
    return quantities


def motion_quantities(motions: Sequence[MotionEstimate], truth: Truth) -> list[Quantity]:
    """What the camera did in each second against what it says it did."""
    quantities = []
    for motion in motions:
        ends = [_true_mobile(stamp_ns, truth) for stamp_ns in (motion.from_ns, motion.to_ns)]
        if ends[0] is not None and ends[1] is not None:
            true = np.linalg.inv(ends[0]) @ ends[1]
            quantities.append(pose_quantity("motion", "one second", motion.matrix, motion.covariance, true))
    return quantities


def _true_mobile(stamp_ns: int, truth: Truth) -> Float | None:
    return truth.o_T_m[truth.stamps_ns.index(stamp_ns)] if stamp_ns in truth.stamps_ns else None


def _calibration(result: Result, true: dict[str, float]) -> list[Quantity]:
    return [
        scalar_quantity("calibration", state.name, state.value, state.sigma, true[state.name], state.unit)
        for state in result.calibration
        if state.name in true and not state.frozen
    ]


def _pipe_radii(result: Result, truth: Truth) -> list[Quantity]:
    return [
        scalar_quantity(
            "pipe", f"{pipe.id}.radius", pipe.radius_m, math.sqrt(pipe.covariance[6, 6]), truth.pipe.radius_m, "m"
        )
        for pipe in result.pipes
        if pipe.id == "pipe0" and pipe.covariance[6, 6] > 0
    ]


def _quantity(
    group: Group, name: str, error: Float, covariance: Float, unit: str, size: float, shown: Float
) -> Quantity:
    nees = normalised_square(error, covariance)
    return Quantity(
        group=group,
        name=name,
        dof=len(error),
        nees=nees,
        probability=float(chi2.cdf(nees, len(error))) if math.isfinite(nees) else math.nan,
        error=size,
        unit=unit,
        sigma=float(np.sqrt(np.trace(shown))),
    )


def _with_angle(quantity: Quantity, angle_rad: float) -> Quantity:
    return Quantity(
        group=quantity.group,
        name=quantity.name,
        dof=quantity.dof,
        nees=quantity.nees,
        probability=quantity.probability,
        error=quantity.error,
        unit=quantity.unit,
        error_rad=angle_rad,
        sigma=quantity.sigma,
    )
