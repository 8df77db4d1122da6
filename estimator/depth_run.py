"""A recording of depth alone: the path of {b}, clouds registered to earlier ones as the factors of the graph."""

from collections.abc import Iterable, Mapping
from pathlib import Path

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ..factors import keys
from ..factors.geometry import pose3, ros_covariance
from ..factors.links import base_motion_factor, gauge_prior, motion_prior
from ..factors.measurements import CloudFrame, Event
from ..factors.rig import Rig, dump_rig
from ..frontends.cloud.depth_odometry import DepthOdometry
from ..frontends.cloud.registration import RegistrationConfig, SurfaceMap, register
from .batch import solve
from .consistency import family_tests, judge
from .depth_clouds import depth_clouds
from .engine import Engine
from .graph import Record, Update
from .incremental import Incremental
from .odometry import FramePose, OdometrySettings
from .result import PoseEstimate, Result
from .sensing import SensingReport
from .surroundings import Surroundings, compact_map

Float = NDArray[np.float64]

FAMILY = "cloud registration"
KEYFRAME_M, KEYFRAME_RAD = 0.05, 0.04
"""A cloud so far from the last keyframe is the next one. Each is tied to the one before only: further pairs repeat the
depth camera's own distortion, which is the same in all of them, and would count it as known better each time."""
REGISTRATION = RegistrationConfig(reaches_m=(0.10, 0.05), iterations=10)
LEAST_OVERLAP = 0.3
"""Part of a cloud that must meet the last keyframe's."""


