"""Render a recording and write it: images, depth, calibration, clicks, and beside them the truth."""

from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray

from ..factors.rig import dump_rig
from ..io import build
from ..io.schemas import PIXEL_PICK, POINT_ARRAY
from ..io.writer import McapSink
from .depth import Surface, depth_directions, look, measure
from .render_board import exposure_gain, render_light
from .rigid import inverse, transform
from .scenario import Scenario
from .sensor import RayGrid, expose, ray_grid
from .session import KINECT_PHASE_S, Session, generator, prepare, stamp_ns

Float = NDArray[np.float64]
Progress = Callable[[float], None]
IMAGE, INFO, POSE = "sensor_msgs/msg/Image", "sensor_msgs/msg/CameraInfo", "geometry_msgs/msg/PoseStamped"
_NAMES = {"m_left": "/m/left", "m_right": "/m/right", "b_rgb": "/b/rgb", "b_depth": "/b/depth"}


@dataclass(frozen=True, slots=True)
class Entry:
    """One message of the log."""

    topic: str
    type_name: str
    message: Any
    stamp_ns: int


@dataclass(frozen=True, slots=True)
class _Studio:
    """A session with its cameras set up."""

    session: Session
    grids: dict[str, RayGrid]
    depth_rays: NDArray[np.float32]
    gain: dict[str, float]
    kinect_at_rest: tuple[Surface, NDArray[np.float32]] | None
    """What the Kinect's depth and colour cameras see without noise, where nothing ever moves before them."""


def simulate(out: Path, scenario: Scenario, seed: int, progress: Progress | None = None, workers: int = 2) -> None:
    """Render one recording into an MCAP log. The same scenario and seed give the same bytes.

    Args:
        out: the log; it appears when it is whole.
        scenario: what to simulate.
        seed: draws the rig's faults, the cell, the motion and the noise.
        progress: called with the share done, 0..1, in order.
        workers: images rendered at the same time.

    Raises:
        LogError: the log cannot be written.
    """
    session = prepare(scenario, seed)
    studio = _set_up(session)
    cv2.setNumThreads(1)
    with McapSink(out) as sink:
        sink.attach("rig.yaml", "application/yaml", dump_rig(session.rig.rig), stamp_ns(0))
        sink.attach("truth.yaml", "application/yaml", truth_yaml(session), stamp_ns(0))
        sink.metadata("simulation", {"scenario": scenario.name, "seed": str(seed)})
        for share, entries in _rendered(studio, workers):
            for entry in entries:
                sink.write(entry.topic, entry.type_name, entry.message, entry.stamp_ns)
            if progress is not None:
                progress(share)


def _set_up(session: Session) -> _Studio:
    cameras = session.rig.truth.cameras
    grids = {name: ray_grid(cameras[name]) for name in ("m_left", "m_right", "b_rgb")}
    studio = _Studio(session, grids, depth_directions(cameras["b_depth"]), _gains(session, grids), None)
    if session.motion.is_changing():
        return studio
    return replace(studio, kinect_at_rest=(_surface(studio, 0.0), _colour_light(studio, 0.0)))


def _surface(studio: _Studio, time_s: float) -> Surface:
    session = studio.session
    camera = session.rig.truth.cameras["b_depth"]
    return look(session.view(time_s), camera, studio.depth_rays, session.camera_pose("b_depth", time_s))


def _colour_light(studio: _Studio, time_s: float) -> NDArray[np.float32]:
    session = studio.session
    moving = _moving(session, "b_rgb", time_s)
    return render_light(session.view(time_s), studio.grids["b_rgb"], moving, session.scenario.light.exposure_s, True)


