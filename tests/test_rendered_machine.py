"""Board path against cloud path on rendered pixels: a mount that is wrong, and no board at all; see `-m campaign`."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from surecut.estimator.optimise import optimise, rig_of
from surecut.factors.rig import Pose, dump_rig
from surecut.io.reader import LogReader
from surecut.simulation.campaign_pixels import truth_of_log
from surecut.simulation.recording import simulate
from surecut.simulation.scenario import Scenario

pytestmark = pytest.mark.campaign

BOTH_SEE_THE_PIPE = {
    "name": "both",
    "place": "A",
    "duration_s": 20,
    "return_to_board": False,
    "pipe": {"hidden": False, "second": True},
    "mobile": {"rate_hz": 10},
    "kinect": {"rate_hz": 1, "width": 320, "height": 240, "depth_focal_px": 292.5, "rgb_focal_px": 262.5},
}


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    path = tmp_path_factory.mktemp("rendered") / "both.mcap"
    simulate(path, Scenario.model_validate(BOTH_SEE_THE_PIPE), 3, workers=1)
    return path


def estimated(log, tmp_path, **changes):
    with LogReader(log, ()) as reader:
        rig = rig_of(reader, None).model_copy(update=changes)
    file = tmp_path / "rig.yaml"
    file.write_text(dump_rig(rig))
    return optimise(log, file), truth_of_log(log)


def cloud_path(result):
    return next(v for k, v in result.consistency.paths.items() if "mount, against the Kinect's cloud" in k)


def test_a_right_mount_agrees_with_the_cloud(log, tmp_path):
    result, truth = estimated(log, tmp_path)
    assert cloud_path(result) < 3.0
    assert not {event.kind for event in result.events} & {"mount_wrong", "cloud_disagrees"}
    for point in result.points:
        assert np.linalg.norm(point.position_m - truth.points_b_m[point.id]) < 0.025
    (pipe,) = result.pipes
    assert np.arccos(min(abs(pipe.axis @ truth.pipe.axis_b), 1.0)) < np.deg2rad(1.0)
    assert abs(pipe.radius_m - truth.pipe.radius_m) < 0.003


def test_a_mount_off_by_20_mm_and_2_degrees_is_named(log, tmp_path):
    with LogReader(log, ()) as reader:
        mount = rig_of(reader, None).mount
    turned = Rotation.from_rotvec(mount.f_T_b.rotation_vector_rad) * Rotation.from_rotvec((0, np.deg2rad(2.0), 0))
    off = Pose(
        translation_m=tuple(np.add(mount.f_T_b.translation_m, (0.02, 0.0, 0.0))),
        rotation_vector_rad=tuple(turned.as_rotvec()),
    )
    result, _ = estimated(log, tmp_path, mount=mount.model_copy(update={"f_T_b": off}))
    assert cloud_path(result) > 3.0
    told = next(event for event in result.events if event.kind == "mount_wrong")
    assert told.severity == "error"
    # 25 landmarks hold the turn to 1.4 degrees (1 sigma) in this recording
    assert told.values["turn_sigma_rad"] < np.deg2rad(2.0)
    assert told.values["turn_rad"] == pytest.approx(np.deg2rad(2.0), abs=2.0 * told.values["turn_sigma_rad"])
    assert "measure the mount again" in told.text


def test_without_a_board_the_points_lie_in_their_own_region(log, tmp_path):
    result, truth = estimated(log, tmp_path, mount=None, boards=(), distances=(), world_board=None, cut_plan=())
    assert "base_by_cloud" in {event.kind for event in result.events}
    for point in result.points:
        error = point.position_m - truth.points_b_m[point.id]
        assert error @ np.linalg.solve(point.covariance_m2, error) < chi2.ppf(0.95, 3)
        assert point.radius95_m < 0.15