class DepthRun:
    """The graph of a depth camera that is carried about. {o} is its first pose."""

    def __init__(self) -> None:
        self._solver = Incremental()
        self._odometry = DepthOdometry()
        self._keyframes: list[tuple[CloudFrame, Float]] = []
        """Clouds, and where the odometry had them."""
        self._newest: tuple[CloudFrame, Float] | None = None
        self._surface: SurfaceMap | None = None
        """Of the last keyframe."""
        self._values = gtsam.Values()
        self.frames: list[FramePose] = []
        self.events: list[Event] = []

    def add(self, cloud: CloudFrame) -> None:
        """The next cloud."""
        pose = self._odometry.add(cloud).first_T_this
        self._newest = cloud, pose
        if not self._keyframes or _far(np.linalg.inv(self._keyframes[-1][1]) @ pose):
            self._insert(cloud, pose)
        moved = np.linalg.inv(self._keyframes[-1][1]) @ pose
        self.frames.append(FramePose(cloud.stamp_ns, len(self._keyframes) - 1, moved))

    def result(self, rig: Rig, timing: Mapping[str, float], provenance: Mapping[str, str]) -> Result:
        """The path with covariances."""
        assert self._newest is not None
        if self._newest[0] is not self._keyframes[-1][0]:
            self._insert(*self._newest)
            self.frames[-1] = FramePose(self._newest[0].stamp_ns, len(self._keyframes) - 1, np.eye(4))
        solution = solve(self._solver.log, self._values, rig.gates.robust_sigma)
        marginals = solution.at.system.marginals([keys.base(i) for i in range(len(self._keyframes))])
        trajectory = []
        for frame in self.frames:
            o_T_k = solution.values.atPose3(keys.base(frame.keyframe))
            own = self._keyframes[frame.keyframe][0].stamp_ns == frame.stamp_ns
            covariance = ros_covariance(o_T_k, marginals[frame.keyframe]) if own else None
            matrix = o_T_k.matrix() @ frame.keyframe_T_this
            trajectory.append(PoseEstimate("b", "o", frame.stamp_ns, matrix, covariance))
        end_ns = trajectory[-1].stamp_ns
        text = (
            f"nothing but depth was recorded: the path of {{b}} over {len(trajectory)} clouds, in the frame of the "
            "first; no pipe point can be given"
        )
        return Result(
            points=(),
            poses=(trajectory[-1],),
            trajectory=tuple(trajectory),
            pipes=(),
            calibration=(),
            distances=(),
            consistency=judge(family_tests(solution.at), [], {}),
            rejected=solution.rejected,
            events=(*self.events, Event(end_ns, "depth_alone", text, "warning")),
            streaming_difference_sigma={},
            timing=dict(timing),
            provenance=dict(provenance),
            config_yaml=dump_rig(rig),
            last_board_view_ns=None,
            end_ns=end_ns,
            surroundings=compact_map(self._map(solution.values)),
        )

    def _insert(self, cloud: CloudFrame, pose: Float) -> None:
        """A keyframe, tied to the last one by the registration of both clouds."""
        index, update = len(self._keyframes), Update()
        key = keys.base(index)
        if index == 0:
            update.guess(key, gtsam.Pose3())
            update.add(gauge_prior(key), Record("gauge", "gauge", cloud.stamp_ns, "origin {o}", rejectable=False))
        else:
            motion = self._link(update, index, cloud, np.linalg.inv(self._keyframes[-1][1]) @ pose)
            update.guess(key, self._values.atPose3(keys.base(index - 1)).compose(pose3(motion)))
        self._keyframes.append((cloud, pose))
        self._surface = SurfaceMap.of(cloud)
        self._values = self._solver.update(update)

    def _link(self, update: Update, index: int, cloud: CloudFrame, guess: Float) -> Float:
        """Adds the factor between the last keyframe and this cloud; returns the motion."""
        assert self._surface is not None
        before, after = keys.base(index - 1), keys.base(index)
        last = self._keyframes[-1][0]
        found = register(self._surface, cloud, guess, REGISTRATION)
        what = f"cloud at {cloud.stamp_ns} ns on that at {last.stamp_ns} ns"
        if found.overlap >= LEAST_OVERLAP:
            factor = base_motion_factor(before, after, found.a_T_b, found.covariance)
            update.add(factor, Record(FAMILY, FAMILY, cloud.stamp_ns, what, rejectable=False))
            return found.a_T_b
        seconds = abs(cloud.stamp_ns - last.stamp_ns) * 1e-9
        settings = OdometrySettings()
        factor = motion_prior(before, after, pose3(guess), seconds, settings.lost_speed_m_s, settings.lost_turn_rad_s)
        update.add(factor, Record(FAMILY, "motion prior", cloud.stamp_ns, what, rejectable=False))
        text = f"{what}: only {100 * found.overlap:.0f} % of it meets; the motion over {seconds:.2f} s is a guess"
        self.events.append(Event(cloud.stamp_ns, "depth_lost", text, "warning", {"overlap": found.overlap}))
        return guess

    def _map(self, values: gtsam.Values) -> Surroundings:
        """All keyframes' surfaces in the last {b}."""
        last = values.atPose3(keys.base(len(self._keyframes) - 1)).inverse()
        points = []
        for i, (cloud, _) in enumerate(self._keyframes):
            T = last.compose(values.atPose3(keys.base(i))).matrix()
            points.append(cloud.points_m @ T[:3, :3].T + T[:3, 3])
        sigma = np.concatenate([cloud.sigma_m for cloud, _ in self._keyframes])
        seen = np.vstack(points)
        return Surroundings(seen, sigma, (), seen)


def depth_alone(engine: Engine, report: SensingReport) -> bool:
    """Has a run of the pipeline met neither a mobile camera nor anything that it could be meant to place?

    With boards in the rig their absence from the log is a mistake that has to be told.
    """
    mobile = engine.odometry.keyframe_stamps or report.pairing.pairs or report.pairing.unpaired
    return report.depths > 0 and not (mobile or engine.rig.boards or engine.picks or engine.lost_picks())


def depth_result(
    log: Path, rig: Rig, timing: Mapping[str, float], provenance: Mapping[str, str], events: Iterable[Event]
) -> Result:
    """The path of the depth camera of a recording.

    Raises:
        LogError: no depth in it, or no calibration.
    """
    run = DepthRun()
    run.events += events
    for cloud in depth_clouds(log, rig):
        run.add(cloud)
    return run.result(rig, timing, provenance)


def _far(motion: Float) -> bool:
    turn = float(Rotation.from_matrix(motion[:3, :3]).magnitude())
    return bool(np.linalg.norm(motion[:3, 3]) > KEYFRAME_M or turn > KEYFRAME_RAD)
