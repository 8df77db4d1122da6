"""How wide a pipe is by the texture beside it: drawn pictures with strong stripes inside the pipe."""

import numpy as np
import pytest

from surecut.factors.camera import CameraModel
from surecut.frontends.pipe.texture_width import PipeView, width_by_texture

K = np.array([[270.0, 0, 180], [0, 270.0, 120], [0, 0, 1]])
CAMERA = CameraModel("m_left", 360, 240, K, "none", np.zeros(0), np.eye(3), None)
RADIUS_M, RANGE_M = 0.04, 1.1
HALF_LENGTH_M = 0.25


def views(count=8, textured=True, seed=0, offset_m=0.0, turn_rad=0.0):
    """An upright pipe before a wall of which every view shows another part; its finish has stripes along it.

    Args:
        offset_m, turn_rad: by how much the expected axis is off, sideways and about the line of sight.
    """
    rng = np.random.default_rng(seed)
    u, _ = np.meshgrid(np.arange(360.0), np.arange(240.0))
    found = []
    for _ in range(count):
        side_m = rng.uniform(-0.2, 0.2)
        wall = 120 + 35 * rng.normal(size=(80, 120)).repeat(3, axis=0).repeat(3, axis=1) * textured
        # Tangent of the angle between axis and limb.
        limb = RADIUS_M / np.sqrt(RANGE_M**2 - RADIUS_M**2)
        across = ((u - 180) / 270 - side_m / RANGE_M) / limb
        # bright, dark and middling stripes at fixed shares of the width: edges as strong as the outline's
        finish = np.select([np.abs(across) < 0.35, np.abs(across) < 0.7], [190.0, 90.0], 150.0)
        grey = np.where(np.abs(across) < 1, finish, wall)
        grey = 0.25 * (np.roll(grey, 1, axis=1) + 2 * grey + np.roll(grey, -1, axis=1))  # a lens's blur
        grey = np.clip(grey + rng.normal(0, 2, grey.shape), 0, 255).astype(np.uint8)
        along = np.array([np.sin(turn_rad), np.cos(turn_rad), 0.0]) * HALF_LENGTH_M
        middle = np.array([side_m + offset_m, 0.0, RANGE_M])
        found.append(PipeView(grey, CAMERA, middle - along, middle + along, np.eye(3)))
    return found


@pytest.mark.parametrize("offset_m", [0.0, 0.006, -0.006])
def test_radius_and_axis_in_spite_of_stripes(offset_m):
    found = width_by_texture(views(offset_m=offset_m))
    assert found is not None
    assert abs(found.radius_m - RADIUS_M) < 2 * found.sigma_m
    assert found.sigma_m < 2e-3  # half a pixel at this range
    assert found.offset_m[0] == pytest.approx(-offset_m, abs=2e-3)


def test_many_seeds_stay_within_what_is_stated():
    found = [width_by_texture(views(seed=seed)) for seed in range(12)]
    off = np.array([(one.radius_m - RADIUS_M) / one.sigma_m for one in found if one is not None])
    assert len(off) >= 11
    assert (np.abs(off) < 2.5).all()


@pytest.mark.parametrize(
    "wrong",
    [{"textured": False}, {"count": 3}, {"turn_rad": np.deg2rad(30.0)}, {"offset_m": 0.06}],
    ids=["bare wall", "few views", "another direction", "beside the pipe"],
)
def test_nothing_is_said_where_nothing_shows(wrong):
    assert width_by_texture(views(**wrong)) is None


def test_no_views():
    assert width_by_texture([]) is None
