"""Points of the tracks in the last keyframe's camera: measured by stereo, carried along and averaged."""

import numpy as np

from .geometry import Float, StereoGeometry, inverse, project, transform
from .motion import point_covariance
from .sighting import Sighting
from .tracks import Tracks
from .vertical import VerticalCorrection
from .warp import inverse_each, transform_each

_FORGETTING = 1.1
"""Growth of a point's covariance from keyframe to keyframe: the motion between them is not known exactly."""


def carry(tracks: Tracks, keyframe_T_this: Float) -> None:
    """Takes the points to a new keyframe's camera."""
    rotation = keyframe_T_this[:3, :3]
    tracks.points = transform(inverse(keyframe_T_this), tracks.points)
    tracks.points_covariance = rotation.T @ tracks.points_covariance @ rotation * _FORGETTING


def measure(
    tracks: Tracks, sighting: Sighting, chain_T_this: Float, rig: StereoGeometry, vertical: VerticalCorrection
) -> None:
    """Fuses the points with what this keyframe's two images say, and sets what depends on them."""
    measured = rig.triangulate(sighting.left_px, vertical.apply(sighting.left_px, sighting.right_px))
    seen = np.asarray(np.isfinite(measured).all(axis=1))
    covariance = np.full((len(tracks), 3, 3), np.nan)
    covariance[seen] = point_covariance(measured[seen], sighting.covariance[seen], rig)
    known = np.isfinite(tracks.points).all(axis=1) & np.isfinite(tracks.points_covariance).all(axis=(1, 2))
    fresh, both = seen & ~known, seen & known
    tracks.points[fresh], tracks.points_covariance[fresh] = measured[fresh], covariance[fresh]
    old, new = np.linalg.inv(tracks.points_covariance[both]), np.linalg.inv(covariance[both])
    joint = np.linalg.inv(old + new)
    weighted = old @ tracks.points[both][:, :, None] + new @ measured[both][:, :, None]
    tracks.points[both] = (joint @ weighted)[:, :, 0]
    tracks.points_covariance[both] = joint
    offset = sighting.right_px - project(rig.right_points(tracks.points), rig.right)
    tracks.right_offset_px = np.where(np.isfinite(offset), offset, 0.0)
    _reference_points(tracks, chain_T_this)


def _reference_points(tracks: Tracks, chain_T_this: Float) -> None:
    """Points in the cameras of their reference patches, where they were not known before."""
    unset = ~np.isfinite(tracks.patch_points).all(axis=1) & np.isfinite(tracks.points).all(axis=1)
    patch_T_this = inverse_each(tracks.patch_poses[unset]) @ chain_T_this
    tracks.patch_points[unset] = transform_each(patch_T_this, tracks.points[unset])
