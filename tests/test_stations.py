"""The machine is moved between two stations: seen by its depth camera, and one `o_T_b` each."""

import gtsam
import numpy as np
from test_cloud_frontend import CAMERA, corner

from surecut.estimator.boards import Boards
from surecut.estimator.depth_sensor import DepthSensor
from surecut.estimator.graph import State
from surecut.estimator.stations import Stations, move_event
from surecut.factors import keys
from surecut.factors.measurements import BaseMove
from surecut.factors.rig import Board, Kinect, Marker, Rig

PERIOD_NS = 200_000_000


def driven():
    """Views of a depth camera that stands, drives and stands again."""
    sensor, views = DepthSensor(Kinect()), []
    places = [0.0] * 12 + list(np.linspace(0.02, 0.16, 8)) + [0.16] * 16
    for step, x in enumerate(places):
        pose = np.eye(4)
        pose[0, 3], pose[2, 3] = x, 0.5 * x
        view = sensor.image(step * PERIOD_NS, corner(pose, seed=step), CAMERA)
        views += [] if view is None else [view]
    return views


def test_views_are_averaged_within_a_station_and_tell_the_move_between():
    views = driven()
    assert [view.moved is not None for view in views] == [False, True]
    move = views[1].moved
    assert 11 * PERIOD_NS <= move.start_ns <= 15 * PERIOD_NS
    assert 19 * PERIOD_NS <= move.stamp_ns <= 24 * PERIOD_NS
    np.testing.assert_allclose(move.before_T_after[:3, 3], (0.16, 0, 0.08), atol=0.006)
    error = move.before_T_after[:3, 3] - (0.16, 0, 0.08)
    assert error @ np.linalg.solve(move.covariance[3:, 3:], error) < 16.3  # 99.9 % of chi-square with 3
    # the second view shows the second station alone: walls stay sharp
    np.testing.assert_allclose(np.nanmedian(views[1].depth_m), np.nanmedian(corner(shifted())), atol=0.003)


def shifted():
    pose = np.eye(4)
    pose[:3, 3] = (0.16, 0, 0.08)
    return pose


def test_each_station_has_its_pose_and_takes_its_boards_along():
    rig = Rig(boards=(Board(id="f0", markers=(Marker(id=0, centre_m=(0.0, 0.0)),)),))
    state = State()
    boards, stations = Boards(rig, state), Stations(state)
    o_T_b, b_T_f = gtsam.Pose3.Expmap(np.array([0.1, 0.2, 0, 1.0, 0, 0])), gtsam.Pose3.Expmap(np.full(6, 0.2))
    state.values.insert(stations.base, o_T_b)
    state.values.insert(boards.key("f0"), o_T_b.compose(b_T_f))
    boards.sheets["f0"].known = True
    move = BaseMove(10, 20, shifted(), np.eye(6) * 1e-4)
    update = stations.move(move, boards)
    assert (stations.base, stations.frame) == (keys.base(1), "b1")
    assert [stations.at(t) for t in (5, 10, 19, 20)] == [keys.base(0), None, None, keys.base(1)]
    moved = update.values.atPose3(keys.base(1))
    np.testing.assert_allclose(o_T_b.between(moved).matrix(), shifted(), atol=1e-12)
    np.testing.assert_allclose(
        moved.between(update.values.atPose3(boards.key("f0"))).matrix(), b_T_f.matrix(), atol=1e-12
    )
    values = gtsam.Values(state.values)
    values.insert(update.values)
    assert sum(factor.error(values) for factor in update.factors) < 1e-12
    assert move_event(move).values["shift_m"] == np.hypot(0.16, 0.08)
