"""What a calibration that is not quite right adds to the places of points seen again."""

import numpy as np

from .geometry import Float, StereoGeometry
from .settings import StereoSettings


def of_calibration(
    points: Float, px: Float, reference_T_this: Float, rig: StereoGeometry, settings: StereoSettings
) -> Float:
    """Covariance (n, 4, 4) of left and right pixels, by focal length and principal point, first order.

    An error of the calibration moves a point in the reference's image too; what counts is by how much more it moves it
    in this one. Gates that leave it out let go of tracks near the edge of a turning camera's image, and keep those that
    happen to err towards the nominal calibration: the graph would believe it more than its prior does.

    Args:
        points: (n, 3) in the reference's left camera.
        px: (n, 4), ideal left and right pixels in this frame; the left ones count.
        reference_T_this: (4, 4), about.
        rig: nominal geometry; both cameras err alike.
        settings: with the calibration's sigmas.
    """
    camera, n = rig.left, len(points)
    focal = np.array([[camera.fx], [camera.fy]])
    centre = np.array([[camera.cx], [camera.cy]])
    turn = reference_T_this[:3, :3].T[:, :, None]
    here = reference_T_this[:3, :3].T @ (points.T - reference_T_this[:3, 3:])
    depth = np.maximum(here[2], 1e-3)
    plane = here[:2] / depth
    carried = (turn[:2, :2] - plane[:, None] * turn[2, :2]) * (points[:, 2] / (camera.fx * depth) * focal)[:, None]
    """Derivative (2, 2, n) of pixels in this frame by those in the reference's."""
    ahead = np.where(points[:, 2] > 1e-6, points[:, 2], np.nan)
    reference = focal * points[:, :2].T / ahead
    both = np.empty((2, 3, n))
    both[:, 0] = settings.focal_sigma_rel * (px[:, :2].T - centre - (carried * reference).sum(axis=1))
    both[:, 1:] = settings.centre_sigma_px * (np.eye(2)[:, :, None] - carried)
    both[np.isnan(both)] = 0.0
    one = (both[:, None] * both).sum(axis=2)
    covariance = np.empty((n, 2, 2, 2, 2))  # of left or right, u or v, with left or right, u or v
    covariance[:] = one.transpose(2, 0, 1)[:, None, :, None, :]
    return covariance.reshape(n, 4, 4)
