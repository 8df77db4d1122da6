"""The cameras of a session: each job renders what one of them takes at one time, with noise, ready to be written."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from .depth import Surface, depth_directions, look, measure
from .picks import Click
from .render_board import exposure_gain, render_light
from .rigid import inverse
from .scenario import Scenario
from .sensor import RayGrid, expose, ray_grid
from .session import KINECT_PHASE_S, Session, generator, kinect_number

Float = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Job:
    """What to take: `stereo`, `depth` or `colour`, which one, and when."""

    time_s: float
    kind: str
    number: int


@dataclass(frozen=True, slots=True)
class Shot:
    """What one job gives."""

    time_s: float
    images: list[tuple[str, str, NDArray[Any]]]
    """Camera, encoding (`mono8`, `bgr8`, `depth` in metres), pixels."""
    clicks: list[Click]
    true_poses: dict[str, Float] = field(default_factory=dict)
    """`o_T_m`, `o_T_b`, `o_T_f` under `m`, `b`, `f`."""
    true_points: dict[str, Float] = field(default_factory=dict)
    """On the axis, in {b}."""


@dataclass(frozen=True, slots=True)
class Studio:
    """A session with its cameras set up."""

    session: Session
    grids: dict[str, RayGrid]
    depth_rays: NDArray[np.float32]
    gain: dict[str, float]
    kinect_at_rest: tuple[Surface, NDArray[np.float32]] | None
    """What the Kinect's depth and colour cameras see without noise, where nothing ever moves before them."""

    def take(self, job: Job) -> Shot:
        """Render one job."""
        if job.kind == "stereo":
            return self._stereo(job)
        return self._depth(job) if job.kind == "depth" else self._colour(job)

    def _stereo(self, job: Job) -> Shot:
        session, scenario, time_s = self.session, self.session.scenario, job.time_s
        view = session.view(time_s)
        images: list[tuple[str, str, NDArray[Any]]] = []
        for index, name in enumerate(("m_left", "m_right")):
            light = render_light(view, self.grids[name], _moving(session, name, time_s), scenario.light.exposure_s)
            light *= uncovered(scenario, time_s)
            rng = generator(session.seed, 7, index, job.number)
            images.append((name, "mono8", expose(light, scenario.light, self.gain[name], rng)))
        o_T_w = inverse(session.camera_pose("m_left", 0.0))
        w_poses = {
            "m": session.camera_pose("m_left", time_s),
            "b": session.motion.kinect(time_s),
            "f": session.motion.page(time_s),
        }
        every = max(1, round(scenario.mobile.rate_hz / 4))
        return Shot(
            time_s,
            images,
            [click for click in session.picks.get(job.number, []) if click.camera == "m_left"],
            {name: o_T_w @ w_pose for name, w_pose in w_poses.items()},
            session.points_in_b(time_s) if job.number % every == 0 else {},
        )

    def _colour(self, job: Job) -> Shot:
        session, scenario = self.session, self.session.scenario
        light = self.kinect_at_rest[1] if self.kinect_at_rest else _colour_light(self, job.time_s)
        pixels = expose(light, scenario.light, self.gain["b_rgb"], generator(session.seed, 8, job.number))
        found = [
            click
            for frame, clicks in session.picks.items()
            if kinect_number(scenario, frame / scenario.mobile.rate_hz) == job.number
            for click in clicks
            if click.camera == "b_rgb"
        ]
        return Shot(job.time_s, [("b_rgb", "bgr8", pixels)], found)

    def _depth(self, job: Job) -> Shot:
        session, truth = self.session, self.session.rig.truth
        surface = self.kinect_at_rest[0] if self.kinect_at_rest else _surface(self, job.time_s)
        correlation = session.scenario.kinect.noise_correlation_px
        rng = generator(session.seed, 9, job.number)
        depth = measure(surface, truth.cameras["b_depth"], truth, correlation, rng)
        return Shot(job.time_s, [("b_depth", "depth", depth)], [])


def jobs_of(scenario: Scenario) -> list[Job]:
    """All jobs of a recording in order of time."""
    return sorted(_jobs(scenario), key=lambda job: (job.time_s, job.kind))


def _jobs(scenario: Scenario) -> Iterator[Job]:
    for number in range(int(np.floor(scenario.duration_s * scenario.mobile.rate_hz + 1e-6))):
        yield Job(number / scenario.mobile.rate_hz, "stereo", number)
    kinect = scenario.kinect
    for number in range(int(np.floor(scenario.duration_s * kinect.rate_hz + 1e-6))):
        time_s = number / kinect.rate_hz + KINECT_PHASE_S
        yield Job(time_s, "depth", number)
        if kinect.rgb:
            yield Job(time_s, "colour", number)


def set_up(session: Session) -> Studio:
    """Cameras, exposures, and the Kinect's view where it never changes."""
    # Parallel work is done by processes; threads inside of OpenCV only get in each other's way.
    cv2.setNumThreads(1)
    cameras = session.rig.truth.cameras
    grids = {name: ray_grid(cameras[name]) for name in ("m_left", "m_right", "b_rgb")}
    studio = Studio(session, grids, depth_directions(cameras["b_depth"]), _gains(session, grids), None)
    if session.motion.is_changing():
        return studio
    return replace(studio, kinect_at_rest=(_surface(studio, 0.0), _colour_light(studio, 0.0)))


def _surface(studio: Studio, time_s: float) -> Surface:
    session = studio.session
    camera = session.rig.truth.cameras["b_depth"]
    return look(session.view(time_s), camera, studio.depth_rays, session.camera_pose("b_depth", time_s))


def _colour_light(studio: Studio, time_s: float) -> NDArray[np.float32]:
    session = studio.session
    moving = _moving(session, "b_rgb", time_s)
    return render_light(session.view(time_s), studio.grids["b_rgb"], moving, session.scenario.light.exposure_s, True)


def _gains(session: Session, grids: dict[str, RayGrid]) -> dict[str, float]:
    """Fixed exposures, set on views along the way for lamps of level 1."""
    duration, level = session.scenario.duration_s, session.scenario.light.level
    gains = {}
    for name in ("m_left", "b_rgb"):
        sparse = grids[name].directions[0][::31]
        thin = RayGrid(len(sparse), 1, (sparse,), grids[name].spread)
        parts = []
        for time_s in np.linspace(0, duration - 0.05, 9):
            pose = session.camera_pose(name, float(time_s))
            parts.append(render_light(session.still_view, thin, lambda _, pose=pose: pose))
        gains[name] = exposure_gain(np.concatenate(parts)) * level
    return {**gains, "m_right": gains["m_left"]}


def _moving(session: Session, name: str, time_s: float) -> Callable[[float], Float]:
    return lambda offset: session.camera_pose(name, time_s + offset)


def uncovered(scenario: Scenario, time_s: float) -> np.float32:
    """Share of the light that a hand on the lens lets through; it comes and goes within 0.15 s."""
    share = 1.0
    for start, end in scenario.timeline.covered:
        outside = max(start - time_s, time_s - end, 0.0) / 0.15
        share = min(share, max(0.004, min(outside, 1.0)))
    return np.float32(share)