def _gains(session: Session, grids: dict[str, RayGrid]) -> dict[str, float]:
    """Fixed exposures, set on views along the way for lamps of level 1."""
    duration, level = session.scenario.duration_s, session.scenario.light.level
    gains = {}
    for name in ("m_left", "b_rgb"):
        thin = RayGrid(len(grids[name].directions[0][::31]), 1, (grids[name].directions[0][::31],), grids[name].spread)
        times = np.linspace(0, duration - 0.05, 9)
        parts = []
        for time_s in times:
            pose = session.camera_pose(name, float(time_s))
            parts.append(render_light(session.still_view, thin, lambda _, pose=pose: pose))
        gains[name] = exposure_gain(np.concatenate(parts) / np.float32(level))
    return {**gains, "m_right": gains["m_left"]}


def _rendered(studio: _Studio, workers: int) -> Iterator[tuple[float, list[Entry]]]:
    """Messages in order of time, a few images rendered ahead so that memory stays flat."""
    jobs = sorted(_jobs(studio), key=lambda job: job[0])
    waiting: deque[tuple[float, Future[list[Entry]]]] = deque()
    with ThreadPoolExecutor(max_workers=workers) as pool:
        for index, (_, work, arguments) in enumerate(jobs):
            waiting.append(((index + 1) / len(jobs), pool.submit(work, *arguments)))
            if len(waiting) > 2 * workers:
                share, future = waiting.popleft()
                yield share, future.result()
        while waiting:
            share, future = waiting.popleft()
            yield share, future.result()


def _jobs(studio: _Studio) -> Iterator[tuple[float, Callable[..., list[Entry]], tuple]]:
    session = studio.session
    for number, time_s in session.stereo_times():
        yield time_s, _stereo_entries, (studio, number, time_s)
    kinect = session.scenario.kinect
    for number in range(int(np.floor(session.scenario.duration_s * kinect.rate_hz + 1e-6))):
        time_s = number / kinect.rate_hz + KINECT_PHASE_S
        yield time_s, _depth_entries, (studio, number, time_s)
        if kinect.rgb:
            yield time_s, _colour_entries, (studio, number, time_s)


def _stereo_entries(studio: _Studio, number: int, time_s: float) -> list[Entry]:
    session = studio.session
    stamp = stamp_ns(time_s)
    view = session.view(time_s)
    entries = []
    for index, name in enumerate(("m_left", "m_right")):
        light = render_light(
            view, studio.grids[name], _moving(session, name, time_s), session.scenario.light.exposure_s
        )
        light *= _uncovered(session.scenario, time_s)
        rng = generator(session.seed, 7, index, number)
        pixels = expose(light, session.scenario.light, studio.gain[name], rng)
        entries += _with_info(session, name, stamp, build.image(stamp, name, pixels, "mono8"))
    entries += _truth_entries(session, number, time_s)
    for click in session.picks.get(number, []):
        if click.camera == "m_left":
            entries.append(_pick_entry(session, stamp, click))
    return entries


def _colour_entries(studio: _Studio, number: int, time_s: float) -> list[Entry]:
    session = studio.session
    stamp = stamp_ns(time_s)
    light = studio.kinect_at_rest[1] if studio.kinect_at_rest else _colour_light(studio, time_s)
    pixels = expose(light, session.scenario.light, studio.gain["b_rgb"], generator(session.seed, 8, number))
    entries = _with_info(session, "b_rgb", stamp, build.image(stamp, "b_rgb", pixels, "bgr8"))
    for frame, found in session.picks.items():
        own = kinect_number(session.scenario, frame / session.scenario.mobile.rate_hz) == number
        entries += [_pick_entry(session, stamp, click) for click in found if own and click.camera == "b_rgb"]
    return entries


def kinect_number(scenario: Scenario, time_s: float) -> int:
    """Number of the Kinect's image nearest to a time."""
    rate = scenario.kinect.rate_hz
    last = int(np.floor(scenario.duration_s * rate + 1e-6)) - 1
    return min(max(round((time_s - KINECT_PHASE_S) * rate), 0), last)


def _depth_entries(studio: _Studio, number: int, time_s: float) -> list[Entry]:
    session = studio.session
    stamp = stamp_ns(time_s)
    truth = session.rig.truth
    surface = studio.kinect_at_rest[0] if studio.kinect_at_rest else _surface(studio, time_s)
    correlation, rng = session.scenario.kinect.noise_correlation_px, generator(session.seed, 9, number)
    depth = measure(surface, truth.cameras["b_depth"], truth, correlation, rng)
    return _with_info(session, "b_depth", stamp, build.depth_image(stamp, "b_depth", depth))


