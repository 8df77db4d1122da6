"""The outline of a cylinder in a pinhole image: where its edges are, and what an edge says about the cylinder.

A plane through the camera centre and an occluding edge touches the cylinder. With its unit normal n pointing away
from the pipe, each point p of the axis has n . p = -radius (camera frame). So an edge, which is a line of the image
with two degrees of freedom, gives one residual at each of two points of the axis.
"""

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]


def plane_normal(line: Float, K: Float) -> Float:
    """Unit normal (camera frame) of the plane through the camera centre and an image line, shape (3,).

    Args:
        line: Shape (3,), l . (u, v, 1) = 0, ideal pixels; positive on the side that the normal points to.
        K: Shape (3, 3).
    """
    normal = K.T @ line
    return normal / np.linalg.norm(normal)


def outline_residual(line: Float, K: Float, point_a: Float, point_b: Float, radius: float) -> tuple[Float, Float]:
    """Distance of two axis points from where the edge's tangent plane puts them, and its Jacobian.

    Args:
        line: Shape (3,), the edge, positive outside the pipe.
        K: Shape (3, 3).
        point_a: Shape (3,), a point of the axis in the camera frame, metres.
        point_b: Shape (3,), another one.
        radius: Metres.

    Returns:
        Residuals n . a + radius and n . b + radius, shape (2,), metres, and the Jacobian with respect to
        (point_a, point_b, radius), shape (2, 7).
    """
    normal = plane_normal(line, K)
    jacobian = np.zeros((2, 7))
    jacobian[0, 0:3] = jacobian[1, 3:6] = normal
    jacobian[:, 6] = 1.0
    return np.array([normal @ point_a + radius, normal @ point_b + radius]), jacobian


def outline_noise(line: Float, foot_px: Float, covariance: Float, K: Float, point_a: Float, point_b: Float) -> Float:
    """Covariance of the two residuals of `outline_residual`, shape (2, 2), m^2.

    Args:
        line: Shape (3,), the edge.
        foot_px: Shape (2,), the point of the line about which its covariance is given.
        covariance: Shape (2, 2), of (offset in px along the line's normal, direction in rad).
        K: Shape (3, 3).
        point_a: Shape (3,), metres, camera frame.
        point_b: Shape (3,).
    """
    along = np.array([-line[1], line[0]])
    turn = np.array([along[0], along[1], -along @ foot_px])
    by_line = np.column_stack((np.array([0.0, 0.0, -1.0]), turn))
    normal = K.T @ line
    length = np.linalg.norm(normal)
    unit = normal / length
    by_parameters = (np.eye(3) - np.outer(unit, unit)) @ K.T @ by_line / length
    jacobian = np.vstack((point_a, point_b)) @ by_parameters
    return jacobian @ covariance @ jacobian.T


def outline_lines(point: Float, axis: Float, radius: float, K: Float) -> Float | None:
    """The two edges of a cylinder as image lines, shape (2, 3), positive outside; None from inside the cylinder.

    Args:
        point: Shape (3,), any point of the axis in the camera frame, metres.
        axis: Shape (3,), its direction.
        radius: Metres.
        K: Shape (3, 3).
    """
    axis = axis / np.linalg.norm(axis)
    foot = point - (point @ axis) * axis
    distance = float(np.linalg.norm(foot))
    if distance <= radius:
        return None
    towards = foot / distance
    across = np.cross(axis, towards)
    sine = radius / distance
    normals = np.vstack([-sine * towards + sign * np.sqrt(1 - sine**2) * across for sign in (-1.0, 1.0)])
    lines = normals @ np.linalg.inv(K)
    scale = np.hypot(lines[:, 0], lines[:, 1])
    if (scale < 1e-12).any():
        return None
    return lines / scale[:, None]
