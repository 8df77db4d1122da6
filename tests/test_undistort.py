"""Lens models: round trips, the given closed forms, OpenCV's own projections, and the end of the field."""

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from surecut.factors.camera import CameraModel
from surecut.factors.errors import SurecutError
from surecut.frontends.undistort import distort, distortion_jacobian, undistort, undistorted_grid

LENSES = [
    ("none", []),
    ("plumb_bob", [-0.3, 0.1, 0.001, -0.002, 0.0]),
    ("plumb_bob", [0.12, -0.05, -0.001, 0.002, 0.01]),
    ("rational_polynomial", [0.5, 0.1, 0.0005, -0.0003, 0.01, 0.6, 0.2, 0.02]),
    ("equidistant", [0.01, -0.002, 0.003, -0.001]),
]


def camera(model, coefficients, focal=300.0):
    K = np.array([[focal, 0.0, 319.5], [0.0, 1.02 * focal, 239.5], [0.0, 0.0, 1.0]])
    return CameraModel("m_left", 640, 480, K, model, np.array(coefficients, float), np.eye(3), None)


def grid(step=40):
    x, y = np.meshgrid(np.arange(0, 640, step), np.arange(0, 480, step))
    return np.stack([x, y], -1).reshape(-1, 2).astype(float)


@pytest.mark.parametrize(("model", "coefficients"), LENSES)
def test_round_trip(model, coefficients):
    lens = camera(model, coefficients)
    ideal, none = undistort(lens, grid())
    assert none is None
    assert np.isfinite(ideal).all()
    np.testing.assert_allclose(distort(lens, ideal), grid(), atol=1e-6)


@pytest.mark.parametrize(("model", "coefficients"), LENSES[1:4])
def test_agrees_with_opencv(model, coefficients):
    lens = camera(model, coefficients)
    rays = np.column_stack([(grid() - lens.K[:2, 2]) / [lens.fx, lens.fy], np.ones(len(grid()))]) * 2.0
    expected = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), lens.K, lens.D)[0][:, 0]
    ideal = (rays @ lens.K.T)[:, :2] / rays[:, 2:]
    np.testing.assert_allclose(distort(lens, ideal), expected, atol=1e-8)


def test_equidistant_without_coefficients_is_the_angle():
    lens = camera("equidistant", [0.0, 0.0, 0.0, 0.0])
    raw = np.array([[319.5 + 300.0 * np.deg2rad(60.0), 239.5]])
    ideal = undistort(lens, raw)[0]
    assert ideal[0, 0] == pytest.approx(319.5 + 300.0 * np.tan(np.deg2rad(60.0)), abs=1e-6)


@pytest.mark.parametrize(("model", "coefficients"), LENSES)
def test_jacobian_and_covariance(model, coefficients):
    lens = camera(model, coefficients)
    raw = grid(97)
    covariance = np.broadcast_to(np.array([[0.04, 0.01], [0.01, 0.09]]), (len(raw), 2, 2))
    ideal, carried = undistort(lens, raw, covariance)
    h = 1e-4
    for k in range(len(raw)):
        columns = [(undistort(lens, raw[k] + d)[0] - undistort(lens, raw[k] - d)[0]) / (2 * h) for d in h * np.eye(2)]
        numeric = np.column_stack(columns)
        np.testing.assert_allclose(carried[k], numeric @ covariance[k] @ numeric.T, rtol=1e-4, atol=1e-9)
        np.testing.assert_allclose(distortion_jacobian(lens, ideal[k : k + 1])[0] @ numeric, np.eye(2), atol=1e-5)


def test_beyond_the_field_is_nan():
    # r (1 - 0.5 r^2) rises up to r = sqrt(2/3), where it is 0.5443: nothing can be seen beyond 163.3 px from the centre
    lens = camera("plumb_bob", [-0.5, 0.0, 0.0, 0.0, 0.0])
    ideal = undistort(lens, np.array([[319.5 + 160.0, 239.5], [319.5 + 166.0, 239.5]]))[0]
    assert np.isfinite(ideal[0]).all()
    assert np.isnan(ideal[1]).all()
    assert np.isnan(distort(lens, np.array([[319.5 + 300.0 * 0.82, 239.5]]))).all()
    assert np.isfinite(distort(lens, np.array([[319.5 + 300.0 * 0.81, 239.5]]))).all()


def test_nan_stays_nan_alone():
    lens = camera(*LENSES[1])
    ideal = undistort(lens, np.array([[np.nan, 3.0], [100.0, 100.0]]))[0]
    assert np.isnan(ideal[0]).any()
    assert np.isfinite(ideal[1]).all()


@settings(max_examples=40, deadline=None)
@given(
    k=st.tuples(*[st.floats(-0.2, 0.2)] * 2), p=st.tuples(*[st.floats(-0.005, 0.005)] * 2), x=st.floats(0, 639),
    y=st.floats(0, 479),
)  # fmt: skip
def test_what_comes_back_is_right_or_nan(k, p, x, y):
    lens = camera("plumb_bob", [*k, *p, 0.0])
    raw = np.array([[x, y]])
    ideal = undistort(lens, raw)[0]
    if np.isfinite(ideal).all():
        np.testing.assert_allclose(distort(lens, ideal), raw, atol=1e-5)


@pytest.mark.parametrize(
    ("model", "coefficients"), [("barrel", [0.1]), ("equidistant", [0.1, 0.2]), ("plumb_bob", [0.1])]
)
def test_unknown_models_are_told_in_one_line(model, coefficients):
    with pytest.raises(SurecutError) as error:
        undistort(camera(model, coefficients), grid())
    assert "m_left" in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(("model", "coefficients"), [*LENSES, ("plumb_bob", [-0.45, 0.0, 0.0, 0.0, 0.0])])
def test_the_grid_of_a_whole_image(model, coefficients):
    lens = camera(model, coefficients, 260.0)
    whole = undistorted_grid(lens)
    assert whole.shape == (480, 640, 2)
    some = grid(13)
    expected = undistort(lens, some)[0]
    np.testing.assert_allclose(whole[some[:, 1].astype(int), some[:, 0].astype(int)], expected, atol=2e-3)
