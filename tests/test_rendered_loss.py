"""Total loss of view on rendered pixels: a turn that no track survives, darkness, a strange view; `-m campaign`."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from surecut.estimator.optimise import optimise
from surecut.simulation.campaign_pixels import truth_of_log
from surecut.simulation.evaluate import motion_quantities, pose_quantity
from surecut.simulation.recording import simulate
from surecut.simulation.scenario import load_scenarios, override

pytestmark = pytest.mark.campaign

AWAY_S, BACK_S = 8.0, 11.5
"""When the view is lost, and when the place of before is in view again."""
SMALLER = {"mobile": {"rate_hz": 10}, "kinect": {"rate_hz": 1, "width": 320, "height": 240, "depth_focal_px": 292.5}}


def run(folder, name):
    log = folder / f"{name}.mcap"
    (scenario,) = load_scenarios(name)
    simulate(log, override(scenario, SMALLER), 5, workers=1)
    return optimise(log), truth_of_log(log)


@pytest.fixture(scope="module")
def estimated(tmp_path_factory):
    return run(tmp_path_factory.mktemp("rendered"), "whirl")


@pytest.fixture(scope="module")
def lost_twice(tmp_path_factory):
    return run(tmp_path_factory.mktemp("rendered"), "strange")


def errors(result, truth, seconds):
    """Position m and rotation deg of all frames within some seconds, in the {o} of the start."""
    true = dict(zip(truth.stamps_ns, truth.o_T_m, strict=True))
    start_ns = min(true)
    off = []
    for pose in result.trajectory:
        if pose.stamp_ns in true and seconds[0] <= (pose.stamp_ns - start_ns) * 1e-9 <= seconds[1]:
            difference = np.linalg.inv(true[pose.stamp_ns]) @ pose.matrix
            off.append(
                (np.linalg.norm(difference[:3, 3]), np.rad2deg(Rotation.from_matrix(difference[:3, :3]).magnitude()))
            )
    return np.array(off)


def test_the_trajectory_goes_on_in_the_same_frame(estimated):
    after = errors(*estimated, (BACK_S, 1e3))
    assert len(after) > 150
    assert after[:, 0].max() < 0.06
    assert after[:, 1].max() < 0.8


def test_the_points_are_found_as_if_nothing_had_happened(estimated):
    result, truth = estimated
    assert result.points
    for point in result.points:
        assert np.linalg.norm(point.position_m - truth.points_b_m[point.id]) < 0.025


def test_what_lies_between_is_known_to_be_uncertain(estimated):
    result, truth = estimated
    true = dict(zip(truth.stamps_ns, truth.o_T_m, strict=True))
    start_ns = min(true)
    for pose in result.trajectory:
        seconds = (pose.stamp_ns - start_ns) * 1e-9
        if pose.covariance is not None and pose.stamp_ns in true and AWAY_S < seconds < BACK_S:
            assert pose_quantity("trajectory", "m", pose.matrix, pose.covariance, true[pose.stamp_ns]).nees < 30.0
    assert max(quantity.nees for quantity in motion_quantities(result.motions, truth)) < 30.0


def test_a_strange_view_between_two_losses_harms_nothing(lost_twice):
    """Only the page, at the end, shows where the camera has been since the second loss."""
    result, truth = lost_twice
    after = errors(result, truth, (8.6, 1e3))
    assert len(after) > 200
    assert after[:, 0].max() < 0.03
    assert after[:, 1].max() < 0.6
    assert result.points
    for point in result.points:
        assert np.linalg.norm(point.position_m - truth.points_b_m[point.id]) < 0.025
    assert max(quantity.nees for quantity in motion_quantities(result.motions, truth)) < 30.0
    assert result.consistency.passed
    assert [e.kind for e in result.events if e.severity != "info"] == ["sight_lost"]


def test_the_strange_view_is_known_to_be_anywhere(lost_twice):
    result, truth = lost_twice
    true = dict(zip(truth.stamps_ns, truth.o_T_m, strict=True))
    strange = [p for p in result.trajectory if 5.0e9 < p.stamp_ns - min(true) < 7.0e9 and p.covariance is not None]
    assert strange
    for pose in strange:
        assert pose_quantity("trajectory", "m", pose.matrix, pose.covariance, true[pose.stamp_ns]).nees < 30.0
