"""One recording before it is rendered: who stands and moves where, and when each camera looks."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from .cell import Cell, build_cell
from .faults import RigPair, draw_rig
from .picks import Click, clicks
from .rigid import inverse, rigid, transform
from .scenario import Scenario
from .stage import Stage, View, build_stage
from .trajectory import Trajectory, plan

Float = NDArray[np.float64]
START_NS = 1_700_000_000_000_000_000
_ATTEMPTS = 12


def generator(seed: int, *stream: int) -> np.random.Generator:
    """Random numbers of one purpose: the same whatever else is drawn, in whatever order."""
    return np.random.default_rng([seed, *stream])


def stamp_ns(time_s: float) -> int:
    """Sensor stamp of a time from the start."""
    return START_NS + round(time_s * 1e9)


@dataclass(frozen=True, slots=True)
class Motion:
    """Poses in {w} by time, s."""

    scenario: Scenario
    cell: Cell
    w_T_c: tuple[Float, Float]
    """The chassis at the first and the second station."""

    def chassis(self, time_s: float) -> Float:
        """`w_T_c`."""
        interval = self.scenario.timeline.base_move
        if interval is None:
            return self.w_T_c[0]
        share = float(np.clip((time_s - interval[0]) / max(interval[1] - interval[0], 1e-6), 0, 1))
        share = share * share * (3 - 2 * share)
        step = inverse(self.w_T_c[0]) @ self.w_T_c[1]
        turn = Rotation.from_matrix(step[:3, :3]).as_rotvec()
        return self.w_T_c[0] @ rigid(share * turn, share * step[:3, 3])

    def kinect(self, time_s: float) -> Float:
        """`w_T_b`."""
        return self.chassis(time_s) @ self.cell.c_T_b

    def page(self, time_s: float) -> Float:
        """`w_T_f`."""
        knock = self.scenario.board.knock
        knocked = knock is not None and time_s >= knock.at_s
        shift = rigid(knock.turn_rad, knock.shift_m) if knock and knocked else np.eye(4)
        return self.chassis(time_s) @ self.cell.c_T_f @ shift

    def poses(self, time_s: float) -> dict[str, Float]:
        """`w_T_body` of every body."""
        poses = {body.name: np.eye(4) for body in self.cell.bodies}
        poses["machine"] = self.chassis(time_s)
        poses["page"] = self.page(time_s)
        if "upper_arm" in poses:
            upper = self.chassis(time_s) @ self._shoulder(time_s)
            poses["upper_arm"] = upper
            bend = 0.6 + 0.5 * np.sin(0.9 * time_s + 1.0)
            poses["fore_arm"] = upper @ rigid((bend, 0, 0), (0, 0.75, 0))
        return poses

    def _shoulder(self, time_s: float) -> Float:
        side = self.cell.side
        swing = side * (-0.55 + 0.45 * np.sin(0.7 * time_s))
        lift = 0.25 + 0.3 * np.sin(0.53 * time_s + 2.0)
        turn = Rotation.from_euler("z", swing) * Rotation.from_euler("x", lift)
        return rigid(turn, (side * 0.42, 0.05, 0.75))

    def is_changing(self) -> bool:
        """Whether bodies move at all."""
        timeline = self.scenario.timeline
        return timeline.arm_moves or timeline.base_move is not None or self.scenario.board.knock is not None


@dataclass(frozen=True, slots=True)
class Session:
    """Everything that a recording is rendered from."""

    scenario: Scenario
    seed: int
    rig: RigPair
    cell: Cell
    motion: Motion
    stage: Stage
    still_view: View
    trajectory: Trajectory
    picks: dict[int, list[Click]]
    """Clicks by number of the stereo frame."""

    def view(self, time_s: float) -> View:
        """The scene at a time."""
        return self.stage.view(self.motion.poses(time_s)) if self.motion.is_changing() else self.still_view

    def camera_pose(self, name: str, time_s: float) -> Float:
        """True `w_T_camera` of `m_left`, `m_right`, `b_rgb` or `b_depth`."""
        if name == "m_left":
            return self.trajectory.pose(time_s)
        if name == "m_right":
            return self.trajectory.pose(time_s) @ self.rig.truth.left_T_right
        if name == "b_rgb":
            return self.motion.kinect(time_s) @ self.rig.truth.b_T_rgb
        return self.motion.kinect(time_s)

    def points_in_b(self, time_s: float) -> dict[str, Float]:
        """True points on the axis in {b}."""
        b_T_w = inverse(self.motion.kinect(time_s))
        return {point_id: transform(b_T_w, place) for point_id, (_, place) in self.cell.points.items()}


def prepare(scenario: Scenario, seed: int) -> Session:
    """Draw rig, cell and trajectory, bake the light, choose the images that the operator clicks in."""
    side = float(generator(seed, 0).choice([-1.0, 1.0]))
    rig = draw_rig(scenario, side, generator(seed, 1))
    cell = build_cell(scenario, rig.truth, side, generator(seed, 2))
    motion = Motion(scenario, cell, _stations(side, generator(seed, 3)))
    stage = build_stage(cell.bodies, cell.lamps, motion.poses(0.0), generator(seed, 4), scenario.detail)
    best: Session | None = None
    for attempt in range(_ATTEMPTS):
        trajectory = plan(scenario, cell, motion.chassis(0.0), generator(seed, 5, scenario.initialisation, attempt))
        session = Session(scenario, seed, rig, cell, motion, stage, stage.view(motion.poses(0.0)), trajectory, {})
        picks = _choose_picks(session)
        session = Session(scenario, seed, rig, cell, motion, stage, session.still_view, trajectory, picks)
        if best is None or len(picks) > len(best.picks):
            best = session
        if len(picks) == len(trajectory.dwells_s):
            break
    assert best is not None
    return best


def _stations(side: float, rng: np.random.Generator) -> tuple[Float, Float]:
    first = rigid((0, 0, rng.normal(0, 0.02)), (rng.normal(0, 0.03), rng.normal(0, 0.03), 0))
    step = rigid((0, 0, side * rng.uniform(0.12, 0.25)), (side * rng.uniform(-0.3, -0.2), rng.uniform(-0.35, -0.2), 0))
    return first, first @ step


def _choose_picks(session: Session) -> dict[int, list[Click]]:
    """For each dwell the frame nearest to its middle that shows both points; two points in one image each time."""
    rate = session.scenario.mobile.rate_hz
    last = session.scenario.duration_s - 1 / rate
    chosen: dict[int, list[Click]] = {}
    for number, (start, end) in enumerate(session.trajectory.dwells_s):
        middle = (start + end) / 2
        candidates = np.arange(max(0.0, start - 0.8), min(last, end + 0.8), 1 / rate)
        for time_s in sorted(candidates, key=lambda t: abs(t - middle)):
            frame = round(float(time_s) * rate)
            found = _clicks_at(session, "m_left", frame / rate, 10 + number)
            if len(found) == len(session.cell.points):
                if session.scenario.picks.in_kinect:
                    number_b = kinect_number(session.scenario, frame / rate)
                    seen_s = number_b / session.scenario.kinect.rate_hz + KINECT_PHASE_S
                    found = [*found, *_clicks_at(session, "b_rgb", seen_s, 20 + number)]
                chosen[frame] = found
                break
    return chosen


def kinect_number(scenario: Scenario, time_s: float) -> int:
    """Number of the Kinect's image nearest to a time."""
    rate = scenario.kinect.rate_hz
    last = int(np.floor(scenario.duration_s * rate + 1e-6)) - 1
    return min(max(round((time_s - KINECT_PHASE_S) * rate), 0), last)


KINECT_PHASE_S = 0.013
"""The Kinect's clock does not beat with the mobile camera's."""


def _clicks_at(session: Session, name: str, time_s: float, stream: int) -> list[Click]:
    covered = any(a - 0.2 <= time_s <= b + 0.2 for a, b in session.scenario.timeline.covered)
    if covered and name == "m_left":
        return []
    return clicks(
        session.view(time_s),
        session.rig.truth.cameras[name],
        session.camera_pose(name, time_s),
        session.cell.pipe,
        session.cell.points,
        session.scenario.picks.sigma_px,
        generator(session.seed, 6, stream),
    )
