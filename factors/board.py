"""A printed page: its corners in {o}, its side length and print scale as states, known distances.

The page says where its markers are only up to one scale, which is a state: the known distances hold it.
"""

from collections.abc import Sequence

import gtsam
import numpy as np
from numpy.typing import NDArray

from . import keys
from .geometry import point_to_frame
from .noise import Model, gaussian, sigmas
from .rig import Board, Marker

Float = NDArray[np.float64]

DIRECTIONS = np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
"""Corners 0..3 in units of half the side."""
CORNER_PRINT_SIGMA_M = 1.2e-5
"""Raggedness of one printed corner: rounding to the dots of a 600 dpi print, 42 um / sqrt(12)."""

LOOSE_SIGMAS = np.array([0.1, 0.1, 0.5])
"""Sigmas of shift (m) and turn (rad) of a marker that has come off."""


def marker_rotation(marker: Marker) -> Float:
    """The marker's axes in the page, shape (3, 3)."""
    c, s = np.cos(marker.rotation_rad), np.sin(marker.rotation_rad)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def page_corners(marker: Marker, side_m: float, scale: float = 1.0) -> Float:
    """The four corners in the page frame, shape (4, 3), metres."""
    centre = np.array([marker.centre_m[0], marker.centre_m[1], 0.0])
    return scale * centre + 0.5 * side_m * DIRECTIONS @ marker_rotation(marker).T


def page_factor(
    board: Board,
    marker: Marker,
    board_key: int,
    page_key: int,
    slot: int,
    detection_m: float = 0.0,
    loose: bool = False,
) -> gtsam.CustomFactor:
    """Four corners of a marker lie on the page: `f_q = scale * centre + side / 2 * direction`.

    Residual (12,) in the page frame and in units of the page's scale: with tolerances in metres a page that shrinks
    (and is nearer, so that it looks the same) would seem to fit better. The marker's own place on the page
    (`centre_sigma_m`) is common to its four corners: eliminating it as a Gaussian gives the covariance
    sigma_c^2 11^T + sigma_print^2 I.

    Args:
        detection_m: the part of a corner's detection error that stays the same in all views, on the page.
        loose: the marker is a square of its own: anywhere near its place, and turned as it likes.
    """
    centre = np.array([marker.centre_m[0], marker.centre_m[1], 0.0])
    half = 0.5 * DIRECTIONS @ marker_rotation(marker).T
    page_jacobian = np.stack([-half.ravel(), np.tile(-centre, 4)], axis=1)
    common = np.kron(np.ones((4, 4)), np.eye(3)) * board.centre_sigma_m**2
    if loose:
        common = (
            shift_directions(marker, board.side_m) @ np.diag(LOOSE_SIGMAS**2) @ shift_directions(marker, board.side_m).T
        )
    noise = gaussian(common + np.eye(12) * (CORNER_PRINT_SIGMA_M**2 + detection_m**2))
    variables = [board_key, page_key, *(keys.corner(slot, i) for i in range(4))]

    def error(factor: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Float] | None) -> Float:
        o_T_f = values.atPose3(variables[0])
        side, scale = values.atVector(variables[1])
        residual = np.empty(12)
        pose_jacobian = np.empty((12, 6))
        for i in range(4):
            f_q, d_pose, d_point = point_to_frame(o_T_f, values.atPoint3(variables[2 + i]))
            rows = slice(3 * i, 3 * i + 3)
            residual[rows] = (f_q - scale * centre - side * half[i]) / scale
            pose_jacobian[rows] = d_pose / scale
            if jacobians is not None:
                block = np.zeros((12, 3))
                block[rows] = d_point / scale
                jacobians[2 + i] = block
        if jacobians is not None:
            jacobians[0] = pose_jacobian
            jacobians[1] = page_jacobian / scale
            jacobians[1][:, 1] -= residual / scale
        return residual

    return gtsam.CustomFactor(noise, variables, error)


def shift_directions(marker: Marker, side_m: float) -> Float:
    """How a page factor's residual changes with a marker's own shift in x and y (m) and turn (rad): shape (12, 3)."""
    half = 0.5 * side_m * DIRECTIONS @ marker_rotation(marker).T
    turned = np.stack([-half[:, 1], half[:, 0], np.zeros(4)], axis=1)
    return np.stack([np.tile([1.0, 0.0, 0.0], 4), np.tile([0.0, 1.0, 0.0], 4), turned.ravel()], axis=1)


def side_prior(page_key: int, side_m: float, sigma_m: float) -> gtsam.CustomFactor:
    """The rig's side length, with its tolerance. A page printed small has small markers: `side = scale * side_m`."""
    row = np.array([[1.0, -side_m]])

    def error(factor: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Float] | None) -> Float:
        if jacobians is not None:
            jacobians[0] = row
        side, scale = values.atVector(page_key)
        return np.array([side - scale * side_m])

    return gtsam.CustomFactor(sigmas([sigma_m]), [page_key], error)


def print_scale_prior(page_key: int, sigma: float) -> gtsam.CustomFactor:
    """All distances of one page share the printer's scale error: what they know together is the scale."""
    row = np.array([[0.0, 1.0]])

    def error(factor: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Float] | None) -> Float:
        if jacobians is not None:
            jacobians[0] = row
        return np.array([values.atVector(page_key)[1] - 1.0])

    return gtsam.CustomFactor(sigmas([sigma]), [page_key], error)


def distance_factor(
    a: Sequence[int], b: Sequence[int], distance_m: float, noise: Model
) -> gtsam.CustomFactor | gtsam.RangeFactor3:
    """A known distance between two marker points, each the mean of the corners whose keys are given (1 or 4)."""
    if len(a) == 1 and len(b) == 1:
        return gtsam.RangeFactor3(a[0], b[0], distance_m, noise)
    variables = [*a, *b]

    def error(factor: gtsam.CustomFactor, values: gtsam.Values, jacobians: list[Float] | None) -> Float:
        difference = mean_point(values, a) - mean_point(values, b)
        length = float(np.linalg.norm(difference))
        if jacobians is not None:
            unit = (difference / length)[None, :]
            for i in range(len(a)):
                jacobians[i] = unit / len(a)
            for i in range(len(b)):
                jacobians[len(a) + i] = -unit / len(b)
        return np.array([length - distance_m])

    return gtsam.CustomFactor(noise, variables, error)


def mean_point(values: gtsam.Values, points: Sequence[int]) -> Float:
    """Mean of some corners, shape (3,)."""
    return np.mean([values.atPoint3(key) for key in points], axis=0)
