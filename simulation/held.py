"""Parts of the truth, held in a graph: how large would the error be if they were known? For evaluation only."""

from collections.abc import Callable

import gtsam
import numpy as np
from numpy.typing import NDArray

from ..estimator.engine import Engine
from ..estimator.graph import FactorLog, Record, Update
from ..factors import keys
from ..factors.noise import pose_sigmas, sigmas
from .measurement_level_truth import Truth, transform

Float = NDArray[np.float64]

HELD_M, HELD_RAD, HELD_PX, HELD_LENS = 1e-5, 1e-5, 1e-3, 1e-6
"""Sigmas with which the truth is held: far below every error that is looked for, and still well conditioned."""


def with_truth(engine: Engine, held: Update) -> FactorLog:
    """The factors of a run and the held truth; the run's own log stays as it is."""
    log = FactorLog()
    log.factors, log.records = [*engine.solver.log.factors], [*engine.solver.log.records]
    log.off = set(engine.solver.log.off)
    log.append(held)
    return log


def true_poses(engine: Engine, truth: Truth) -> Update:
    """Every keyframe and every board."""
    update = Update()
    at = dict(zip(truth.stamps_ns, truth.o_T_m, strict=True))
    for index, stamp_ns in enumerate(engine.odometry.keyframe_stamps):
        if stamp_ns in at:
            _hold_pose(update, keys.keyframe(index), at[stamp_ns])
    for board_id, o_T_f in truth.o_T_f.items():
        if engine.boards.known(board_id):
            _hold_pose(update, engine.boards.key(board_id), o_T_f)
    return update


def true_mount(engine: Engine, truth: Truth) -> Update:
    """Where the machine's camera really is on the page that its mount names."""
    update, mount = Update(), engine.rig.mount
    if mount is not None and engine.machine.mounted:
        pose, model = gtsam.Pose3(truth.rig.f_T_b), pose_sigmas(HELD_RAD, HELD_M)
        factor = gtsam.BetweenFactorPose3(engine.boards.key(mount.board), engine.base, pose, model)
        update.add(factor, _record("mount"))
    return update


def true_calibration(engine: Engine, truth: Truth) -> Update:
    """Lenses, the place of the right and of the colour camera, offset, scale and rays of the depth."""
    update, rig, has = Update(), truth.rig, engine.state.has
    extrinsics = {"m_right": rig.m_left_T_m_right, "b_rgb": rig.b_T_rgb}
    for name, camera in rig.cameras.items():
        if name not in keys.CAMERA_INDEX or not has(keys.intrinsics(name)):
            continue
        K = camera.K
        mean = gtsam.Cal3DS2(K[0, 0], K[1, 1], 0.0, K[0, 2], K[1, 2], 0.0, 0.0, 0.0, 0.0)
        model = sigmas([HELD_PX] * 2 + [HELD_LENS] + [HELD_PX] * 2 + [HELD_LENS] * 4)
        update.add(gtsam.PriorFactorCal3DS2(keys.intrinsics(name), mean, model), _record(f"intrinsics {name}"))
        if name in extrinsics:
            _hold_pose(update, keys.extrinsics(name), extrinsics[name])
    if has(keys.DEPTH):
        depth = np.array([rig.depth_offset_m, rig.depth_scale])
        update.add(gtsam.PriorFactorVector(keys.DEPTH, depth, sigmas([HELD_M, HELD_LENS])), _record("depth"))
        rays = gtsam.PriorFactorVector(keys.DEPTH_RAYS, rig.depth_rays, sigmas([HELD_RAD] * 3))
        update.add(rays, _record("rays of the depth camera"))
    return update


def true_cylinder(engine: Engine, truth: Truth) -> Update:
    """Axis and radius of the pipe in {o}: what is left comes from clicks and from the place of {b}."""
    update = Update()
    cylinder = engine.pipes.cylinders.get("pipe0")
    if cylinder is None or not cylinder.known:
        return update
    i = cylinder.index
    point, axis = transform(truth.o_T_b, truth.pipe.point_b_m), truth.o_T_b[:3, :3] @ truth.pipe.axis_b
    for key in (keys.axis_start(i), keys.axis_end(i)):
        # Each end stays where it is along the axis, and lies on the true line.
        place = point + axis * float(axis @ (engine.state.point(key) - point))
        along = np.outer(axis, axis)
        model = gtsam.noiseModel.Gaussian.Covariance(along + (np.eye(3) - along) * HELD_M**2)
        update.add(gtsam.PriorFactorPoint3(key, place, model), _record("axis"))
    radius = gtsam.PriorFactorVector(keys.radius(i), np.array([truth.pipe.radius_m]), sigmas([HELD_M]))
    update.add(radius, _record("radius"))
    return update


def everything_but_clicks(engine: Engine, truth: Truth) -> Update:
    """All of the above: only the clicks are left."""
    update = Update()
    for part in (true_poses, true_mount, true_calibration, true_cylinder):
        update.extend(part(engine, truth))
    return update


HOLDS: dict[str, Callable[[Engine, Truth], Update]] = {
    "true poses of camera and boards": true_poses,
    "true mount": true_mount,
    "true calibration": true_calibration,
    "true cylinder": true_cylinder,
    "all of these": everything_but_clicks,
}


def _hold_pose(update: Update, key: int, pose: Float) -> None:
    factor = gtsam.PriorFactorPose3(key, gtsam.Pose3(pose), pose_sigmas(HELD_RAD, HELD_M))
    update.add(factor, _record(keys.words(key)))


def _record(what: str) -> Record:
    return Record("truth", "truth", 0, f"truth of {what}", rejectable=False)
