"""A camera as data: pinhole with a distortion, in OpenCV's pixel convention."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class CameraModel:
    """Intrinsics of one camera. Pixel (0, 0) is the centre of the top left pixel.

    Measurements reach the graph as *ideal* pixels: undistorted, and projected with `K` alone, in the camera's own
    (not a rectified) optical frame.
    """

    name: str
    """`m_left`, `m_right`, `b_rgb` or `b_depth`."""
    width: int
    height: int
    K: Float
    """Shape (3, 3), pixels."""
    distortion_model: str
    """`none`, `plumb_bob`, `rational_polynomial` or `equidistant`."""
    D: Float
    """Shape (n,), the coefficients of that model."""
    rectification: Float
    """Shape (3, 3): rotates a direction of the optical frame into the rectified frame (`CameraInfo.r`)."""
    baseline_m: float | None
    """-P[0, 3] / P[0, 0]: distance from the left camera along the rectified x axis; None or 0 for the left one."""

    @property
    def fx(self) -> float:
        return float(self.K[0, 0])

    @property
    def fy(self) -> float:
        return float(self.K[1, 1])

    @property
    def cx(self) -> float:
        return float(self.K[0, 2])

    @property
    def cy(self) -> float:
        return float(self.K[1, 2])


def rectified_pair(left: CameraModel, right: CameraModel) -> Float:
    """`left_T_right`, shape (4, 4), of two cameras' optical frames, as their rectification states it.

    A direction d_left rectifies to R_left d_left, and the rectified right camera sits at (baseline, 0, 0) in the
    rectified left frame: `left_T_right = R_left^T * Translation(b, 0, 0) * R_right`.
    """
    pose = np.eye(4)
    pose[:3, :3] = left.rectification.T @ right.rectification
    pose[:3, 3] = left.rectification.T @ np.array([right.baseline_m or 0.0, 0.0, 0.0])
    return pose
