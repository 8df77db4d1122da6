"""Corners noisier than they say: the recording tells by how much, and the consistency test still hears of it."""

from dataclasses import replace

import numpy as np
import pytest

from surecut.estimator import corner_factors
from surecut.estimator.bundle import bundles
from surecut.estimator.consistency import family_tests
from surecut.estimator.corner_factors import CornerFactors
from surecut.estimator.engine import Engine
from surecut.estimator.run import solved
from surecut.estimator.surfaces import lay_on_surfaces
from surecut.factors.measurements import MarkerSighting
from surecut.factors.rig import Rig
from surecut.simulation.measurement_level import draw
from surecut.simulation.measurement_level_scenario import Scenario


def solution(factor: float):
    asked = {
        "name": "corners",
        "motion": {"duration_s": 12.0},
        "tracks": {"per_frame": 40},
        "clouds": {"frames": 0},
        "noise_factors": {"markers": factor},
    }
    run = draw(Scenario.model_validate(asked), 5)
    engine = Engine(run.rig, run.cameras, lay_on_surfaces, False)
    for bundle in bundles(list(run.measurements)):
        engine.add(bundle)
    found = solved(engine).at
    corners = next(f for f in family_tests(found) if f.family == "marker corners")
    sigma = np.sqrt(np.diag(found.system.joint([engine.boards.key("f0")])))
    return sigma, corners.chi2 / corners.dof


def test_larger_errors_widen_the_pose_of_the_board_and_are_told():
    right, chi2_right = solution(1.0)
    wrong, chi2_wrong = solution(1.6)
    assert 0.7 < chi2_right < 1.3
    assert chi2_wrong == pytest.approx(1.6**2 * chi2_right, rel=0.25)  # in units of what was stated
    assert 1.2 < np.median(wrong / right) < 1.8


def sighting(common_px: float, sigma_px: float = 0.05) -> MarkerSighting:
    square = 20.0 * np.array([[0.0, 1.0], [1.0, 1.0], [1.0, 0.0], [0.0, 0.0]])
    covariance = np.tile(sigma_px**2 * np.eye(2), (4, 1, 1))
    return MarkerSighting(0, "m_left", "f0", 0, square, covariance, square, common_px)


def test_what_many_images_say_of_the_common_part_is_the_least_for_each():
    factors = CornerFactors(Rig(), None, None)  # pyright: ignore[reportArgumentType]
    floor = Rig().noise.marker_common_px
    assert factors._least_common_px(sighting(0.0)) == floor
    assert factors._least_common_px(sighting(0.04)) == pytest.approx(0.04 / np.sqrt(2))
    assert factors._least_common_px(sighting(0.04)) == pytest.approx(0.04 * np.sqrt(2 / 3))
    of_machine = replace(sighting(0.01), camera="b_rgb")
    assert factors._least_common_px(of_machine) == pytest.approx(0.01)  # another lens and another page of its own


@pytest.mark.parametrize(
    ("common_px", "sigma_px", "lasting_px"),
    [
        (0.0, 0.05, corner_factors.LASTING_PX),
        (0.04, 0.05, 0.04 / np.sqrt(2)),
        (0.0, 0.01, 0.01 * np.sqrt(0.5)),  # no more than the corner's own sigma holds
    ],
)
def test_a_part_of_the_error_stays_on_the_page(common_px, sigma_px, lasting_px):
    assert corner_factors._lasting_px(sighting(common_px, sigma_px), 0.0) == pytest.approx(lasting_px)
