"""Trajectories against a reference: absolute and relative errors, and the TUM text format."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ..factors.errors import LogError

Float = NDArray[np.float64]
Int = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Trajectory:
    """Poses in one frame, sorted by time."""

    stamps_ns: Int
    poses: Float
    """Shape (n, 4, 4)."""


@dataclass(frozen=True, slots=True)
class TrajectoryError:
    """Errors of an estimate against a reference."""

    pairs: int
    ate_rms_m: float
    """Of the positions as they are."""
    ate_aligned_rms_m: float
    """After the best rigid motion."""
    rotation_median_rad: float
    """After the same motion."""
    end_m: float
    """At the last pair, starts put together."""
    path_m: float
    """Length of the reference."""
    rpe_rms_m: float
    rpe_rms_rad: float
    """Of the motion from pair to pair."""


def read_tum(path: Path) -> Trajectory:
    """Lines `t x y z qx qy qz qw`, seconds and metres; # begins a comment.

    Raises:
        LogError: the file is no such table.
    """
    stamps_ns, rows = [], []
    try:
        lines = path.read_text().splitlines()
    except OSError as error:
        raise LogError(f"{path}: cannot be read ({error.strerror})") from error
    for number, line in enumerate(lines, 1):
        fields = line.split("#", 1)[0].split()
        if not fields:
            continue
        try:
            seconds, _, fraction = fields[0].partition(".")
            stamps_ns.append(int(seconds) * 10**9 + int((fraction + "0" * 9)[:9]))
            rows.append([float(field) for field in fields[1:8]])
        except ValueError as error:
            raise LogError(f"{path}: line {number} is no TUM pose") from error
    data = np.array(rows)
    if data.ndim != 2 or data.shape[1] != 7:
        raise LogError(f"{path}: is no TUM trajectory; a line is `t x y z qx qy qz qw`")
    poses = np.tile(np.eye(4), (len(data), 1, 1))
    poses[:, :3, :3] = Rotation.from_quat(data[:, 3:]).as_matrix()
    poses[:, :3, 3] = data[:, :3]
    return Trajectory(np.array(stamps_ns, dtype=np.int64), poses)


def compare_trajectories(
    estimate: Trajectory, reference: Trajectory, tolerance_ns: int = 10_000_000
) -> TrajectoryError:
    """Absolute and relative error over the stamps that both have, to within `tolerance_ns`.

    Raises:
        LogError: fewer than three stamps in common.
    """
    rows = associate(estimate.stamps_ns, reference.stamps_ns, tolerance_ns)
    if len(rows) < 3:
        raise LogError(f"trajectories have {len(rows)} stamps in common; three are needed")
    mine, theirs = estimate.poses[rows[:, 0]], reference.poses[rows[:, 1]]
    motion = rigid_alignment(mine[:, :3, 3], theirs[:, :3, 3])
    aligned = motion @ mine
    turns = Rotation.from_matrix(np.swapaxes(theirs[:, :3, :3], 1, 2) @ aligned[:, :3, :3]).magnitude()
    start = theirs[0] @ np.linalg.inv(mine[0])
    relative = np.linalg.inv(np.linalg.inv(theirs[:-1]) @ theirs[1:]) @ (np.linalg.inv(mine[:-1]) @ mine[1:])
    steps_m = np.linalg.norm(relative[:, :3, 3], axis=1)
    steps_rad = Rotation.from_matrix(relative[:, :3, :3]).magnitude()
    return TrajectoryError(
        pairs=len(rows),
        ate_rms_m=_rms(np.linalg.norm(mine[:, :3, 3] - theirs[:, :3, 3], axis=1)),
        ate_aligned_rms_m=_rms(np.linalg.norm(aligned[:, :3, 3] - theirs[:, :3, 3], axis=1)),
        rotation_median_rad=float(np.median(turns)),
        end_m=float(np.linalg.norm((start @ mine[-1])[:3, 3] - theirs[-1, :3, 3])),
        path_m=float(np.linalg.norm(np.diff(theirs[:, :3, 3], axis=0), axis=1).sum()),
        rpe_rms_m=_rms(steps_m),
        rpe_rms_rad=_rms(steps_rad),
    )


def associate(stamps_ns: Int, reference_ns: Int, tolerance_ns: int) -> Int:
    """Pairs of rows (ours, reference) nearest in time, each reference row once; shape (n, 2)."""
    after = np.clip(np.searchsorted(reference_ns, stamps_ns), 1, len(reference_ns) - 1)
    nearer = np.abs(reference_ns[after - 1] - stamps_ns) <= np.abs(reference_ns[after] - stamps_ns)
    rows = np.where(nearer, after - 1, after)
    gaps = np.abs(reference_ns[rows] - stamps_ns)
    best: dict[int, int] = {}
    for mine in np.argsort(gaps, kind="stable"):
        if gaps[mine] <= tolerance_ns:
            best.setdefault(int(rows[mine]), int(mine))
    return np.array(sorted((mine, row) for row, mine in best.items()), dtype=np.int64).reshape(-1, 2)


def rigid_alignment(points: Float, reference: Float) -> Float:
    """The rigid motion that takes points nearest to the reference (Kabsch), shapes (n, 3); answer (4, 4)."""
    centre, target = points.mean(axis=0), reference.mean(axis=0)
    u, _, vt = np.linalg.svd((reference - target).T @ (points - centre))
    rotation = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
    motion = np.eye(4)
    motion[:3, :3] = rotation
    motion[:3, 3] = target - rotation @ centre
    return motion


def _rms(values: Float) -> float:
    return float(np.sqrt((values**2).mean()))
