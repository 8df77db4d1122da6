"""One camera found in what another one mapped: features of its picture among features with stereo depth.

SIFT (Lowe 2004) keeps its descriptors over changes of scale and of some tens of degrees in view; a pose by P3P
consensus (Fischler, Bolles 1981) tells which matches are true.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..factors.camera import CameraModel
from .stereo.geometry import transform
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
    covariance: Float
    """Shape (6, 6), of xi in o_T_c * Exp(xi), rotation first."""
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


def find_view(
    mapped: list[MappedFeatures], view: Features, camera: CameraModel, lens_sigmas: tuple[float, float] = (0.0, 0.0)
) -> FoundView | None:
    """The pose of a camera among mapped features of several keyframes, all in one frame; None when it is not found.

    Args:
        lens_sigmas: of its focal length (a part of it) and of its principal point (px).
    """
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
    covariance = _covariance(transform(c_T_o, o_p[index]), seen[index], camera, *lens_sigmas)
    return FoundView(np.asarray(np.linalg.inv(c_T_o), np.float64), covariance, len(index), len(o_p))


def _covariance(c_p: Float, px: Float, camera: CameraModel, focal_sigma_rel: float, centre_sigma_px: float) -> Float:
    """Of a pose by points seen at pixels, the noise being that of the residuals; the lens model's errors beside it.

    A feature of the picture that several keyframes mapped counts once: its points share the error of its place in the
    picture, and most of that of their own.

    Args:
        c_p: shape (n, 3), in the camera's frame. px: shape (n, 2).
    """
    x, y, z = c_p.T
    zero = np.zeros_like(z)
    by_point = np.stack(
        (
            np.column_stack((camera.fx / z, zero, -camera.fx * x / z**2)),
            np.column_stack((zero, camera.fy / z, -camera.fy * y / z**2)),
        ),
        axis=1,
    )
    cross = np.stack(
        (np.column_stack((zero, -z, y)), np.column_stack((z, zero, -x)), np.column_stack((-y, x, zero))), 1
    )
    J = np.concatenate((by_point @ cross, -by_point), axis=2).reshape(-1, 6)
    seen = np.column_stack((x / z, y / z))
    residual = seen * (camera.fx, camera.fy) + (camera.cx, camera.cy) - px
    variance = float((residual**2).sum()) / (2 * len(px) - 6)
    repeats = len(px) / len(np.unique(px, axis=0))
    information = J.T @ J
    focal, centre_x, centre_y = (
        seen * (camera.fx, camera.fy),
        np.tile((1.0, 0.0), len(px)),
        np.tile((0.0, 1.0), len(px)),
    )
    shared = np.column_stack((focal_sigma_rel * focal.ravel(), centre_sigma_px * centre_x, centre_sigma_px * centre_y))
    moved = np.linalg.solve(information, J.T @ shared)
    return np.asarray(variance * repeats * np.linalg.inv(information) + moved @ moved.T, np.float64)


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
