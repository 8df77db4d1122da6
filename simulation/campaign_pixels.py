"""One run at pixel level: render a recording, estimate from it as from any other, and read its truth afterwards."""

from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import yaml

from ..estimator.compare import chain_of_messages
from ..estimator.items import wanted_topics
from ..estimator.optimise import optimise, rig_of
from ..estimator.stopwatch import Stopwatch
from ..factors.errors import LogError, SurecutError
from ..factors.rig import dump_rig
from ..io.messages import PointsBody, PoseBody
from ..io.reader import LogReader
from .campaign_row import Row, failed_row, row_of
from .evaluate import evaluate
from .measurement_level_truth import TrueCamera, TruePipe, TrueRig, Truth
from .recording import simulate
from .scenario import Scenario
from .stated_mount import with_mount_anew

POSES = {name: f"/truth/pose/{name}" for name in ("m", "b", "f")}
POINTS = "/truth/points"
LOG = "log"
"""Key of a scenario that is a recording already: its path."""


def run_pixels(
    number: int, scenario: Mapping[str, Any], recordings: Path | None = None, mounts_anew: bool = False
) -> Row:
    """Renders with the run's number as seed, or takes a recording that is there.

    Args:
        recordings: folder that keeps the recordings; one that is there already is not rendered again.
            Without it they are gone afterwards.
        mounts_anew: the rig states another mount than when it was rendered, drawn with the run's number as seed.
    """
    if LOG in scenario:
        return row_of_log(number, str(scenario["name"]), Path(scenario[LOG]), mounts_anew)
    wanted = Scenario.model_validate(dict(scenario))
    if recordings is None:
        with TemporaryDirectory(prefix="surecut-campaign-") as folder:
            return row_of_log(number, wanted.name, rendered(Path(folder), number, wanted), mounts_anew)
    return row_of_log(number, wanted.name, rendered(recordings, number, wanted), mounts_anew)


def rendered(folder: Path, number: int, scenario: Scenario) -> Path:
    """The recording of a run, rendered where it is not there yet."""
    log = folder / f"{number:05d}-{scenario.name}.mcap"
    if not log.exists():
        simulate(log, scenario, number, workers=1)
    return log


def row_of_log(number: int, name: str, log: Path, mount_anew: bool = False) -> Row:
    """Estimate of a simulated log and its errors.

    Args:
        number: seed of what is drawn.
        name: of the scenario.
        log: carries its rig and its truth.
        mount_anew: the rig gets another mount.
    """
    watch, truth = Stopwatch(), truth_of_log(log)
    try:
        with watch("estimate"), TemporaryDirectory(prefix="surecut-rig-") as folder:
            result = optimise(log, _rig_file(Path(folder), log, truth, number) if mount_anew else None)
    except SurecutError as error:
        return failed_row(number, name, str(error))
    row = row_of(number, name, result, evaluate(result, truth))
    row["seconds"] = watch.seconds["estimate"]
    row["chain"] = chain_errors_of_log(log, truth)
    return row


def _rig_file(folder: Path, log: Path, truth: Truth, seed: int) -> Path:
    """The log's rig with its mount drawn anew."""
    with LogReader(log, ()) as reader:
        rig = with_mount_anew(rig_of(reader, None), truth.rig.f_T_b, seed)
    path = folder / "rig.yaml"
    path.write_text(dump_rig(rig))
    return path


def chain_errors_of_log(log: Path, truth: Truth) -> list[float]:
    """Error of the paper's chain at every click that it answers, m."""
    try:
        with LogReader(log, ()) as reader:
            rig = rig_of(reader, None)
        with LogReader(log, wanted_topics(rig)) as reader:
            points = chain_of_messages(reader, rig)
    except SurecutError:
        return []
    return [
        float(np.linalg.norm(point.position_b_m - truth.points_b_m[point.point_id]))
        for point in points
        if point.position_b_m is not None and point.point_id in truth.points_b_m
    ]


def truth_of_log(log: Path) -> Truth:
    """The truth that a simulated log carries. Where the machine was moved: its last station.

    Raises:
        LogError: the log carries none.
    """
    poses: dict[str, dict[int, np.ndarray]] = {name: {} for name in POSES}
    names = {topic: name for name, topic in POSES.items()}
    points: dict[str, np.ndarray] = {}
    with LogReader(log, (*POSES.values(), POINTS)) as reader:
        for message in reader:
            if isinstance(message.body, PoseBody):
                poses[names[message.topic]][message.stamp_ns] = message.body.matrix
            elif isinstance(message.body, PointsBody):
                points |= dict(zip(message.body.ids, message.body.points_m, strict=True))
        text = reader.attachment("truth.yaml")
    if text is None or not all(poses.values()):
        raise LogError(f"{log}: carries no truth; only simulated logs do")
    stamps = sorted(poses["m"])
    last_b, last_f = (poses[name][max(poses[name])] for name in ("b", "f"))
    known = yaml.safe_load(text)
    return Truth(
        stamps_ns=tuple(stamps),
        o_T_m=np.array([poses["m"][stamp] for stamp in stamps]),
        o_T_b=last_b,
        o_T_f={"f0": last_f},
        points_b_m=points,
        pipe=TruePipe(
            np.array(known["pipe"]["point_m"]), np.array(known["pipe"]["axis"]), float(known["pipe"]["radius_m"])
        ),
        rig=_true_rig(known),
    )


def _true_rig(known: Mapping[str, Any]) -> TrueRig:
    """Boards are left out: the side as it appears to a detector is no property of the page."""
    scale = float(known["depth_scale"])
    return TrueRig(
        cameras={name: TrueCamera(name, 0, 0, np.array(camera["K"])) for name, camera in known["cameras"].items()},
        m_left_T_m_right=np.array(known["left_T_right"]),
        b_T_rgb=np.array(known["b_T_rgb"]),
        f_T_b=np.array(known["f_T_b"]),
        # The sensor reads z (1 + scale) + offset; the state is what turns a reading into the true depth.
        depth_offset_m=-float(known["depth_offset_m"]) / (1.0 + scale),
        depth_scale=1.0 / (1.0 + scale) - 1.0,
        depth_rays=np.zeros(3),
        boards={},
    )
