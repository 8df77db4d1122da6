"""Where a camera stands, from known points: robust first guesses, never factors."""

import cv2
import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]

MINIMUM_POINTS = 6


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
