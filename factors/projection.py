"""Pixels of points in {o}: native GTSAM factors, with the camera's calibration as a variable."""

from typing import Any

import gtsam
import gtsam_unstable
import numpy as np
from numpy.typing import NDArray

from . import keys
from .geometry import point_to_frame
from .noise import Model, robust

Float = NDArray[np.float64]


def mobile_projection(camera: str, px: Float, model: Model, keyframe: int, point: int) -> gtsam.NonlinearFactor:
    """A point seen by the mobile camera, left or right.

    Args:
        camera: `m_left` or `m_right`.
        px: shape (2,), ideal pixels.
        keyframe: key of `o_T_m`.
        point: key of the point in {o}.
    """
    if camera == "m_left":
        return gtsam.GeneralSFMFactor2Cal3DS2(px, model, keyframe, point, keys.intrinsics(camera))
    return _with_extrinsics(camera, px, model, keyframe, point)


def reweighed(factor: Any, weight: float, robust_sigma: float) -> gtsam.NonlinearFactor:
    """A factor of `mobile_projection` or `machine_projection` with `weight` times its information."""
    whitening = np.sqrt(weight) * factor.noiseModel().noise().R()
    return factor.cloneWithNewNoiseModel(robust(gtsam.noiseModel.Gaussian.SqrtInformation(whitening), robust_sigma))


def machine_projection(px: Float, model: Model, base: int, point: int) -> gtsam.NonlinearFactor:
    """A point seen by the Kinect's colour camera, at ideal pixels `px`; `base` is the key of `o_T_b`."""
    return _with_extrinsics("b_rgb", px, model, base, point)


def _with_extrinsics(camera: str, px: Float, model: Model, pose: int, point: int) -> gtsam.NonlinearFactor:
    return gtsam_unstable.ProjectionFactorPPPCCal3DS2(
        px, model, pose, keys.extrinsics(camera), point, keys.intrinsics(camera)
    )


def depth_factor(keyframe: int, point: int, depth_m: float, noise: Model) -> gtsam.CustomFactor:
    """Depth of a point along the left camera's optical axis, residual (1,) in metres."""

    def error(factor: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Float] | None) -> Float:
        c_p, d_pose, d_point = point_to_frame(values.atPose3(keyframe), values.atPoint3(point))
        if jacobians is not None:
            jacobians[0] = d_pose[2:3]
            jacobians[1] = d_point[2:3]
        return np.array([c_p[2] - depth_m])

    return gtsam.CustomFactor(noise, [keyframe, point], error)
