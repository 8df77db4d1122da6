"""The Kinect's surface: a landmark of the mobile camera lies on a plane that the Kinect measured."""

import gtsam
import numpy as np
from numpy.typing import NDArray

from . import keys
from .geometry import cross, seen_from
from .noise import Model

Float = NDArray[np.float64]


def corrected(points_m: Float, offset_m: float, scale: float, rays: Float | None = None) -> Float:
    """Kinect points with the depth camera's calibration states applied, shape (..., 3).

    true depth = measured * (1 + scale) + offset, and the pixel's ray moves by `rays`, see `keys.DEPTH_RAYS`.
    """
    moved = points_m * (1.0 + scale + offset_m / points_m[..., 2:3])
    if rays is not None:
        moved[..., :2] = moved[..., :2] * (1.0 + rays[2]) + moved[..., 2:] * rays[:2]
    return moved


def depth_states(values: gtsam.Values) -> tuple[float, float, Float]:
    """Offset [m], scale and rays of the depth camera, as `corrected` takes them."""
    offset, scale = values.atVector(keys.DEPTH)
    return float(offset), float(scale), values.atVector(keys.DEPTH_RAYS)


def depth_moves(points_m: Float, offset_m: float = 0.0, scale: float = 0.0, rays: Float | None = None) -> Float:
    """How `corrected` follows its states: d p / d (offset, scale, shift x, shift y, ray scale).

    Args:
        points_m: shape (n, 3), as measured.

    Returns:
        shape (n, 3, 5).
    """
    by_depth = [corrected(p, 0.0, 0.0, rays) for p in (points_m / points_m[:, 2:], points_m)]
    x, y, z = np.moveaxis(corrected(points_m, offset_m, scale), -1, 0)
    none = np.zeros_like(z)
    by_rays = [np.stack(c, -1) for c in ((z, none, none), (none, z, none), (x, y, none))]
    return np.asarray(np.stack([*by_depth, *by_rays], axis=2), np.float64)


def plane_factor(base: int, landmark: int, plane_point_m: Float, normal: Float, noise: Model) -> gtsam.CustomFactor:
    """`normal . (b_p - c)` = 0 for a landmark p of {o} on the surface through c in {b}.

    Residual (1,), metres. Variables: `o_T_b`, the landmark, and the depth camera's calibration, which moves c.
    """

    x, y, z = (float(c) for c in plane_point_m)
    n = (float(normal[0]), float(normal[1]), float(normal[2]))

    def error(factor: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Float] | None) -> Float:
        offset, scale = values.atVector(keys.DEPTH).tolist()
        right, down, wider = values.atVector(keys.DEPTH_RAYS).tolist()
        o_T_b = values.atPose3(base)
        b_p = seen_from(o_T_b, values.atPoint3(landmark))
        deeper = 1.0 + scale + offset / z
        # As `corrected`, in scalars: there are hundreds of these factors, each of one number.
        ray = (x * (1.0 + wider) + z * right, y * (1.0 + wider) + z * down, z)
        along = n[0] * ray[0] + n[1] * ray[1] + n[2] * ray[2]
        if jacobians is not None:
            jacobians[0] = np.array([[*cross(n, b_p.tolist()), -n[0], -n[1], -n[2]]])
            jacobians[1] = (o_T_b.rotation().matrix() @ normal)[None, :]
            jacobians[2] = np.array([[-along / z, -along]])
            jacobians[3] = -deeper * np.array([[n[0] * z, n[1] * z, n[0] * x + n[1] * y]])
        return np.array([float(normal @ b_p) - deeper * along])

    return gtsam.CustomFactor(noise, [base, landmark, keys.DEPTH, keys.DEPTH_RAYS], error)
