"""The strongest check of a mount: {b} once by the board and the tape, once by the Kinect's cloud alone, compared."""

from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray

from ..factors.calibration import depth_sigmas
from ..factors.cloud import plane_factor
from ..factors.geometry import pose3
from ..factors.links import mount_pose, weak_pose_prior
from ..factors.measurements import CloudFrame, Event
from ..factors.noise import pose_sigmas, robust, sigmas
from ..frontends.cloud.associate import associate
from ..frontends.cloud.noise import SMOOTH_RAD, SMOOTH_SHARE
from ..frontends.cloud.point_registration import register_points
from .agreement import ERROR_SIGMA, TOLD_SIGMA, cylinder_event, cylinder_test, cylinder_tests
from .consistency import PriorTest
from .correlation import Active
from .depth_pipes import FAMILY as CYLINDER
from .depth_pipes import SeenCylinder
from .engine import Engine
from .landmark_map import LandmarkMap, landmark_map
from .linear import LinearSystem, deviate
from .surfaces import FAMILY as CLOUD
from .surfaces import SAME_SIDE_COSINE

Float = NDArray[np.float64]

OTHER_WAYS = ("mount", CLOUD, CYLINDER)
"""Families that place {b}, by the mount or by landmarks on other surfaces than those that are near now."""
SAME_PIPE_SIGMA = 4.0
WEAK_SIGMA = 0.3
"""Sigma of {b} (rad, or m) beyond which the cloud tells nothing about a mount in that direction."""


@dataclass(frozen=True, slots=True)
class MountTest:
    """The taped `f_T_b` against the one that the cloud shows."""

    board: str
    sigma: float
    """The disagreement, as the deviate of a normal variable that is as improbable."""
    directions: int
    """Of six that the cloud holds; the others, such as along a bare wall, are left out of all of these numbers."""
    shift_m: float
    turn_rad: float
    shift_sigma_m: float
    turn_sigma_rad: float
    landmarks: int
    pipes: int
    stamp_ns: int

    @property
    def name(self) -> str:
        return f"board {self.board} and mount, against the Kinect's cloud"

    def event(self) -> Event | None:
        """What a user has to know; None where both ways agree."""
        if self.sigma < TOLD_SIGMA:
            return None
        held = "" if self.directions == 6 else f", which holds {self.directions} of 6 directions,"
        on_it = f"{self.landmarks} landmarks" + (f" and {self.pipes} pipes" if self.pipes else "")
        text = (
            f"mount: by {on_it} on the Kinect's cloud{held} {{b}} stands {1e3 * self.shift_m:.0f} +/- "
            f"{1e3 * self.shift_sigma_m:.0f} mm and {np.degrees(self.turn_rad):.1f} +/- "
            f"{np.degrees(self.turn_sigma_rad):.1f} degrees from the rig file's f_T_b of board {self.board} "
            f"({self.sigma:.1f} sigma); measure the mount again"
        )
        values = {
            "sigma": self.sigma,
            "shift_m": self.shift_m,
            "turn_rad": self.turn_rad,
            "turn_sigma_rad": self.turn_sigma_rad,
        }
        return Event(self.stamp_ns, "mount_wrong", text, "error" if self.sigma > ERROR_SIGMA else "warning", values)


def compared_with_cloud(
    engine: Engine, active: Active, system: LinearSystem, values: gtsam.Values
) -> tuple[list[PriorTest], dict[str, float]]:
    """Pipes and mount against the Kinect's cloud: tests, and disagreements in sigmas by name. Tells the engine."""
    tests = cylinder_tests(engine.depth_pipes, active, system, values)
    ways = {test.record.what: test.sigma for test in tests}
    told = [cylinder_event(test) for test in tests]
    mount = mount_test(engine, active, system, values)
    if mount is not None:
        ways[mount.name] = mount.sigma
        told.append(mount.event())
    engine.events += [event for event in told if event is not None]
    return tests, ways


def mount_test(engine: Engine, active: Active, system: LinearSystem, values: gtsam.Values) -> MountTest | None:
    """Places {b} by the cloud, without the mount, and compares. None where the cloud does not hold it.

    The landmarks' places come from all other factors, so both ways share the mobile camera's map; the covariance of
    the difference is that of board and {b} together in a graph without mount.
    """
    mount, cloud, base = engine.rig.mount, engine.surfaces.cloud, engine.base
    if mount is None or cloud is None or not values.exists(base) or not engine.boards.known(mount.board):
        return None
    found = landmark_map(engine)
    if len(found.keys) == 0:
        return None
    guess = values.atPose3(base).matrix()
    placed = register_points(found.points, cloud, guess, depth_sigmas(engine.rig.kinect))
    if placed is None or not placed.plausible:
        return None
    tests = [_test_from(start, engine, found, active, system, values) for start in (pose3(placed.o_T_b), pose3(guess))]
    return min((test for test in tests if test is not None), key=lambda test: test.sigma, default=None)


