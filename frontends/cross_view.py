"""One camera found in what another one mapped: features of its picture among features with stereo depth.

SIFT (Lowe 2004) keeps its descriptors over changes of scale and of some tens of degrees in view; a pose by P3P
consensus (Fischler, Bolles 1981) tells which matches are true.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..factors.camera import CameraModel
from .undistort import undistort

Float = NDArray[np.float64]
Image = NDArray[np.uint8]

FEATURES = 2500
RATIO = 0.8
"""Best to second best descriptor distance of a match (Lowe)."""
EPIPOLAR_PX = 1.5
INLIER_PX = 6.0
FEWEST_INLIERS = 12
CHANCE_SHARE = 0.08
"""Inliers must be more than this part of the matches: wrong matches agree with a wrong pose about so often."""
TRIALS = 4000


@dataclass(frozen=True, slots=True)
class Features:
    """Descriptors with places."""

    descriptors: NDArray[np.float32]
    """Shape (n, 128)."""
    px: Float
    """Shape (n, 2), ideal pixels."""


@dataclass(frozen=True, slots=True)
class MappedFeatures:
    """Descriptors of points in space."""

    descriptors: NDArray[np.float32]
    points_m: Float
    """Shape (n, 3)."""


@dataclass(frozen=True, slots=True)
class FoundView:
    """A camera's pose in the map's frame."""

    o_T_c: Float
    """Shape (4, 4)."""
    inliers: int
    matches: int


def features(image: Image, camera: CameraModel) -> Features:
    """SIFT features of a grey image; small images are enlarged first."""
    scale = 2.0 if image.shape[1] < 500 else 1.0
    if scale > 1.0:
        image = np.asarray(cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC), np.uint8)
    keypoints, descriptors = cv2.SIFT.create(FEATURES, contrastThreshold=0.02).detectAndCompute(image, None)
    if descriptors is None:
        return Features(np.zeros((0, 128), np.float32), np.zeros((0, 2)))
    raw = (np.array([k.pt for k in keypoints], np.float64) + 0.5) / scale - 0.5
    px = undistort(camera, raw)[0]
    known = np.isfinite(px).all(axis=1)
    return Features(np.asarray(descriptors, np.float32)[known], px[known])


def mapped_features(
    left: Features, right: Features, left_camera: CameraModel, right_camera: CameraModel, left_T_right: Float
) -> MappedFeatures:
    """Features that both images of a stereo pair show, with their places in the left camera's frame."""
    matches = _matches(left.descriptors, right.descriptors)
    rays = _rays(left.px[matches[:, 0]], left_camera)
    others = _rays(right.px[matches[:, 1]], right_camera) @ left_T_right[:3, :3].T
    t = left_T_right[:3, 3]
    # s * ray - u * other = t, by least squares
    aa, bb, ab = (rays**2).sum(1), (others**2).sum(1), (rays * others).sum(1)
    at, bt = rays @ t, others @ t
    with np.errstate(divide="ignore", invalid="ignore"):
        determinant = aa * bb - ab**2
        s, u = (bb * at - ab * bt) / determinant, (ab * at - aa * bt) / determinant
        miss = np.linalg.norm(s[:, None] * rays - u[:, None] * others - t, axis=1)
        good = (s > 0.2) & (u > 0.2) & (s < 40 * np.linalg.norm(t)) & (miss / s * left_camera.fx < EPIPOLAR_PX)
    return MappedFeatures(left.descriptors[matches[good, 0]], s[good, None] * rays[good])


def find_view(mapped: list[MappedFeatures], view: Features, camera: CameraModel) -> FoundView | None:
    """The pose of a camera among mapped features of several keyframes, all in one frame; None when it is not found."""
    points, px = [], []
    for part in mapped:
        matches = _matches(part.descriptors, view.descriptors)
        points.append(part.points_m[matches[:, 0]])
        px.append(view.px[matches[:, 1]])
    o_p, seen = np.vstack([np.zeros((0, 3)), *points]), np.vstack([np.zeros((0, 2)), *px])
    if len(o_p) < FEWEST_INLIERS:
        return None
    cv2.setRNGSeed(0)
    found, rotation, translation, inliers = cv2.solvePnPRansac(
        o_p, seen, camera.K, None, iterationsCount=TRIALS, reprojectionError=INLIER_PX, flags=cv2.SOLVEPNP_AP3P
    )
    if not found or inliers is None or len(inliers) < max(FEWEST_INLIERS, CHANCE_SHARE * len(o_p)):
        return None
    index = np.asarray(inliers, np.int64).ravel()
    rotation, translation = cv2.solvePnPRefineLM(o_p[index], seen[index], camera.K, None, rotation, translation)
    c_T_o = np.eye(4)
    c_T_o[:3, :3], c_T_o[:3, 3] = cv2.Rodrigues(rotation)[0], np.ravel(translation)
    return FoundView(np.asarray(np.linalg.inv(c_T_o), np.float64), len(index), len(o_p))


def _matches(a: NDArray[np.float32], b: NDArray[np.float32]) -> NDArray[np.int64]:
    """Rows of a and b that belong together, shape (n, 2)."""
    if len(a) < 2 or len(b) < 2:
        return np.zeros((0, 2), np.int64)
    pairs = cv2.BFMatcher(cv2.NORM_L2).knnMatch(a, b, 2)
    return np.array([(m.queryIdx, m.trainIdx) for m, n in pairs if m.distance < RATIO * n.distance], np.int64).reshape(
        -1, 2
    )


def _rays(px: Float, camera: CameraModel) -> Float:
    plane = (px - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
    return np.column_stack((plane, np.ones(len(px))))
