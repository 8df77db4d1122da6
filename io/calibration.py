"""A calibration message's numbers to a `CameraModel`, with the checks that no estimate may do without."""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..factors.camera import CameraModel
from ..factors.errors import LogError

Float = NDArray[np.float64]

_MODELS = {
    "": "plumb_bob",
    "none": "none",
    "plumb_bob": "plumb_bob",
    "plumb bob": "plumb_bob",
    "radtan": "plumb_bob",
    "brown_conrady": "plumb_bob",
    "rational_polynomial": "rational_polynomial",
    "equidistant": "equidistant",
    "kannala_brandt": "equidistant",
    "fisheye": "equidistant",
}
_COEFFICIENTS = {"none": (0,), "plumb_bob": (0, 4, 5), "rational_polynomial": (0, 8, 12, 14), "equidistant": (4,)}


@dataclass(frozen=True, slots=True)
class Calibration:
    """The fields of `sensor_msgs/CameraInfo` and of `foxglove.CameraCalibration`."""

    frame_id: str
    width: int
    height: int
    model: str
    D: ArrayLike
    K: ArrayLike
    R: ArrayLike
    P: ArrayLike
    binning: tuple[int, int] = (0, 0)
    roi: tuple[int, int, int, int] = (0, 0, 0, 0)
    """x offset, y offset, width, height in unbinned pixels; width 0 for the whole sensor."""


def camera_model(calibration: Calibration, label: str) -> CameraModel:
    """The camera, named after its frame.

    Args:
        label: topic (and time), for errors.

    Raises:
        LogError: unknown model, not calibrated, not finite, or in contradiction to its own image size.
    """
    c = calibration
    text = (c.frame_id, c.width, c.height, c.model, c.binning, c.roi)
    numbers = tuple(np.asarray(values, np.float64).tobytes() for values in (c.D, c.K, c.R, c.P))
    try:
        return _camera_model(text, numbers)
    except LogError as error:
        raise LogError(f"{label}: {error}") from error


@lru_cache(maxsize=64)
def _camera_model(
    text: tuple[str, int, int, str, tuple[int, int], tuple[int, int, int, int]], numbers: tuple[bytes, ...]
) -> CameraModel:
    """A calibration is sent with every image, and is the same each time."""
    frame_id, width, height, model, binning, roi = text
    D, K, R, P = (np.frombuffer(n) for n in numbers)
    c = Calibration(frame_id, width, height, model, D, K, R, P, binning, roi)
    K = _matrix(K, (3, 3), "K")
    if not np.any(K):
        raise LogError("the camera is not calibrated (K is zero); calibrate it or record its calibration")
    model, D = _distortion(c)
    R = _matrix(R, (3, 3), "R")
    R = R if np.any(R) else np.eye(3)
    if np.abs(R @ R.T - np.eye(3)).max() > 1e-3:
        raise LogError("R is no rotation; record the calibration again")
    P = _matrix(P, (3, 4), "P")
    # P is of the rectified pair's camera: its own focal length gives the baseline
    baseline = float(-P[0, 3] / P[0, 0]) + 0.0 if P[0, 0] > 0 else None
    camera = CameraModel(c.frame_id, c.width, c.height, K, model, D, R, baseline)
    return _checked(_cropped(camera, c))


def check_image_size(camera: CameraModel, width: int, height: int, info_topic: str, image_topic: str) -> None:
    """Raises LogError when the images are not of the size that the calibration is for."""
    if (camera.width, camera.height) != (width, height):
        raise LogError(
            f"{info_topic}: the calibration is for {camera.width}x{camera.height} pixels, the images on {image_topic} "
            f"have {width}x{height}; record images and calibration in one resolution"
        )


def _matrix(values: ArrayLike, shape: tuple[int, int], name: str) -> Float:
    array = np.asarray(values, dtype=np.float64).reshape(-1)
    if array.size == 0:
        return np.zeros(shape)
    if array.size != shape[0] * shape[1]:
        raise LogError(f"{name} has {array.size} numbers, not {shape[0] * shape[1]}")
    if not np.isfinite(array).all():
        raise LogError(f"{name} holds numbers that are not finite; record the calibration again")
    return array.reshape(shape)


def _distortion(c: Calibration) -> tuple[str, Float]:
    model = _MODELS.get(c.model.strip().lower())
    if model is None:
        known = "plumb_bob, rational_polynomial, equidistant"
        raise LogError(f"unknown camera model {c.model!r}; calibrate with one of {known}")
    D: NDArray[Any] = np.asarray(c.D, dtype=np.float64).reshape(-1)
    if not np.isfinite(D).all():
        raise LogError("D holds numbers that are not finite; record the calibration again")
    if model == "plumb_bob" and D.size in (8, 12, 14):
        model = "rational_polynomial"  # what OpenCV makes of so many coefficients
    if model == "rational_polynomial" and D.size in (4, 5):
        model = "plumb_bob"
    if D.size not in _COEFFICIENTS[model]:
        expected = " or ".join(str(n) for n in _COEFFICIENTS[model])
        raise LogError(f"{D.size} distortion coefficients, {c.model or 'plumb_bob'} has {expected}")
    if model != "equidistant" and not np.any(D):
        return "none", np.zeros(0)
    return model, D


def _cropped(camera: CameraModel, c: Calibration) -> CameraModel:
    """K and size of the image as it is sent: the message's are of the whole sensor without binning."""
    x, y, width, height = c.roi
    bin_x, bin_y = (max(b, 1) for b in c.binning)
    if (bin_x, bin_y) == (1, 1) and (width == 0 or (x, y, width, height) == (0, 0, c.width, c.height)):
        return camera
    K = camera.K.copy()
    K[0, 2] -= x
    K[1, 2] -= y
    # the centre of a binned pixel is the mean of its members' centres
    K[0] /= bin_x
    K[1] /= bin_y
    K[0, 2] -= (bin_x - 1) / (2 * bin_x)
    K[1, 2] -= (bin_y - 1) / (2 * bin_y)
    size = ((width or c.width) // bin_x, (height or c.height) // bin_y)
    return CameraModel(
        camera.name, *size, K, camera.distortion_model, camera.D, camera.rectification, camera.baseline_m
    )


def _checked(camera: CameraModel) -> CameraModel:
    if camera.width <= 0 or camera.height <= 0:
        raise LogError(f"image size {camera.width}x{camera.height}; record the calibration again")
    fx, fy, cx, cy = camera.fx, camera.fy, camera.cx, camera.cy
    if fx <= 0 or fy <= 0 or not np.allclose(camera.K[2], (0, 0, 1)) or abs(camera.K[1, 0]) > 1e-9:
        raise LogError(f"K is no camera matrix (fx {fx:g}, fy {fy:g}); record the calibration again")
    if not (0 <= cx < camera.width and 0 <= cy < camera.height):
        raise LogError(
            f"the calibration contradicts the image size: its centre ({cx:.0f}, {cy:.0f}) lies outside "
            f"{camera.width}x{camera.height}; record images and calibration in one resolution"
        )
    return camera
