"""Pixels to single measurements as the paper takes them: one marker's pose, one click's stereo depth."""

import cv2
import numpy as np
from numpy.typing import NDArray

from ..factors.camera import CameraModel
from ..factors.measurements import MarkerSighting
from ..factors.rig import Board
from .fiducials.dictionaries import marker_dictionary
from .undistort import undistort

Float = NDArray[np.float64]
Image = NDArray[np.uint8]

MARKER_CORNERS = np.array([[-0.5, -0.5, 0.0], [0.5, -0.5, 0.0], [0.5, 0.5, 0.0], [-0.5, 0.5, 0.0]])
DISPARITY_RANGE = 16
"""OpenCV's SGBM takes multiples of 16."""


def marker_pose(sighting: MarkerSighting, camera: CameraModel, side_m: float) -> Float | None:
    """Pose of one marker in the camera from its four corners, by OpenCV's iterative solvePnP as ArUco's module did.

    Args:
        sighting: corners in ideal pixels, order as in `MarkerSighting`.
        camera: intrinsics; the distortion is not used.
        side_m: side length as the operator gave it.

    Returns:
        `camera_T_marker`, shape (4, 4); None where the solver finds none in front of the camera.
    """
    found, rotation_vector, translation = cv2.solvePnP(
        MARKER_CORNERS * side_m, sighting.corners_px, camera.K, None, flags=cv2.SOLVEPNP_ITERATIVE
    )
    if not found or translation[2, 0] <= 0:
        return None
    pose = np.eye(4)
    pose[:3, :3] = cv2.Rodrigues(rotation_vector)[0]
    pose[:3, 3] = translation[:, 0]
    return pose


def clicked_point(
    left: Image, right: Image, left_camera: CameraModel, right_camera: CameraModel, raw_px: Float, window_px: int = 5
) -> Float | None:
    """The surface point in {m} under a click: semi-global matching, median disparity of a small window.

    Args:
        left: grey image, shape (height, width).
        right: grey image of the same stamp.
        left_camera: calibration as given with the recording.
        right_camera: the same; its `baseline_m` is used.
        raw_px: the click in the left image as seen, shape (2,).
        window_px: half of the window's side.

    Returns:
        Shape (3,), in the left optical frame, m; None without a disparity in the window or without a baseline.
    """
    if not right_camera.baseline_m:
        return None
    rectified_left = _rectify(left, left_camera, left_camera.K)
    rectified_right = _rectify(right, right_camera, left_camera.K)
    u, v = _rectified_pixel(raw_px, left_camera)
    disparities = _disparity(rectified_left, rectified_right)
    height, width = disparities.shape
    rows = slice(max(0, round(v) - window_px), min(height, round(v) + window_px + 1))
    columns = slice(max(0, round(u) - window_px), min(width, round(u) + window_px + 1))
    valid = disparities[rows, columns]
    valid = valid[valid > 0]
    if not len(valid):
        return None
    depth_m = left_camera.fx * right_camera.baseline_m / float(np.median(valid))
    rectified_ray = np.linalg.solve(left_camera.K, np.array([u, v, 1.0]))
    return left_camera.rectification.T @ (rectified_ray * depth_m)


def _disparity(left: Image, right: Image) -> Float:
    """Disparity in px, not positive where unknown; the range grows with the image. Shape (height, width)."""
    height, width = left.shape
    # A point at 0.4 m in a pair like the paper's has a disparity of a quarter of the image's width.
    span = DISPARITY_RANGE * max(1, round(width / 4 / DISPARITY_RANGE))
    block = 5
    matcher = cv2.StereoSGBM.create(
        minDisparity=0,
        numDisparities=span,
        blockSize=block,
        P1=8 * block * block,
        P2=32 * block * block,
        disp12MaxDiff=1,
        uniquenessRatio=10,
        speckleWindowSize=50,
        speckleRange=2,
    )
    # The matcher answers nothing in the first `span` columns: give it that many more.
    padded = [cv2.copyMakeBorder(image, 0, 0, span, 0, cv2.BORDER_REPLICATE) for image in (left, right)]
    fixed_point = matcher.compute(padded[0], padded[1])
    return fixed_point[:, span:].astype(np.float64).reshape(height, width) / 16.0


def _rectify(image: Image, camera: CameraModel, new_K: Float) -> Image:
    size = (camera.width, camera.height)
    if camera.distortion_model == "equidistant":
        maps = cv2.fisheye.initUndistortRectifyMap(
            camera.K, camera.D[:4], camera.rectification, new_K, size, cv2.CV_32FC1
        )
    else:
        D = None if camera.distortion_model == "none" else camera.D
        maps = cv2.initUndistortRectifyMap(camera.K, D, camera.rectification, new_K, size, cv2.CV_32FC1)
    return np.asarray(cv2.remap(image, maps[0], maps[1], cv2.INTER_LINEAR), dtype=np.uint8)


def _rectified_pixel(raw_px: Float, camera: CameraModel) -> tuple[float, float]:
    point = np.asarray(raw_px, dtype=np.float64).reshape(1, 1, 2)
    if camera.distortion_model == "equidistant":
        pixel = cv2.fisheye.undistortPoints(point, camera.K, camera.D[:4], R=camera.rectification, P=camera.K)
    else:
        D = None if camera.distortion_model == "none" else camera.D
        pixel = cv2.undistortPoints(point, camera.K, D, R=camera.rectification, P=camera.K)
    return float(pixel[0, 0, 0]), float(pixel[0, 0, 1])


def plain_sightings(stamp_ns: int, image: Image, board: Board, camera: CameraModel) -> list[MarkerSighting]:
    """A board's markers as OpenCV's ArUco module finds them by default, without refinement, as the paper's system did.

    Args:
        image: grey, shape (height, width), of the left camera.

    Returns:
        Sightings; their covariance, which the chain does not use, is that of a pixel.
    """
    dictionary = marker_dictionary(board.dictionary)
    corners, ids, _ = cv2.aruco.ArucoDetector(dictionary.opencv).detectMarkers(image)
    wanted = {marker.id for marker in board.markers}
    order = list(dictionary.from_opencv)
    found = []
    for quad, marker in zip(corners, [] if ids is None else ids.ravel(), strict=True):
        if int(marker) in wanted:
            raw = np.asarray(quad, float).reshape(4, 2)[order]
            ideal, _ = undistort(camera, raw)
            noise = np.broadcast_to(np.eye(2), (4, 2, 2))
            found.append(MarkerSighting(stamp_ns, "m_left", board.id, int(marker), ideal, noise, raw))
    return found
