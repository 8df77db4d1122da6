"""Weighted least squares of one board in one image: its pose, and what else is let free."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..factors.camera import CameraModel
from ..factors.measurements import MarkerSighting
from ..factors.rig import Board

Float = NDArray[Any]

UNIT_SQUARE = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
_STEPS = 30
_LEAST_DEPTH_M = 1e-3


@dataclass(frozen=True, slots=True)
class BoardCorners:
    """The n corners of a board that one image shows."""

    marker: NDArray[np.int64]
    """Index of the sighting of each corner, shape (n,)."""
    centre_m: Float
    """Centre of its marker in the page frame, shape (n, 2)."""
    offset: Float
    """Corner from the centre in units of the side, turned as the marker is, shape (n, 2)."""
    px: Float
    """Ideal pixels, shape (n, 2)."""
    covariance_px2: Float
    """Shape (n, 2, 2)."""

    def page_m(self, side_m: float) -> Float:
        """Corners in {f}, shape (n, 3)."""
        flat = self.centre_m + side_m * self.offset
        return np.column_stack([flat, np.zeros(len(flat))])

    def of(self, keep: NDArray[np.bool_]) -> "BoardCorners":
        return BoardCorners(
            self.marker[keep], self.centre_m[keep], self.offset[keep], self.px[keep], self.covariance_px2[keep]
        )


@dataclass(frozen=True, slots=True)
class BoardFit:
    """A solution. `extra` holds the side, or the shift of one marker, if that was free."""

    camera_T_f: Float
    extra: Float
    covariance: Float
    """Of (rotation, translation) in the body frame of {f}, rotation first, then `extra`."""
    residual_px: Float
    """Shape (n, 2)."""
    chi2: float
    dof: int

    @property
    def rms_px(self) -> float:
        return float(np.sqrt(np.mean(np.sum(self.residual_px**2, axis=1))))


def board_corners(sightings: Sequence[MarkerSighting], board: Board, common_px: float) -> BoardCorners:
    """The corners of sightings of `board` that are used, in one image; `common_px` as in `corner_covariance`."""
    places = {marker.id: marker for marker in board.markers}
    index, centres, offsets = [], [], []
    for k, sighting in enumerate(sightings):
        place = places[sighting.marker]
        c, s = np.cos(place.rotation_rad), np.sin(place.rotation_rad)
        good = sighting.good
        index += [k] * len(good)
        centres += [place.centre_m] * len(good)
        offsets.append(UNIT_SQUARE[good] @ np.array([[c, s], [-s, c]]))
    covariance = np.concatenate([corner_covariance(s, common_px)[s.good] for s in sightings])
    return BoardCorners(
        np.array(index),
        np.array(centres, float),
        np.concatenate(offsets),
        np.concatenate([s.corners_px[s.good] for s in sightings]),
        covariance,
    )


def corner_covariance(sighting: MarkerSighting, common_px: float) -> Float:
    """Covariance of the four corners in one image, as if they were independent of each other, (4, 2, 2).

    Args:
        common_px: least sigma of what views from the same place have in common; what the sighting itself says of it
            counts where it is more.
    """
    own = sighting.independent_scale * np.asarray(sighting.covariance_px2, float)
    said = independent_common_px(sighting)
    return own + max(common_px**2 - said**2, 0.0) * np.eye(2)


def independent_common_px(sighting: MarkerSighting) -> float:
    """Sigma of the part of `corner_covariance` that views from the same place share, as the sighting says it."""
    return float(np.sqrt(sighting.independent_scale)) * (sighting.common_px or 0.0)


def fit_board(
    corners: BoardCorners,
    camera: CameraModel,
    start: Float,
    side_m: float,
    side_free: bool = False,
    shifted: int | None = None,
) -> BoardFit:
    """Levenberg-Marquardt from a start pose (4, 4).

    Args:
        side_free: the side is the seventh unknown, started at `side_m`.
        shifted: index of a sighting whose marker may be off its place: three more unknowns, its shift in x and y (m)
            and its turn (rad) on the page.
    """
    root = np.linalg.cholesky(np.linalg.inv(corners.covariance_px2)).transpose(0, 2, 1)
    extra = np.array([side_m]) if side_free else np.zeros(0 if shifted is None else 3)
    pose, damping = start.copy(), 1e-4
    error, jacobian = _linearise(corners, camera, root, pose, side_m, extra, side_free, shifted)
    cost = float(error @ error)
    if not (np.isfinite(cost) and np.isfinite(jacobian).all()):  # the start puts corners into the camera's plane
        unknowns = 6 + len(extra)
        nothing = np.full((unknowns, unknowns), np.inf)
        return BoardFit(pose, extra, nothing, np.full((len(error) // 2, 2), np.inf), np.inf, len(error) - unknowns)
    for _ in range(_STEPS):
        normal, right = jacobian.T @ jacobian, jacobian.T @ error
        step = -np.linalg.solve(normal + damping * np.diag(np.diag(normal) + 1e-12), right)
        trial, trial_extra = _moved(pose, step[:6]), extra + step[6:]
        new_error, new_jacobian = _linearise(corners, camera, root, trial, side_m, trial_extra, side_free, shifted)
        new_cost = float(new_error @ new_error)
        if not np.isfinite(new_cost) or new_cost > cost:
            damping *= 10
            if damping > 1e8:
                break
            continue
        done = cost - new_cost < 1e-9 * max(cost, 1e-9)
        pose, extra, error, jacobian, cost = trial, trial_extra, new_error, new_jacobian, new_cost
        damping = max(damping / 10, 1e-9)
        if done:
            break
    residual = np.linalg.solve(root, error.reshape(-1, 2)[..., None])[..., 0]
    to_body = np.eye(6 + len(extra))
    to_body[:3, :3] = to_body[3:6, 3:6] = pose[:3, :3].T
    covariance = to_body @ np.linalg.pinv(jacobian.T @ jacobian, hermitian=True) @ to_body.T
    return BoardFit(pose, extra, covariance, residual, cost, len(error) - 6 - len(extra))


def _moved(pose: Float, step: Float) -> Float:
    moved = pose.copy()
    moved[:3, :3] = cv2.Rodrigues(step[:3])[0] @ pose[:3, :3]
    moved[:3, 3] += step[3:]
    return moved


def _linearise(
    corners: BoardCorners,
    camera: CameraModel,
    root: Float,
    pose: Float,
    side_m: float,
    extra: Float,
    side_free: bool,
    shifted: int | None,
) -> tuple[Float, Float]:
    """Whitened residuals (2 n,) and their Jacobian by (rotation, translation in the camera's axes, extra)."""
    side = float(extra[0]) if side_free else side_m
    page = corners.page_m(side)
    by_page = np.zeros((len(page), 3, len(extra)))
    if side_free:
        by_page[:, :2, 0] = corners.offset
    elif shifted is not None:
        mine = corners.marker == shifted
        arm = side * corners.offset[mine]
        page[mine, :2] += extra[:2] + extra[2] * np.column_stack([-arm[:, 1], arm[:, 0]])
        by_page[mine, 0, 0] = by_page[mine, 1, 1] = 1.0
        by_page[mine, 0, 2], by_page[mine, 1, 2] = -arm[:, 1], arm[:, 0]
    turned = page @ pose[:3, :3].T
    local = turned + pose[:3, 3]
    if (local[:, 2] < _LEAST_DEPTH_M).any():
        return np.full(2 * len(page), np.inf), np.zeros((2 * len(page), 6 + len(extra)))
    image = local @ camera.K.T
    px = image[:, :2] / image[:, 2:]
    by_point = (camera.K[None, :2] - px[:, :, None] * camera.K[2]) / local[:, 2, None, None]
    jacobian = np.empty((len(page), 2, 6 + len(extra)))
    jacobian[:, :, :3] = -by_point @ _cross(turned)
    jacobian[:, :, 3:6] = by_point
    jacobian[:, :, 6:] = by_point @ (pose[:3, :3] @ by_page)
    error = (root @ (px - corners.px)[..., None])[..., 0]
    return error.ravel(), (root @ jacobian).reshape(2 * len(page), -1)


def _cross(vectors: Float) -> Float:
    matrix = np.zeros((len(vectors), 3, 3))
    x, y, z = vectors.T
    matrix[:, 0, 1], matrix[:, 0, 2], matrix[:, 1, 2] = -z, y, -x
    matrix[:, 1, 0], matrix[:, 2, 0], matrix[:, 2, 1] = z, -y, x
    return matrix
