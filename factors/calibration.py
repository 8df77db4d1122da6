"""Priors of the calibration states, from the rig file and the cameras' own data."""

import gtsam
import numpy as np
from numpy.typing import NDArray

from . import keys
from .camera import CameraModel, rectified_pair
from .geometry import pose3, pose_from_vectors
from .noise import gaussian, sigmas
from .rig import Camera, Kinect, Stereo

Float = NDArray[np.float64]

FROZEN_FOCAL_REL = 1e-7
FROZEN_PX = 1e-4
FROZEN_RAD = 1e-7
FROZEN_M = 1e-7
FROZEN_LENS = 1e-8
TANGENTIAL_SHARE = 0.2
"""Tangential distortion of a lens is a small part of its radial one."""
ASPECT_REL = 2e-4
"""fx and fy of one lens differ by the sensor's pixel aspect only, which is known much better than the focal length."""


def cal3(camera: CameraModel) -> gtsam.Cal3DS2:
    """The pinhole of a camera; pixels in the graph are ideal ones, so its remaining distortion starts at zero."""
    return gtsam.Cal3DS2(camera.fx, camera.fy, 0.0, camera.cx, camera.cy, 0.0, 0.0, 0.0, 0.0)


def intrinsics_covariance(camera: CameraModel, settings: Camera) -> Float:
    """Covariance of (fx, fy, skew, cx, cy, k1, k2, p1, p2), shape (9, 9); fx and fy share their relative error.

    k and p are what the given lens model leaves over (radial and tangential, Brown 1966), at the normalised radius 1.
    """
    focal = FROZEN_FOCAL_REL if "focal" in settings.freeze else max(settings.focal_sigma_rel, FROZEN_FOCAL_REL)
    centre = FROZEN_PX if "centre" in settings.freeze else max(settings.centre_sigma_px, FROZEN_PX)
    lens = FROZEN_LENS if "distortion" in settings.freeze else max(settings.distortion_sigma, FROZEN_LENS)
    f = np.array([camera.fx, camera.fy])
    radial, tangential = lens**2, (TANGENTIAL_SHARE * lens) ** 2
    covariance = np.diag([0.0, 0.0, 1e-10, centre**2, centre**2, radial, radial, tangential, tangential])
    covariance[:2, :2] = focal**2 * np.outer(f, f) + np.diag((min(ASPECT_REL, focal) * f) ** 2)
    return covariance


def intrinsics_prior(name: str, camera: CameraModel, settings: Camera) -> gtsam.NonlinearFactor:
    """Prior of a camera's intrinsics."""
    return gtsam.PriorFactorCal3DS2(
        keys.intrinsics(name), cal3(camera), gaussian(intrinsics_covariance(camera, settings))
    )


def left_T_right(left: CameraModel, right: CameraModel, stereo: Stereo) -> gtsam.Pose3:
    """The right camera's optical frame in the left one's, from the rig or from the camera_info pair."""
    if stereo.m_left_T_m_right is not None:
        given = stereo.m_left_T_m_right
        return pose_from_vectors(given.translation_m, given.rotation_vector_rad)
    return pose3(rectified_pair(left, right))


def stereo_sigmas(mean: gtsam.Pose3, stereo: Stereo) -> Float:
    """Covariance of `m_left_T_m_right`, shape (6, 6), rotation first, body frame of the right camera."""
    if stereo.freeze:
        return np.diag([FROZEN_RAD**2] * 3 + [FROZEN_M**2] * 3)
    t = mean.rotation().matrix().T @ mean.translation()
    baseline = float(np.linalg.norm(t))
    along = t / baseline if baseline > 0 else np.array([1.0, 0.0, 0.0])
    across = max(stereo.translation_sigma_m, FROZEN_M) ** 2
    length = max(stereo.baseline_sigma_rel * baseline, FROZEN_M) ** 2
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = np.eye(3) * max(stereo.rotation_sigma_rad, FROZEN_RAD) ** 2
    covariance[3:, 3:] = across * (np.eye(3) - np.outer(along, along)) + length * np.outer(along, along)
    return covariance


def stereo_prior(mean: gtsam.Pose3, stereo: Stereo) -> gtsam.NonlinearFactor:
    return gtsam.PriorFactorPose3(keys.extrinsics("m_right"), mean, gaussian(stereo_sigmas(mean, stereo)))


def rgb_mean(kinect: Kinect) -> gtsam.Pose3:
    return pose_from_vectors(kinect.b_T_rgb.translation_m, kinect.b_T_rgb.rotation_vector_rad)


def rgb_sigmas(kinect: Kinect) -> Float:
    """Sigmas of `b_T_rgb`, shape (6,), rotation first."""
    frozen = "b_T_rgb" in kinect.freeze
    rotation = FROZEN_RAD if frozen else max(kinect.b_T_rgb_rotation_sigma_rad, FROZEN_RAD)
    translation = FROZEN_M if frozen else max(kinect.b_T_rgb_translation_sigma_m, FROZEN_M)
    return np.array([rotation] * 3 + [translation] * 3)


def rgb_prior(kinect: Kinect) -> gtsam.NonlinearFactor:
    return gtsam.PriorFactorPose3(keys.extrinsics("b_rgb"), rgb_mean(kinect), sigmas(rgb_sigmas(kinect)))


def depth_sigmas(kinect: Kinect) -> Float:
    """Sigmas of (offset [m], scale), shape (2,)."""
    offset = FROZEN_M if "depth_offset" in kinect.freeze else max(kinect.depth_offset_sigma_m, FROZEN_M)
    scale = FROZEN_M if "depth_scale" in kinect.freeze else max(kinect.depth_scale_sigma, FROZEN_M)
    return np.array([offset, scale])


def depth_prior(kinect: Kinect) -> gtsam.NonlinearFactor:
    return gtsam.PriorFactorVector(keys.DEPTH, np.zeros(2), sigmas(depth_sigmas(kinect)))


def depth_ray_sigmas(camera: Camera, focal_px: float) -> Float:
    """Sigmas of a depth camera's rays (shift x, shift y [rad], scale), shape (3,)."""
    centre = FROZEN_RAD if "centre" in camera.freeze else max(camera.centre_sigma_px / focal_px, FROZEN_RAD)
    scale = FROZEN_RAD if "focal" in camera.freeze else max(camera.focal_sigma_rel, FROZEN_RAD)
    return np.array([centre, centre, scale])


def depth_ray_prior(camera: Camera, focal_px: float) -> gtsam.NonlinearFactor:
    return gtsam.PriorFactorVector(keys.DEPTH_RAYS, np.zeros(3), sigmas(depth_ray_sigmas(camera, focal_px)))