def _with_info(session: Session, name: str, stamp: int, image: Any) -> list[Entry]:
    info = build.camera_info(stamp, name, session.rig.cameras[name])
    topic = _NAMES[name]
    return [Entry(f"{topic}/camera_info", INFO, info, stamp), Entry(f"{topic}/image_raw", IMAGE, image, stamp)]


def _pick_entry(session: Session, stamp: int, click: Any) -> Entry:
    sigma = session.scenario.picks.sigma_px
    pick = build.pixel_pick(stamp, click.camera, click.point_id, click.role, click.uv_px, sigma)
    return Entry("/picks", PIXEL_PICK, pick, stamp)


def _truth_entries(session: Session, number: int, time_s: float) -> list[Entry]:
    """True poses in {o}, the first left optical frame, and four times a second the points in {b}."""
    stamp = stamp_ns(time_s)
    o_T_w = inverse(session.camera_pose("m_left", 0.0))
    poses = {
        "m": session.camera_pose("m_left", time_s),
        "b": session.motion.kinect(time_s),
        "f": session.motion.page(time_s),
    }
    entries = [
        Entry(f"/truth/pose/{name}", POSE, build.pose_stamped(stamp, "o", o_T_w @ pose), stamp)
        for name, pose in poses.items()
    ]
    if number % max(1, round(session.scenario.mobile.rate_hz / 4)) == 0:
        points = build.point_array(stamp, "b", dict(session.points_in_b(time_s)))
        entries.append(Entry("/truth/points", POINT_ARRAY, points, stamp))
    return entries


def _moving(session: Session, name: str, time_s: float) -> Callable[[float], Float]:
    return lambda offset: session.camera_pose(name, time_s + offset)


def _uncovered(scenario: Scenario, time_s: float) -> np.float32:
    """Share of the light that a hand on the lens lets through; it comes and goes within 0.15 s."""
    share = 1.0
    for start, end in scenario.timeline.covered:
        outside = max(start - time_s, time_s - end, 0.0) / 0.15
        share = min(share, max(0.004, min(outside, 1.0)))
    return np.float32(share)


def truth_yaml(session: Session) -> str:
    """What only the truth knows, for the evaluation: the attachment `truth.yaml`."""
    truth, cell = session.rig.truth, session.cell
    b_T_w = inverse(session.motion.kinect(0.0))
    data = {
        "seed": session.seed,
        "scenario": session.scenario.model_dump(mode="json"),
        "errors": truth.errors,
        "cameras": {name: {"K": camera.K.tolist(), "D": camera.D.tolist()} for name, camera in truth.cameras.items()},
        "left_T_right": truth.left_T_right.tolist(),
        "b_T_rgb": truth.b_T_rgb.tolist(),
        "f_T_b": truth.f_T_b.tolist(),
        "depth_offset_m": truth.depth_offset_m,
        "depth_scale": truth.depth_scale,
        "markers": [
            {
                "id": marker.id,
                "printed_id": marker.pattern_id,
                "centre_m": list(marker.centre_m),
                "side_m": float(marker.side_m),
                "rotation_rad": float(marker.rotation_rad),
            }
            for marker in truth.markers
        ],
        "pipe": {
            "frame": "b",
            "point_m": transform(b_T_w, cell.pipe.at_height(1.1)).tolist(),
            "axis": (b_T_w[:3, :3] @ cell.pipe.axis).tolist(),
            "radius_m": float(cell.pipe.radius_m),
        },
        "points": {
            point_id: {"role": role, "frame": "b", "position_m": transform(b_T_w, place).tolist()}
            for point_id, (role, place) in cell.points.items()
        },
        "path_m": session.trajectory.length_m(session.scenario.duration_s),
    }
    return yaml.safe_dump(data, sort_keys=False)
