"""Render a recording and write it: images, depth, calibration, clicks, and beside them the truth."""

import multiprocessing
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import cv2
import yaml

from ..factors.rig import dump_rig
from ..io import build
from ..io.schemas import PIXEL_PICK, POINT_ARRAY
from ..io.writer import McapSink
from .faults import RigPair
from .rigid import inverse, transform
from .scenario import Scenario
from .session import Session, prepare, stamp_ns
from .studio import Shot, jobs_of, set_up

Progress = Callable[[float], None]
IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
INFO, POSE = "sensor_msgs/msg/CameraInfo", "geometry_msgs/msg/PoseStamped"
_TOPICS = {"m_left": "/m/left", "m_right": "/m/right", "b_rgb": "/b/rgb", "b_depth": "/b/depth"}


@dataclass(frozen=True, slots=True)
class _Start:
    """What a renderer tells before its first image."""

    rig: RigPair
    truth: str


def simulate(out: Path, scenario: Scenario, seed: int, progress: Progress | None = None, workers: int = 1) -> None:
    """Render one recording into an MCAP log. The same scenario and seed give the same bytes.

    Args:
        out: the log; it appears when it is whole.
        scenario: what to simulate.
        seed: draws the rig's faults, the cell, the motion and the noise.
        progress: called with the share done, 0..1, in order.
        workers: processes that render; with more than one the caller's main module must be importable
            (`if __name__ == "__main__":`).

    Raises:
        LogError: the log cannot be written.
    """
    shots = _alone(scenario, seed) if workers == 1 else _shared(scenario, seed, workers)
    total = len(jobs_of(scenario))
    with McapSink(out) as sink:
        start = next(shots)
        assert isinstance(start, _Start)
        sink.attach("rig.yaml", "application/yaml", dump_rig(start.rig.rig), stamp_ns(0))
        sink.attach("truth.yaml", "application/yaml", start.truth, stamp_ns(0))
        sink.metadata("simulation", {"scenario": scenario.name, "seed": str(seed)})
        for number, shot in enumerate(shots):
            assert isinstance(shot, Shot)
            _write(sink, shot, start.rig, scenario)
            if progress is not None:
                progress((number + 1) / total)


def _alone(scenario: Scenario, seed: int, first: int = 0, step: int = 1) -> Iterator[_Start | Shot]:
    session = prepare(scenario, seed)
    studio = set_up(session)
    yield _Start(session.rig, truth_yaml(session))
    for job in jobs_of(scenario)[first::step]:
        yield studio.take(job)


def _shared(scenario: Scenario, seed: int, workers: int) -> Iterator[_Start | Shot]:
    """The jobs dealt out to processes and collected in turn; a full pipe keeps a fast one from running ahead."""
    context = multiprocessing.get_context("spawn")
    pairs = [context.Pipe(duplex=False) for _ in range(workers)]
    processes = [
        context.Process(target=_serve, args=(sender, scenario, seed, index, workers), daemon=True)
        for index, (_, sender) in enumerate(pairs)
    ]
    receivers = [receiver for receiver, _ in pairs]
    try:
        for process, (_, sender) in zip(processes, pairs, strict=True):
            process.start()
            sender.close()
        starts = [receiver.recv() for receiver in receivers]
        yield starts[0]
        for number in range(len(jobs_of(scenario))):
            yield receivers[number % workers].recv()
    except EOFError:
        raise RuntimeError("a rendering process ended early; its own message stands above") from None
    finally:
        for process in processes:
            if process.pid is not None:
                process.terminate()
                process.join()


def _serve(sender: Connection, scenario: Scenario, seed: int, first: int, step: int) -> None:
    for item in _alone(scenario, seed, first, step):
        sender.send(item)
    sender.close()


def _write(sink: McapSink, shot: Shot, rig: RigPair, scenario: Scenario) -> None:
    stamp = stamp_ns(shot.time_s)
    for name, encoding, pixels in shot.images:
        info = build.camera_info(stamp, name, rig.cameras[name])
        sink.write(f"{_TOPICS[name]}/camera_info", INFO, info, stamp)
        if scenario.jpeg_quality is not None and encoding != "depth":
            data = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, scenario.jpeg_quality])[1].tobytes()
            image = build.compressed_image(stamp, name, data, "jpeg")
            sink.write(f"{_TOPICS[name]}/image_raw", COMPRESSED, image, stamp)
        else:
            sink.write(f"{_TOPICS[name]}/image_raw", IMAGE, _image(stamp, name, encoding, pixels), stamp)
    for click in shot.clicks:
        sigma = scenario.picks.sigma_px
        pick = build.pixel_pick(stamp, click.camera, click.point_id, click.role, click.uv_px, sigma)
        sink.write("/picks", PIXEL_PICK, pick, stamp)
    for name, pose in shot.true_poses.items():
        sink.write(f"/truth/pose/{name}", POSE, build.pose_stamped(stamp, "o", pose), stamp)
    if shot.true_points:
        sink.write("/truth/points", POINT_ARRAY, build.point_array(stamp, "b", dict(shot.true_points)), stamp)


def _image(stamp: int, name: str, encoding: str, pixels: Any) -> Any:
    if encoding == "depth":
        return build.depth_image(stamp, name, pixels)
    return build.image(stamp, name, pixels, encoding)


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
