"""Published noise of the selectable depth cameras, by hand."""

import numpy as np
import pytest

from surecut.factors.rig import Kinect
from surecut.frontends.cloud.noise import depth_noise


@pytest.mark.parametrize(
    ("model", "z", "sigma", "least", "most"),
    [
        ("kinect_v1", 1.4, 0.0012 + 0.0019, 0.35, 5.0),
        ("kinect_v2", 1.0, 0.0013, 0.4, 5.0),
        ("azure", 1.0, 0.0013, 0.25, 5.5),
        ("realsense", 2.0, 4 * 0.08 / 32, 0.2, 6.0),
    ],
)
def test_frontal_noise_and_range(model, z, sigma, least, most):
    assert Kinect(model=model).model == model
    noise = depth_noise(model)
    assert float(noise.axial(np.array([z]), 0.0)[0]) == pytest.approx(sigma, rel=1e-6)
    assert (noise.minimum_m, noise.maximum_m) == (least, most)


@pytest.mark.parametrize("model", ["kinect_v1", "kinect_v2", "azure", "realsense"])
def test_noise_never_falls_with_the_angle_and_steps_are_positive(model):
    noise, z = depth_noise(model), np.full(20, 2.0)
    sigma = noise.axial(z, np.linspace(0, np.deg2rad(85), 20))
    assert (np.diff(sigma) >= -1e-12).all()
    assert (noise.step(np.linspace(0.5, 4, 9)) > 0).all()
