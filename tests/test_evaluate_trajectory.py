"""Trajectory errors by hand."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from surecut.factors.errors import LogError
from surecut.simulation.evaluate_trajectory import (
    Trajectory,
    associate,
    compare_trajectories,
    read_tum,
    rigid_alignment,
)


def circle(n=40):
    angles = np.linspace(0.0, 5.0, n)
    poses = np.tile(np.eye(4), (n, 1, 1))
    poses[:, :3, :3] = Rotation.from_rotvec(np.outer(angles, [0.0, 0.0, 1.0])).as_matrix()
    poses[:, :3, 3] = np.c_[np.cos(angles), np.sin(angles), 0.1 * angles]
    return Trajectory(np.arange(n) * 100_000_000, poses)


def moved(trajectory, motion):
    return Trajectory(trajectory.stamps_ns, motion @ trajectory.poses)


def motion():
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_rotvec([0.3, -0.2, 0.9]).as_matrix()
    matrix[:3, 3] = [1.0, 2.0, -0.5]
    return matrix


def test_a_moved_copy_has_only_an_absolute_error():
    error = compare_trajectories(moved(circle(), motion()), circle())
    assert error.ate_rms_m > 1.0
    assert error.ate_aligned_rms_m == pytest.approx(0.0, abs=1e-9)
    assert error.rotation_median_rad == pytest.approx(0.0, abs=1e-6)
    assert error.rpe_rms_m == pytest.approx(0.0, abs=1e-9)
    assert error.end_m == pytest.approx(0.0, abs=1e-9)
    assert error.path_m == pytest.approx(5.0 * np.hypot(1.0, 0.1), rel=1e-3)


def test_a_constant_step_too_long_is_the_relative_error():
    n = 11
    poses = np.tile(np.eye(4), (n, 1, 1))
    reference = Trajectory(np.arange(n) * 10**9, poses.copy())
    reference.poses[:, 0, 3] = np.arange(n)
    estimate = Trajectory(reference.stamps_ns, poses.copy())
    estimate.poses[:, 0, 3] = 1.1 * np.arange(n)
    error = compare_trajectories(estimate, reference)
    assert error.rpe_rms_m == pytest.approx(0.1)
    assert error.end_m == pytest.approx(1.0)
    assert error.path_m == pytest.approx(10.0)


def test_alignment_is_no_reflection():
    rng = np.random.default_rng(0)
    points = rng.normal(0.0, 1.0, (6, 3)) * [1.0, 1.0, 1e-3]
    mirrored = points * [1.0, 1.0, -1.0]
    assert np.linalg.det(rigid_alignment(points, mirrored)[:3, :3]) == pytest.approx(1.0)


def test_associate_takes_every_reference_once_and_respects_the_tolerance():
    pairs = associate(np.array([0, 4, 20, 95]), np.array([5, 22, 60]), 10)
    assert pairs.tolist() == [[1, 0], [2, 1]]


def test_tum_stamps_keep_their_nanoseconds(tmp_path):
    path = tmp_path / "t.txt"
    path.write_text("# t x y z q\n1527170000.123456789 1 2 3 0 0 0 1\n1527170001.5 1 2 3 0 0 1 0\n")
    trajectory = read_tum(path)
    assert trajectory.stamps_ns.tolist() == [1527170000123456789, 1527170001500000000]
    np.testing.assert_allclose(trajectory.poses[1, :3, :3], np.diag([-1.0, -1.0, 1.0]), atol=1e-12)


@pytest.mark.parametrize("text", ["", "1.0 2.0\n", "a b c d e f g h\n"])
def test_no_tum(tmp_path, text):
    path = tmp_path / "t.txt"
    path.write_text(text)
    with pytest.raises(LogError):
        read_tum(path)


def test_nothing_in_common():
    later = circle()
    with pytest.raises(LogError, match="in common"):
        compare_trajectories(Trajectory(later.stamps_ns + 10**12, later.poses), circle())
