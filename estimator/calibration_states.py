"""Calibration states enter the graph with their priors when their camera first delivers something."""

from collections.abc import Mapping

import numpy as np

from ..factors import keys
from ..factors.calibration import (
    cal3,
    depth_prior,
    depth_ray_prior,
    intrinsics_prior,
    left_T_right,
    rgb_mean,
    rgb_prior,
    stereo_prior,
)
from ..factors.camera import CameraModel
from ..factors.rig import Rig
from .bundle import Bundle
from .graph import Record, State, Update

NOMINAL_DEPTH_FOCAL_PX = 580.0
"""Of a Kinect v1, where clouds come without camera_info: turns the rig file's pixels into angles."""


def opened_calibration(state: State, rig: Rig, cameras: Mapping[str, CameraModel], bundle: Bundle) -> Update:
    """States and priors of the cameras that a bundle is the first to hold something of."""
    used = {s.camera for s in bundle.sightings} | {p.camera for p in bundle.picks}
    if bundle.frame is not None:
        used |= {"m_left", "m_right"}
    if "m_right" in used:
        used.add("m_left")
    update = Update()
    for camera in sorted(used):
        if camera in keys.CAMERA_INDEX and not state.has(keys.intrinsics(camera)):
            _open_camera(camera, rig, cameras, bundle.stamp_ns, update)
    if bundle.cloud is not None and not state.has(keys.DEPTH):
        _open_depth(rig, cameras, bundle.stamp_ns, update)
    return update


def _open_camera(camera: str, rig: Rig, cameras: Mapping[str, CameraModel], stamp_ns: int, update: Update) -> None:
    model = cameras[camera]
    update.guess(keys.intrinsics(camera), cal3(model))
    prior = intrinsics_prior(camera, model, getattr(rig.cameras, camera))
    update.add(prior, _prior(f"intrinsics {camera}", stamp_ns))
    if camera == "m_right":
        mean = left_T_right(cameras["m_left"], model, rig.stereo)
        update.guess(keys.extrinsics(camera), mean)
        update.add(stereo_prior(mean, rig.stereo), _prior("m_left_T_m_right", stamp_ns))
    if camera == "b_rgb":
        update.guess(keys.extrinsics(camera), rgb_mean(rig.kinect))
        update.add(rgb_prior(rig.kinect), _prior("b_T_rgb", stamp_ns))


def _open_depth(rig: Rig, cameras: Mapping[str, CameraModel], stamp_ns: int, update: Update) -> None:
    update.guess(keys.DEPTH, np.zeros(2))
    update.add(depth_prior(rig.kinect), _prior("Kinect depth", stamp_ns))
    update.guess(keys.DEPTH_RAYS, np.zeros(3))
    prior = depth_ray_prior(rig.cameras.b_depth, depth_focal_px(cameras.get("b_depth")))
    update.add(prior, _prior("rays of the depth camera", stamp_ns))


def depth_focal_px(camera: CameraModel | None) -> float:
    """Focal length of the depth camera, nominal where it has no calibration."""
    return NOMINAL_DEPTH_FOCAL_PX if camera is None else camera.fx


def _prior(name: str, stamp_ns: int) -> Record:
    return Record("calibration priors", name, stamp_ns, f"prior of {name}", rejectable=False)
