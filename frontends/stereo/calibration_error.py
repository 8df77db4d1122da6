"""What a calibration that is not quite right adds to the places of points seen again."""

import numpy as np

from .geometry import Float, StereoGeometry, inverse, project, projection_jacobian, transform
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
    camera = rig.left
    centre = np.array([camera.cx, camera.cy])
    here = transform(inverse(reference_T_this), points)
    here[:, 2] = np.maximum(here[:, 2], 1e-3)
    by_point = projection_jacobian(here, camera) @ reference_T_this[:3, :3].T
    carried = by_point[:, :, :2] * (points[:, 2] / camera.fx)[:, None, None]
    """Derivative (n, 2, 2) of pixels in this frame by those in the reference's."""
    reference = project(points, camera) - centre
    by_focal = px[:, :2] - centre - np.einsum("nij,nj->ni", carried, reference)
    by_centre = np.eye(2) - carried
    both = np.concatenate(
        (settings.focal_sigma_rel * by_focal[:, :, None], settings.centre_sigma_px * by_centre), axis=2
    )
    both = np.nan_to_num(np.concatenate((both, both), axis=1))
    return both @ both.transpose(0, 2, 1)
