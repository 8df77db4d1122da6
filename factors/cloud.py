"""The Kinect's surface: a landmark of the mobile camera lies on a plane that the Kinect measured."""

import gtsam
import numpy as np
from numpy.typing import NDArray

from . import keys
from .geometry import point_to_frame
from .noise import Model

Float = NDArray[np.float64]


def corrected(points_m: Float, offset_m: float, scale: float) -> Float:
    """Kinect points with depth offset and scale applied along their rays, shape (..., 3).

    true depth = measured * (1 + scale) + offset; the ray of a pixel does not change.
    """
    return points_m * (1.0 + scale + offset_m / points_m[..., 2:3])


def plane_factor(base: int, landmark: int, plane_point_m: Float, normal: Float, noise: Model) -> gtsam.CustomFactor:
    """`normal . (b_p - c)` = 0 for a landmark p of {o} on the surface through c in {b}.

    Residual (1,), metres. Variables: `o_T_b`, the landmark, the depth offset and scale, which move c along its ray.
    """
    along = float(normal @ plane_point_m)
    depth_jacobian = np.array([[-along / plane_point_m[2], -along]])

    def error(factor: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Float] | None) -> Float:
        b_p, d_pose, d_point = point_to_frame(values.atPose3(base), values.atPoint3(landmark))
        offset, scale = values.atVector(keys.DEPTH)
        if jacobians is not None:
            jacobians[0] = normal[None, :] @ d_pose
            jacobians[1] = normal[None, :] @ d_point
            jacobians[2] = depth_jacobian
        return np.array([normal @ (b_p - corrected(plane_point_m, offset, scale))])

    return gtsam.CustomFactor(noise, [base, landmark, keys.DEPTH], error)
