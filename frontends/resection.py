"""Where a camera stands, from known points: robust first guesses, never factors."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import OptimizeResult, least_squares

Float = NDArray[np.float64]

MINIMUM_POINTS = 6
SAME_POSE_RAD = 0.01
"""Two refined poses of a plane that are turned by less than this are one and the same minimum."""


def camera_pose(points_m: Float, px: Float, K: Float, guess: Float | None = None) -> tuple[Float, float] | None:
    """`o_T_c` from points of {o} and their ideal pixels, by RANSAC and refinement.

    Args:
        points_m: shape (n, 3). px: shape (n, 2).
        guess: shape (4, 4), `o_T_c` to start from; without it the pose is found from nothing.

    Returns:
        `o_T_c` (4, 4) and the median reprojection error in pixels, or None when there is no pose.
    """
    if len(points_m) < 4 or (guess is None and len(points_m) < MINIMUM_POINTS):
        return None
    rotation, translation = _vectors(guess)
    found, rotation, translation, inliers = cv2.solvePnPRansac(
        points_m,
        px,
        K,
        None,
        rotation,
        translation,
        useExtrinsicGuess=guess is not None,
        reprojectionError=3.0,
        iterationsCount=200,
        flags=cv2.SOLVEPNP_ITERATIVE if guess is not None else cv2.SOLVEPNP_SQPNP,
    )
    if not found or inliers is None or len(inliers) < 4:
        return None
    index = np.asarray(inliers, np.int64).ravel()
    rotation, translation = cv2.solvePnPRefineLM(points_m[index], px[index], K, None, rotation, translation)
    c_T_o = np.eye(4)
    c_T_o[:3, :3] = cv2.Rodrigues(rotation)[0]
    c_T_o[:3, 3] = translation.ravel()
    c_p = points_m @ c_T_o[:3, :3].T + c_T_o[:3, 3]
    if np.median(c_p[:, 2]) <= 0:
        return None
    pixel = c_p @ K.T
    error = float(np.median(np.linalg.norm(pixel[:, :2] / pixel[:, 2:] - px, axis=1)))
    return np.asarray(np.linalg.inv(c_T_o), np.float64), error


def _vectors(guess: Float | None) -> tuple[Float, Float]:
    if guess is None:
        return np.zeros(3), np.zeros(3)
    c_T_o = np.linalg.inv(guess)
    return np.asarray(cv2.Rodrigues(c_T_o[:3, :3])[0], np.float64), np.array(c_T_o[:3, 3], np.float64)


@dataclass(frozen=True, slots=True)
class PlanarPose:
    """One of the (at most two) poses of a plane that explain its points in one image."""

    camera_T_plane: Float
    """Shape (4, 4)."""
    rms_px: float


def planar_poses(plane_m: Float, px: Float, K: Float) -> list[PlanarPose]:
    """Both poses of a planar target, refined, the better first (IPPE, Collins and Bartoli 2014).

    Args:
        plane_m: shape (n, 3), n >= 4, z = 0 in the target's frame. px: shape (n, 2), ideal pixels.
    """
    count, rotations, translations, _ = cv2.solvePnPGeneric(plane_m, px, K, None, flags=cv2.SOLVEPNP_IPPE)
    poses = []
    for i in range(count):
        rotation, translation = cv2.solvePnPRefineLM(plane_m, px, K, None, rotations[i].copy(), translations[i].copy())
        matrix = np.eye(4)
        matrix[:3, :3] = cv2.Rodrigues(rotation)[0]
        matrix[:3, 3] = translation.ravel()
        residual = _project(matrix, plane_m, K) - px
        if np.isfinite(residual).all():
            poses.append(PlanarPose(matrix, float(np.sqrt((residual**2).sum(1).mean()))))
    return _distinct(sorted(poses, key=lambda pose: pose.rms_px))


def _distinct(poses: list[PlanarPose]) -> list[PlanarPose]:
    """Without those that refinement has led into the minimum of a better one."""
    kept: list[PlanarPose] = []
    for pose in poses:
        turns = [cv2.Rodrigues(other.camera_T_plane[:3, :3].T @ pose.camera_T_plane[:3, :3])[0] for other in kept]
        if all(np.linalg.norm(turn) > SAME_POSE_RAD for turn in turns):
            kept.append(pose)
    return kept


def page_pose_and_side(
    centres_m: Float, halves: Float, px: Float, sigma_px: Float, K: Float, side_m: float
) -> tuple[float, float] | None:
    """The side length that the image itself implies, when the places of the markers on the page are known.

    Args:
        centres_m: shape (n, 3), marker centres on the page. halves: shape (n, 4, 3), corner directions for side 1.
        px: shape (n, 4, 2). sigma_px: shape (n, 4). side_m: where to start from.

    Returns:
        Side length and its sigma in metres, or None with fewer than two markers or without a fit.
    """
    if len(centres_m) < 2:
        return None
    middle = px.mean(axis=1)
    spread = (
        np.linalg.norm(centres_m - centres_m.mean(0), axis=1).mean()
        / np.linalg.norm(middle - middle.mean(0), axis=1).mean()
    )
    half_diagonal = np.linalg.norm(px - middle[:, None], axis=2).mean()
    start = float(half_diagonal * spread * np.sqrt(2.0))
    best = None
    for side in (start, side_m):
        plane = (centres_m[:, None] + side * halves).reshape(-1, 3)
        for pose in planar_poses(plane, px.reshape(-1, 2), K):
            fit = _free_side(pose.camera_T_plane, side, centres_m, halves, px, sigma_px, K)
            if best is None or fit.cost < best.cost:
                best = fit
    if best is None:
        return None
    covariance = np.linalg.pinv(best.jac.T @ best.jac)
    inflate = max(1.0, 2 * best.cost / max(best.fun.size - 7, 1))
    return float(best.x[6]), float(np.sqrt(covariance[6, 6] * inflate))


def _free_side(
    start: Float, side: float, centres_m: Float, halves: Float, px: Float, sigma_px: Float, K: Float
) -> OptimizeResult:
    def residual(x: Float) -> Float:
        matrix = np.eye(4)
        matrix[:3, :3] = cv2.Rodrigues(x[:3])[0]
        matrix[:3, 3] = x[3:6]
        plane = (centres_m[:, None] + x[6] * halves).reshape(-1, 3)
        return ((_project(matrix, plane, K) - px.reshape(-1, 2)) / sigma_px.reshape(-1, 1)).ravel()

    x0 = np.concatenate([cv2.Rodrigues(start[:3, :3])[0].ravel(), start[:3, 3], [side]])
    return least_squares(residual, x0, x_scale=np.array([0.1] * 3 + [0.1] * 3 + [0.01]))


def _project(camera_T_plane: Float, plane_m: Float, K: Float) -> Float:
    c_p = plane_m @ camera_T_plane[:3, :3].T + camera_T_plane[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        return (c_p @ K.T)[:, :2] / c_p[:, 2:]
