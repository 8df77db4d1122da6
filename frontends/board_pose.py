"""First guesses for a board in one image: both poses that a plane can have, and the side length that it shows."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..factors.camera import CameraModel
from ..factors.errors import ObservabilityError
from ..factors.measurements import MarkerSighting
from ..factors.rig import Board, Noise
from .board_fit import BoardCorners, BoardFit, board_corners, fit_board

Float = NDArray[np.float64]

_WRONG_BRANCH = 1e-4
"""How unlikely the worse of two poses has to be, against the better one, before it is ruled out."""
_SAME_RAD = 0.01
_SIDE_FACTORS = np.geomspace(0.4, 2.5, 9)


@dataclass(frozen=True, slots=True)
class PoseCandidate:
    """One of the poses that a board may have."""

    camera_T_f: Float
    """Shape (4, 4)."""
    rms_px: float
    covariance: Float
    """Shape (6, 6), rotation first, in the body frame of {f} (GTSAM's tangent of `camera_T_f`)."""
    chi2: float
    dof: int
    ambiguous: bool
    """True where the noise does not rule out the other pose: two candidates are then to be kept."""


def board_pose_candidates(
    sightings: Sequence[MarkerSighting],
    board: Board,
    camera: CameraModel,
    side_m: float,
    common_px: float = Noise().marker_common_px,
) -> list[PoseCandidate]:
    """The poses of one board in one image that its corners allow, the likelier one first.

    All corners are used, whatever their number of markers. A plane seen from afar or from the front has two poses
    (Collins and Bartoli, "Infinitesimal plane-based pose estimation", 2014, gives both); each is refined with the
    corners' own weights. The worse one is dropped when the difference of chi-square makes it less likely than one to
    ten thousand; if not, both come back with `ambiguous` set.

    Args:
        sightings: of `board`, from one image of `camera`; at least one.
        side_m: marker side to assume.
        common_px: error that views from the same place share, added to each corner's own.
    """
    corners = board_corners(sightings, board, common_px)
    fits = [fit_board(corners, camera, start, side_m) for start in planar_poses(corners, camera, side_m)]
    fits = _distinct([fit for fit in fits if np.isfinite(fit.chi2)])
    if not fits:
        return []
    # a fit that is worse than its noise says so for both branches alike
    scale = max(1.0, fits[0].chi2 / max(fits[0].dof, 1))
    limit = -2.0 * np.log(_WRONG_BRANCH) * scale
    fits = [fit for fit in fits if fit.chi2 - fits[0].chi2 < limit]
    return [
        PoseCandidate(fit.camera_T_f, fit.rms_px, fit.covariance * scale, fit.chi2, fit.dof, len(fits) > 1)
        for fit in fits
    ]


def apparent_side(
    sightings: Sequence[MarkerSighting],
    board: Board,
    camera: CameraModel,
    common_px: float = Noise().marker_common_px,
) -> tuple[float, float]:
    """The marker side that the image shows, given where the centres are on the page: (side_m, sigma_m).

    Pose and side are solved together; the known distances between the centres hold the scale.

    Raises:
        ObservabilityError: fewer than two markers are in view, or no pose fits them.
    """
    if len({s.marker for s in sightings}) < 2:
        raise ObservabilityError(
            f"board {board.id}: {len(sightings)} marker in view, and a side length needs two and their distance"
        )
    corners = board_corners(sightings, board, common_px)
    best: BoardFit | None = None
    best_side = board.side_m
    for factor in _SIDE_FACTORS:
        side = float(board.side_m * factor)
        for start in planar_poses(corners, camera, side):
            fit = fit_board(corners, camera, start, side)
            if best is None or fit.chi2 < best.chi2:
                best, best_side = fit, side
    if best is None:
        raise ObservabilityError(f"board {board.id}: its markers in view allow no pose in front of the camera")
    free = fit_board(corners, camera, best.camera_T_f, best_side, side_free=True)
    scale = max(1.0, free.chi2 / max(free.dof, 1))
    return float(free.extra[0]), float(np.sqrt(free.covariance[6, 6] * scale))


def planar_poses(corners: BoardCorners, camera: CameraModel, side_m: float) -> list[Float]:
    """Both start poses, those in front of the camera and facing it; none from fewer than four corners."""
    if len(corners.px) < 4:
        return []
    page = corners.page_m(side_m)
    count, rotations, translations, _ = cv2.solvePnPGeneric(
        page, np.ascontiguousarray(corners.px), camera.K, None, flags=cv2.SOLVEPNP_IPPE
    )
    poses = []
    for k in range(count):
        pose = np.eye(4)
        pose[:3, :3] = cv2.Rodrigues(rotations[k])[0]
        pose[:3, 3] = np.ravel(translations[k])
        facing = pose[:3, 2] @ pose[:3, 3] < 0
        if np.isfinite(pose).all() and facing and (page @ pose[2, :3] + pose[2, 3] > 0).all():
            poses.append(pose)
    return poses


def _distinct(fits: list[BoardFit]) -> list[BoardFit]:
    """By chi-square, without those that ended in the same place."""
    result: list[BoardFit] = []
    for fit in sorted(fits, key=lambda f: f.chi2):
        turns = [cv2.Rodrigues(fit.camera_T_f[:3, :3].T @ other.camera_T_f[:3, :3])[0] for other in result]
        if all(np.linalg.norm(turn) > _SAME_RAD for turn in turns):
            result.append(fit)
    return result
