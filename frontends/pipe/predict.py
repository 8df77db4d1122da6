"""Where a pipe that is known roughly should show its outline: the way to many views without picks."""

import numpy as np
from numpy.typing import NDArray

from ...factors.camera import CameraModel
from ...factors.outline import outline_lines
from .pairs import OutlinePrior

Float = NDArray[np.float64]

_NEAREST_M = 0.1
_BORDER_PX = 10.0
_POINTS = 101


def predict_outline(
    camera: CameraModel, point_a: Float, point_b: Float, radius_m: float, position_sigma_m: float,
    rotation_sigma_rad: float, radius_sigma_m: float,
) -> OutlinePrior | None:  # fmt: skip
    """The outline that a pipe between two axis points should show; None where it is out of sight.

    The prior is centred on the middle of the part of the pipe that is in the image.

    Args:
        camera: The camera; the points are in its optical frame.
        point_a: Shape (3,), metres, one end of the pipe's known part.
        point_b: Shape (3,), the other end.
        radius_m: Metres.
        position_sigma_m: Standard deviation of the axis across the view (pose and axis together).
        rotation_sigma_rad: Standard deviation of its direction.
        radius_sigma_m: Standard deviation of the radius.
    """
    points = _in_sight(camera, point_a, point_b)
    if len(points) < 2:
        return None
    middle = points[len(points) // 2]
    lines = outline_lines(middle, point_b - point_a, radius_m, camera.K)
    if lines is None:
        return None
    return _prior(camera, middle, lines, position_sigma_m, rotation_sigma_rad, radius_sigma_m)


def part_in_sight(camera: CameraModel, point_a: Float, point_b: Float) -> bool:
    """Does an image show at least a third of the axis between two points of the camera's frame?"""
    return 3 * len(_in_sight(camera, point_a, point_b)) > _POINTS


def _in_sight(camera: CameraModel, point_a: Float, point_b: Float) -> Float:
    """Those of evenly spaced points of the axis that are in the image."""
    points = point_a + np.linspace(0, 1, _POINTS)[:, None] * (point_b - point_a)
    points = points[points[:, 2] > _NEAREST_M]
    px = points @ camera.K.T
    px = px[:, :2] / px[:, 2:]
    seen = (px > _BORDER_PX).all(axis=1) & (px < np.array([camera.width, camera.height]) - _BORDER_PX).all(axis=1)
    return np.asarray(points[seen], np.float64)


def _prior(
    camera: CameraModel, middle: Float, lines: Float, position_sigma_m: float, rotation_sigma_rad: float,
    radius_sigma_m: float,
) -> OutlinePrior:  # fmt: skip
    px = camera.K @ middle
    px = px[:2] / px[2]
    sides = lines @ np.append(px, 1.0)
    across = lines[0, :2] - lines[1, :2]
    across /= np.linalg.norm(across)
    half_width = -0.5 * float(sides.sum())
    centre = px - 0.5 * float(sides[0] - sides[1]) * across
    scale = camera.fx / float(middle[2])
    return OutlinePrior(
        centre_px=centre,
        middle_sigma_px=float(np.hypot(scale * position_sigma_m, camera.fx * 0.1 * rotation_sigma_rad)),
        half_width_px=half_width,
        half_width_sigma_px=float(np.hypot(scale * radius_sigma_m, half_width * position_sigma_m / middle[2])),
        direction_rad=float(np.mod(np.arctan2(across[0], -across[1]), np.pi)),
        direction_sigma_rad=float(np.hypot(rotation_sigma_rad, 0.01)),
    )