def _test_from(
    o_T_b: gtsam.Pose3, engine: Engine, found: LandmarkMap, active: Active, system: LinearSystem, values: gtsam.Values
) -> MountTest | None:
    """The test with landmarks on the surfaces that are near from one place of {b}.

    Few landmarks find other surfaces from another place. A mount is contradicted where neither its own place nor that
    of the registration agrees with it.
    """
    mount, cloud, base = engine.rig.mount, engine.surfaces.cloud, engine.base
    assert mount is not None
    assert cloud is not None
    start = gtsam.Values(values)
    start.update(base, o_T_b)
    planes = _planes(found, cloud, base, start, engine.rig.gates.robust_sigma)
    at_base = [
        i for i, (_, factor, record) in enumerate(active) if record.family in OTHER_WAYS or base in factor.keys()
    ]
    factors = [active[i][1] for i in at_base if active[i][2].family not in OTHER_WAYS] + planes
    factors.append(weak_pose_prior(base, start.atPose3(base), 1.0, 1.0))
    without, solved = _solved(system.exchanged(at_base, _graph(factors), start), start)
    pipes = [seen for seen in engine.depth_pipes.seen.values() if _fits(seen, without, solved)]
    if pipes:
        last = range(len(without.rows) - len(factors), len(without.rows))
        factors += [seen.factor() for seen in pipes]
        without, solved = _solved(without.exchanged(last, _graph(factors), solved), solved)
    unit = gtsam.BetweenFactorPose3(engine.boards.key(mount.board), base, mount_pose(mount), pose_sigmas(1.0, 1.0))
    linear = unit.linearize(solved)
    J, residual = linear.jacobian()
    spread = without.covariance([(k, J[:, 6 * i : 6 * i + 6]) for i, k in enumerate(linear.keys())])
    own = np.diag([mount.rotation_sigma_rad**2] * 3 + [mount.translation_sigma_m**2] * 3)
    held = held_part(residual, spread, own)
    if held is None:
        return None
    size = [float(np.linalg.norm(held.residual[part])) for part in (slice(0, 3), slice(3, 6))]
    noise = [float(np.sqrt(np.trace(held.covariance[part, part]))) for part in (slice(0, 3), slice(3, 6))]
    return MountTest(
        mount.board, deviate(held.total, held.directions), held.directions, size[1], size[0], noise[1], noise[0],
        len(planes), len(pipes), cloud.stamp_ns,
    )  # fmt: skip


@dataclass(frozen=True, slots=True)
class HeldPart:
    """A disagreement along the directions that the looser one of two ways still holds."""

    total: float
    """Chi-square."""
    directions: int
    residual: Float
    """Shape (6,)."""
    covariance: Float
    """Shape (6, 6), of rank `directions`."""


def held_part(residual: Float, spread: Float, own: Float) -> HeldPart | None:
    """The part of a disagreement along the directions that `spread` leaves surer than `WEAK_SIGMA`.

    They are eigenvectors of the spread and do not depend on the residual, so that the chi-square is one of that many
    degrees of freedom.

    Args:
        residual: shape (6,), rotation first.
        spread: shape (6, 6), covariance of the way that may leave directions loose.
        own: shape (6, 6), covariance of the other.

    Returns:
        None where nothing is held.
    """
    values, vectors = np.linalg.eigh(spread)
    basis = vectors[:, values < WEAK_SIGMA**2]
    if basis.shape[1] == 0:
        return None
    part, covariance = basis.T @ residual, basis.T @ (spread + own) @ basis
    total = float(part @ np.linalg.solve(covariance, part))
    return HeldPart(total, basis.shape[1], basis @ part, basis @ covariance @ basis.T)


def _graph(factors: list[gtsam.NonlinearFactor]) -> gtsam.NonlinearFactorGraph:
    graph = gtsam.NonlinearFactorGraph()
    for factor in factors:
        graph.add(factor)
    return graph


def _fits(seen: SeenCylinder, system: LinearSystem, values: gtsam.Values) -> bool:
    """Is a pipe in the cloud the one that the mobile camera saw, {b} standing where the surfaces put it?"""
    test = cylinder_test(seen, None, system, values)
    return test.sigma < SAME_PIPE_SIGMA


def _solved(system: LinearSystem, start: gtsam.Values) -> tuple[LinearSystem, gtsam.Values]:
    """One Gauss-Newton step: {b} has moved most of the way by the registration already."""
    settled, step, _ = system.settled()
    return settled, system.moved(start, step)


def _planes(
    found: LandmarkMap, cloud: CloudFrame, base: int, values: gtsam.Values, robust_sigma: float
) -> list[gtsam.NonlinearFactor]:
    """Landmarks on the cloud's surfaces as factors; what parts of the view share counts for all their landmarks."""
    o_T_b = values.atPose3(base)
    R, t = o_T_b.rotation().matrix(), o_T_b.translation()
    b_p, eyes = (found.points.points_m - t) @ R, (found.points.seen_from_m - t) @ R
    matches = associate(b_p, found.points.sigma_m, cloud)
    towards = eyes[matches.landmark] - matches.point_m
    facing = (matches.normal * towards).sum(axis=1) > SAME_SIDE_COSINE * np.linalg.norm(towards, axis=1)
    rows, point, normal = matches.landmark[facing], matches.point_m[facing], matches.normal[facing]
    sigma2 = (matches.sigma_m**2 + matches.bias_m**2)[facing]
    cells = np.floor(point[:, :2] / point[:, 2:] / np.tan(SMOOTH_RAD)).astype(int)
    _, cell, count = np.unique(cells, axis=0, return_inverse=True, return_counts=True)
    shared = SMOOTH_SHARE * np.abs((normal * point).sum(axis=1))
    sigma = np.sqrt(sigma2 + count[cell.ravel()] * shared**2)
    return [
        plane_factor(base, found.keys[row], p, n, robust(sigmas([float(s)]), robust_sigma))
        for row, p, n, s in zip(rows, point, normal, sigma, strict=True)
    ]
