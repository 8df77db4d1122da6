"""What the result says of every calibration state: its value and sigma beside the prior's."""

from collections.abc import Callable, Iterator, Sequence

import gtsam
import numpy as np
from numpy.typing import NDArray

from ..factors import keys
from ..factors.calibration import (
    depth_ray_sigmas,
    depth_sigmas,
    intrinsics_covariance,
    left_T_right,
    rgb_mean,
    rgb_sigmas,
    stereo_sigmas,
)
from .calibration_states import depth_focal_px
from .engine import Engine
from .result import CalibrationEstimate

Float = NDArray[np.float64]
Sigmas = Callable[[int], Float]
"""Standard deviations of a variable's components by its key."""

INTRINSICS = {0: "fx", 1: "fy", 3: "cx", 4: "cy", 5: "k1", 6: "k2", 7: "p1", 8: "p2"}
"""Names of the intrinsics' components; the skew is not reported."""


def calibration_rows(engine: Engine, values: gtsam.Values, sigmas: Sigmas) -> tuple[CalibrationEstimate, ...]:
    """Every calibration state of a solution: cameras, their poses, depth, pages, insets of detectors.

    Args:
        values: the solution.
        sigmas: its standard deviations, from the same linear system as all covariances of the result.
    """
    return (
        *_intrinsics(engine, values, sigmas),
        *_stereo(engine, values, sigmas),
        *_colour(engine, values, sigmas),
        *_depth(engine, values, sigmas),
        *_pages(engine, values, sigmas),
        *engine.boards.insets,
    )


def _intrinsics(engine: Engine, values: gtsam.Values, sigmas: Sigmas) -> Iterator[CalibrationEstimate]:
    for camera in keys.CAMERA_INDEX:
        key = keys.intrinsics(camera)
        if not values.exists(key):
            continue
        model, settings = engine.cameras[camera], getattr(engine.rig.cameras, camera)
        prior = np.sqrt(np.diag(intrinsics_covariance(model, settings)))
        mean = (model.fx, model.fy, 0.0, model.cx, model.cy, 0.0, 0.0, 0.0, 0.0)
        value, sigma = values.atCal3DS2(key).vector(), sigmas(key)
        for i, part in INTRINSICS.items():
            kind = "focal" if i < 2 else "centre" if i < 5 else "distortion"
            unit, frozen = "px" if i < 5 else "1", kind in settings.freeze
            yield CalibrationEstimate(f"{camera}.{part}", unit, value[i], sigma[i], mean[i], prior[i], frozen)


def _stereo(engine: Engine, values: gtsam.Values, sigmas: Sigmas) -> Iterator[CalibrationEstimate]:
    key, rig = keys.extrinsics("m_right"), engine.rig.stereo
    if values.exists(key):
        mean = left_T_right(engine.cameras["m_left"], engine.cameras["m_right"], rig)
        spread = np.sqrt(np.diag(stereo_sigmas(mean, rig)))
        yield from _pose("m_left_T_m_right", mean, values.atPose3(key), sigmas(key), spread, rig.freeze)


def _colour(engine: Engine, values: gtsam.Values, sigmas: Sigmas) -> Iterator[CalibrationEstimate]:
    key, kinect = keys.extrinsics("b_rgb"), engine.rig.kinect
    if values.exists(key):
        frozen = "b_T_rgb" in kinect.freeze
        yield from _pose("b_T_rgb", rgb_mean(kinect), values.atPose3(key), sigmas(key), rgb_sigmas(kinect), frozen)


def _pose(
    name: str, mean: gtsam.Pose3, pose: gtsam.Pose3, sigma: Float, spread: Float, frozen: bool
) -> Iterator[CalibrationEstimate]:
    """Rotation as moved from the prior's mean, translation as it is, both along the prior's own axes."""
    moved = gtsam.Pose3.Logmap(mean.between(pose))
    nominal = mean.rotation().matrix().T @ mean.translation()
    for i, part in enumerate(("rx", "ry", "rz")):
        yield CalibrationEstimate(f"{name}.{part}", "rad", moved[i], sigma[i], 0.0, spread[i], frozen)
    for i, part in enumerate(("tx", "ty", "tz")):
        value = nominal[i] + moved[3 + i]
        yield CalibrationEstimate(f"{name}.{part}", "m", value, sigma[3 + i], nominal[i], spread[3 + i], frozen)


def _depth(engine: Engine, values: gtsam.Values, sigmas: Sigmas) -> Iterator[CalibrationEstimate]:
    if not values.exists(keys.DEPTH):
        return
    kinect, camera = engine.rig.kinect, engine.rig.cameras.b_depth
    offset = [
        ("depth_offset", "m", "depth_offset" in kinect.freeze),
        ("depth_scale", "1", "depth_scale" in kinect.freeze),
    ]
    yield from _vector(offset, values.atVector(keys.DEPTH), sigmas(keys.DEPTH), depth_sigmas(kinect))
    centre, focal = "centre" in camera.freeze, "focal" in camera.freeze
    rays = [("depth_ray_x", "rad", centre), ("depth_ray_y", "rad", centre), ("depth_ray_scale", "1", focal)]
    prior = depth_ray_sigmas(camera, depth_focal_px(engine.cameras.get("b_depth")))
    yield from _vector(rays, values.atVector(keys.DEPTH_RAYS), sigmas(keys.DEPTH_RAYS), prior)


def _vector(
    parts: Sequence[tuple[str, str, bool]], value: Float, sigma: Float, prior: Float
) -> Iterator[CalibrationEstimate]:
    """Components with a prior of mean zero."""
    for i, (name, unit, frozen) in enumerate(parts):
        yield CalibrationEstimate(name, unit, value[i], sigma[i], 0.0, prior[i], frozen)


def _pages(engine: Engine, values: gtsam.Values, sigmas: Sigmas) -> Iterator[CalibrationEstimate]:
    for board in engine.rig.boards:
        key = keys.page(engine.boards.index(board.id))
        if not values.exists(key):
            continue
        value, sigma = values.atVector(key), sigmas(key)
        yield CalibrationEstimate(f"{board.id}.side", "m", value[0], sigma[0], board.side_m, board.side_sigma_m, False)
        scale = f"{board.id}.print_scale"
        yield CalibrationEstimate(scale, "1", value[1], sigma[1], 1.0, board.print_scale_sigma, False)
