"""Calibrations as they come: what can be used, and what is told of the rest."""

import logmaker
import numpy as np
import pytest

from surecut.factors.errors import LogError
from surecut.io.calibration import Calibration, camera_model, check_image_size


def calibration(**changes) -> Calibration:
    values = {
        "frame_id": "m_left",
        "width": 64,
        "height": 48,
        "model": "plumb_bob",
        "D": [0.1, 0, 0, 0, 0],
        "K": logmaker.K,
        "R": np.eye(3),
        "P": np.hstack([logmaker.K, np.zeros((3, 1))]),
    }
    return Calibration(**{**values, **changes})


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"K": np.zeros(9)}, "not calibrated"),
        ({"K": [np.nan] * 9}, "K holds numbers that are not finite"),
        ({"D": [np.inf, 0, 0, 0]}, "D holds numbers that are not finite"),
        ({"R": [np.nan] * 9}, "R holds"),
        ({"R": np.full(9, 0.5)}, "R is no rotation"),
        ({"D": [1, 2, 3]}, "3 distortion coefficients"),
        ({"model": "CylinderCameraModel"}, "unknown camera model"),
        ({"width": 20}, r"contradicts the image size: its centre \(32, 24\) lies outside 20x48"),
        ({"width": 0}, "image size 0x48"),
        ({"K": np.diag([-50, 50, 1])}, "no camera matrix"),
    ],
)
def test_calibrations_that_cannot_be_used(changes, match):
    with pytest.raises(LogError, match=rf"^/info: .*{match}"):
        camera_model(calibration(**changes), "/info")


def test_calibration_models():
    assert camera_model(calibration(D=[]), "/i").distortion_model == "none"
    assert camera_model(calibration(D=np.arange(8.0)), "/i").distortion_model == "rational_polynomial"
    assert camera_model(calibration(model="equidistant", D=np.zeros(4)), "/i").distortion_model == "equidistant"
    # rectification that was never filled in is none
    assert np.array_equal(camera_model(calibration(R=np.zeros(9), P=np.zeros(12)), "/i").rectification, np.eye(3))


def test_binned_and_cropped_cameras():
    """A point's pixel in the image as sent: cropped by the region, then the mean of 2x2 pixels."""
    camera = camera_model(calibration(binning=(2, 2), roi=(4, 8, 56, 32)), "/i")
    assert (camera.width, camera.height) == (28, 16)
    full = logmaker.K @ [0.1, -0.05, 1]
    expected = ((full[0] - 4 - 0.5) / 2, (full[1] - 8 - 0.5) / 2)
    assert (camera.K @ [0.1, -0.05, 1])[:2] == pytest.approx(expected)


def test_image_size_is_checked():
    camera = camera_model(calibration(), "/i")
    check_image_size(camera, 64, 48, "/i", "/image")
    with pytest.raises(LogError, match=r"/i: the calibration is for 64x48 pixels, the images on /image have 128x96"):
        check_image_size(camera, 128, 96, "/i", "/image")
