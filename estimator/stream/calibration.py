"""How far calibration states have gone from their priors, and holding them where they are."""

import gtsam
import numpy as np
from numpy.typing import NDArray

from ...factors import keys
from ...factors.calibration import (
    depth_sigmas,
    intrinsics_covariance,
    left_T_right,
    rgb_mean,
    rgb_sigmas,
    stereo_sigmas,
)
from ...factors.noise import sigmas
from ..engine import Engine
from ..graph import Record, Update
from ..result import CalibrationEstimate
from .posterior import Posterior

Float = NDArray[np.float64]

FROZEN = "frozen"
INTRINSICS = ("fx", "fy", "skew", "cx", "cy", "k1", "k2", "p1", "p2")
POSE = ("rx", "ry", "rz", "tx", "ty", "tz")
HOLD = {"k": [1e-3, 1e-3, 1e-5, 1e-3, 1e-3, 1e-6, 1e-6, 1e-6, 1e-6], "e": [1e-6] * 6, "d": [1e-6] * 2, "g": [1e-6] * 3}
"""Sigmas with which a calibration is held: a hundredth of what matters."""


def departures(engine: Engine, posterior: Posterior) -> tuple[CalibrationEstimate, ...]:
    """Each calibration state against its prior."""
    rig, values = engine.rig, posterior.values
    rows: list[CalibrationEstimate] = []
    for camera in keys.CAMERA_INDEX:
        key = keys.intrinsics(camera)
        if values.exists(key):
            model = engine.cameras[camera]
            prior = np.sqrt(np.diag(intrinsics_covariance(model, getattr(rig.cameras, camera))))
            mean = np.array([model.fx, model.fy, 0.0, model.cx, model.cy, 0.0, 0.0, 0.0, 0.0])
            names = [f"{camera}.{part}" for part in INTRINSICS]
            rows += _rows(names, ["px"] * 5 + ["1"] * 4, values.atCal3DS2(key).vector(), mean, prior, posterior, key)
    right = keys.extrinsics("m_right")
    if values.exists(right):
        mean = left_T_right(engine.cameras["m_left"], engine.cameras["m_right"], rig.stereo)
        spread = np.sqrt(np.diag(stereo_sigmas(mean, rig.stereo)))
        rows += _pose_rows("m_left_T_m_right", mean, spread, posterior, right)
    colour = keys.extrinsics("b_rgb")
    if values.exists(colour):
        rows += _pose_rows("b_T_rgb", rgb_mean(rig.kinect), rgb_sigmas(rig.kinect), posterior, colour)
    if values.exists(keys.DEPTH):
        value, names = values.atVector(keys.DEPTH), ["depth_offset", "depth_scale"]
        rows += _rows(names, ["m", "1"], value, np.zeros(2), depth_sigmas(rig.kinect), posterior, keys.DEPTH)
    return tuple(row for row in rows if not row.name.endswith(".skew"))


def _pose_rows(
    name: str, mean: gtsam.Pose3, spread: Float, posterior: Posterior, key: int
) -> list[CalibrationEstimate]:
    moved = gtsam.Pose3.Logmap(mean.between(posterior.values.atPose3(key)))
    names = [f"{name}.{part}" for part in POSE]
    return _rows(names, ["rad"] * 3 + ["m"] * 3, moved, np.zeros(6), spread, posterior, key)


def _rows(
    names: list[str], units: list[str], value: Float, mean: Float, prior: Float, posterior: Posterior, key: int
) -> list[CalibrationEstimate]:
    own = np.sqrt(np.clip(np.diag(posterior.marginal(key)), 0.0, None))
    rows = zip(names, units, value, own, mean, prior, strict=True)
    return [CalibrationEstimate(n, u, float(v), float(s), float(m), float(p), False) for n, u, v, s, m, p in rows]


def hold(engine: Engine) -> Update:
    """Factors that hold the calibration where it is now."""
    values, update = engine.state.values, Update()
    for key in values.keys():
        kind = keys.kind(key)
        if kind not in HOLD:
            continue
        noise = sigmas(HOLD[kind])
        if kind == "k":
            factor: gtsam.NonlinearFactor = gtsam.PriorFactorCal3DS2(key, values.atCal3DS2(key), noise)
        elif kind == "e":
            factor = gtsam.PriorFactorPose3(key, values.atPose3(key), noise)
        else:
            factor = gtsam.PriorFactorVector(key, values.atVector(key), noise)
        update.add(factor, Record(FROZEN, FROZEN, engine.end_ns, f"{keys.words(key)} held", rejectable=False))
    return update


def held(engine: Engine) -> list[int]:
    """Places of those factors in the log."""
    return [i for i, _, record in engine.solver.log.active() if record.family == FROZEN]
