"""A pipe as a cylinder: an axis through two points of {o}, and a radius. Outlines, picks and priors hold it.

Only the line through the two axis points means something; where they lie on it is fixed once, as a gauge.
"""

import gtsam
import numpy as np
from numpy.typing import NDArray

from . import keys
from .geometry import cross, point_to_frame
from .measurements import CylinderSighting
from .noise import Model, gaussian, sigmas

Float = NDArray[np.float64]

ON_AXIS_SIGMA_M = 1e-4
"""How exactly a cut point lies on the axis: a tenth of a millimetre, far below any measurement here."""


def line_planes(lines: Float, K: Float) -> tuple[Float, Float]:
    """Unit normals of the planes through the camera centre and image lines.

    Args:
        lines: shape (n, 3), homogeneous, in ideal pixels.
        K: shape (3, 3).

    Returns:
        normals (n, 3), and the lengths (n,) of `K^T l` that were divided out.
    """
    normals = lines @ K
    lengths = np.linalg.norm(normals, axis=1)
    return normals / lengths[:, None], lengths


def tangency(line: Float, K: Float, ends: Float, radius: float) -> tuple[Float, Float, float]:
    """An outline's plane touches the cylinder: `n . p = radius` for two points p of the axis in the camera frame.

    Args:
        line: shape (3,), oriented so that the axis lies on the positive side.
        ends: shape (2, 3).

    Returns:
        residual (2,) in metres, n (3,), and the length of `K^T l` that was divided out.
    """
    normal = line @ K
    length = float(np.sqrt(normal @ normal))
    normal = normal / length
    return ends @ normal - radius, normal, length


def tangency_covariance(line: Float, covariance: Float, foot_px: Float, K: Float, a: Float, b: Float) -> Float:
    """Covariance of `tangency`'s residual, shape (2, 2), from the line's own.

    Args:
        covariance: shape (2, 2), of the line's offset [px] at its foot and of its direction [rad].
        foot_px: shape (2,), the point of the line where the offset is meant.
        a, b: the axis points in the camera frame, as estimated.
    """
    _, lengths = line_planes(line[None], K)
    direction = np.array([-line[1], line[0]])
    G = np.empty((2, 2))
    for row, p in enumerate((a, b)):
        pixel = (K @ p)[:2] / p[2]
        # l . (u, v, 1) is the distance in pixels; n . p = z * that / |K^T l|
        G[row] = p[2] / lengths[0] * np.array([1.0, float(direction @ (pixel - foot_px))])
    return G @ covariance @ G.T + np.eye(2) * 1e-10


def outline_factor(camera: str, line: Float, noise: Model, pose: int, pipe: int) -> gtsam.CustomFactor:
    """One edge of a pipe in one image. It lies inside the true outline by the pipe's inset.

    Args:
        camera: `m_left`, `m_right` or `b_rgb`.
        line: shape (3,), see `tangency`.
        noise: of the residual (2,), see `tangency_covariance`.
        pose: key of `o_T_m` or `o_T_b`.
        pipe: index of the pipe.
    """
    variables = [pose, keys.intrinsics(camera), keys.axis_start(pipe), keys.axis_end(pipe), keys.radius(pipe)]
    variables.append(keys.inset(pipe))
    if camera != "m_left":
        variables.append(keys.extrinsics(camera))

    l0, l1, _ = (float(c) for c in line)

    def error(factor: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Float] | None) -> Float:
        o_T_c = values.atPose3(pose)
        c_T_s = values.atPose3(variables[6]) if len(variables) == 7 else None
        K = values.atCal3DS2(variables[1]).K()
        visible = float(values.atVector(variables[4])[0] - values.atVector(variables[5])[0])
        ends = np.array([values.atPoint3(variables[2]), values.atPoint3(variables[3])])
        seen = in_camera = (ends - o_T_c.translation()) @ o_T_c.rotation().matrix()
        if c_T_s is not None:
            seen = (in_camera - c_T_s.translation()) @ c_T_s.rotation().matrix()
        residual, normal, length = tangency(line, K, seen, visible)
        if jacobians is None:
            return residual
        # n = m / |m| with m = K^T l: d(n . p) = (p - (n . p) n) . dm / |m|
        across = (seen - (residual + visible)[:, None] * normal) / length
        d_K = np.zeros((2, 9))
        d_K[:, :5] = across[:, [0, 1, 1, 2, 2]] * (l0, l1, l0, l0, l1)
        jacobians[1] = d_K  # what the lens model leaves over is far below the sigma of edges
        if c_T_s is not None:
            jacobians[6] = _moved(normal, seen)
            normal = c_T_s.rotation().matrix() @ normal
        jacobians[0] = _moved(normal, in_camera)
        none = np.zeros((1, 3))
        by_point = (o_T_c.rotation().matrix() @ normal)[None, :]
        jacobians[2], jacobians[3] = np.concatenate([by_point, none]), np.concatenate([none, by_point])
        jacobians[4], jacobians[5] = np.full((2, 1), -1.0), np.full((2, 1), 1.0)
        return residual

    return gtsam.CustomFactor(noise, variables, error)


def _moved(normal: Float, points: Float) -> Float:
    """How `normal . p` of two points (2, 3) in a frame follows the frame's pose, rotation first, shape (2, 6)."""
    n = normal.tolist()
    return np.array([[*cross(n, p), -n[0], -n[1], -n[2]] for p in points.tolist()])


def on_axis_factor(point: int, pipe: int) -> gtsam.CustomFactor:
    """A cut point lies on the pipe's axis: its distance from the line, residual (3,) in metres (rank 2)."""
    variables = [point, keys.axis_start(pipe), keys.axis_end(pipe)]

    def error(factor: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Float] | None) -> Float:
        p, a, b = (values.atPoint3(key) for key in variables)
        length = float(np.linalg.norm(b - a))
        d = (b - a) / length
        across = np.eye(3) - np.outer(d, d)
        arm = float(d @ (p - a))
        if jacobians is not None:
            # residual = across (p - a); d turns with b - a
            turn = -(arm * across + np.outer(d, across @ (p - a))) / length
            jacobians[0] = across
            jacobians[1] = -across - turn
            jacobians[2] = turn
        return across @ (p - a)

    return gtsam.CustomFactor(sigmas([ON_AXIS_SIGMA_M] * 3), variables, error)


def axis_gauge(
    key: int, point: Float, direction: Float, along_m: float = 1e-3, across_m: float = 10.0
) -> gtsam.NonlinearFactor:
    """Fixes where an axis point lies along the axis; across it says nothing (10 m)."""
    d = direction / np.linalg.norm(direction)
    along = np.outer(d, d)
    return gtsam.PriorFactorPoint3(key, point, gaussian(along * along_m**2 + (np.eye(3) - along) * across_m**2))


def radius_prior(pipe: int, radius_m: float, sigma_m: float) -> gtsam.NonlinearFactor:
    """Half the nominal diameter, or a wide prior that says only what pipes there are."""
    return gtsam.PriorFactorVector(keys.radius(pipe), np.array([radius_m]), sigmas([sigma_m]))


def inset_prior(pipe: int, sigma_m: float) -> gtsam.NonlinearFactor:
    """What is known of an inset: images alone cannot tell it from a thinner pipe."""
    return gtsam.PriorFactorVector(keys.inset(pipe), np.zeros(1), sigmas([sigma_m]))


def across_axis(direction: Float) -> Float:
    """Two unit directions across a third one, shape (2, 3)."""
    e1 = np.cross(direction, np.eye(3)[int(np.argmin(np.abs(direction)))])
    e1 /= np.linalg.norm(e1)
    return np.asarray(np.stack([e1, np.cross(direction, e1)]), np.float64)


def cylinder_covariance(sighting: CylinderSighting) -> Float:
    """Covariance (5, 5) of a fitted cylinder as `cylinder_factor` sees it: across the axis."""
    E = _across_ends(sighting)
    information = E.T @ sighting.information @ E
    return np.asarray(np.linalg.inv(0.5 * (information + information.T)), np.float64)


def _across_ends(sighting: CylinderSighting) -> Float:
    """The five ways to change a cylinder: each end in two directions across, and the radius; shape (7, 5)."""
    way = sighting.point_b_m - sighting.point_a_m
    E = np.zeros((7, 5))
    E[:3, :2] = E[3:6, 2:4] = across_axis(way / np.linalg.norm(way)).T
    E[6, 4] = 1.0
    return E


def cylinder_factor(sighting: CylinderSighting, noise: Model, pose: int, pipe: int) -> gtsam.CustomFactor:
    """A cylinder fitted to a depth camera's cloud, as one summarised factor.

    The estimated axis passes the fitted one at the two fitted points: residual (5,) = offsets of the axis from
    point_a and from point_b in two directions across it, and the radius. Variables: the pose, the pipe, and with
    `by_depth` the depth camera's calibration, which the fit follows.

    Args:
        noise: of the residual, see `cylinder_covariance`.
        pose: key of the camera's pose in {o}.
    """
    ends = (sighting.point_a_m, sighting.point_b_m)
    d_fit = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
    E = across_axis(d_fit)
    response = np.zeros((7, 5)) if sighting.by_depth is None else sighting.by_depth
    by_depth = -_across_ends(sighting).T @ response
    variables = [pose, keys.axis_start(pipe), keys.axis_end(pipe), keys.radius(pipe)]
    if sighting.by_depth is not None:
        variables += [keys.DEPTH, keys.DEPTH_RAYS]

    def error(factor: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Float] | None) -> Float:
        o_T_c = values.atPose3(pose)
        a, Ja, Ra = point_to_frame(o_T_c, values.atPoint3(variables[1]))
        b, Jb, Rb = point_to_frame(o_T_c, values.atPoint3(variables[2]))
        residual = np.empty(5)
        d_a, d_b = np.zeros((5, 3)), np.zeros((5, 3))
        for i, q in enumerate(ends):
            offset, by_a, by_b = _axis_at(a, b, q, d_fit)
            rows = slice(2 * i, 2 * i + 2)
            residual[rows] = E @ offset
            d_a[rows], d_b[rows] = E @ by_a, E @ by_b
        residual[4] = values.atVector(variables[3])[0] - sighting.radius_m
        if len(variables) == 6:
            residual += by_depth @ np.concatenate([values.atVector(keys.DEPTH), values.atVector(keys.DEPTH_RAYS)])
        if jacobians is not None:
            jacobians[0] = d_a @ Ja + d_b @ Jb
            jacobians[1] = d_a @ Ra
            jacobians[2] = d_b @ Rb
            jacobians[3] = np.array([[0.0], [0.0], [0.0], [0.0], [1.0]])
            if len(variables) == 6:
                jacobians[4], jacobians[5] = by_depth[:, :2], by_depth[:, 2:]
        return residual

    return gtsam.CustomFactor(noise, variables, error)


def _axis_at(a: Float, b: Float, q: Float, normal: Float) -> tuple[Float, Float, Float]:
    """Where the line a-b crosses the plane through q with `normal`, less q; Jacobians for a and b."""
    slope = float(normal @ (b - a))
    s = float(normal @ (q - a)) / slope
    offset = a + s * (b - a) - q
    ds_a = (s - 1.0) * normal / slope
    ds_b = -s * normal / slope
    return offset, (1 - s) * np.eye(3) + np.outer(b - a, ds_a), s * np.eye(3) + np.outer(b - a, ds_b)
