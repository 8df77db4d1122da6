"""Real recordings that have a reference, in one table: distances by laser, trajectories, corners and angles."""

import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

import numpy as np
import yaml
from scipy.stats import norm

from ..estimator.executor import Executor
from ..estimator.optimise import optimise
from ..estimator.result import Result
from ..factors.errors import SurecutError
from ..factors.rig import Board, Distance, Marker, Noise, Pose, Rig, Stereo, dump_rig
from ..io.messages import PoseBody
from ..io.reader import LogReader
from .campaign import write_whole
from .campaign_real_photos import photo_rows, turntable_rows
from .campaign_real_row import RealRow
from .evaluate_trajectory import Trajectory, compare_trajectories, read_tum

HELD_OUT_SIGMA = float(norm.ppf(0.975))


@dataclass(frozen=True, slots=True)
class RealTask:
    """One estimate, or one set of photographs."""

    folder: str
    """Of all recordings."""
    recording: str
    kind: Literal["aviary", "held_out", "tags", "kitti", "photos", "turntable"]
    key: str = ""
    """Of a held-out distance: its id."""

    @property
    def name(self) -> str:
        """For files and progress."""
        return "-".join(part.replace("/", "_") for part in (self.recording, self.kind, self.key) if part)


def real_tasks(folder: Path) -> list[RealTask]:
    """What there is to do in a folder of real recordings, the quick ones first."""
    tasks: list[RealTask] = []
    if (folder / "photos" / "golden.json").is_file():
        tasks += [RealTask(str(folder), "photos", kind) for kind in ("photos", "turntable")]
    tasks += [
        RealTask(str(folder), name, "tags")
        for name in ("stereo_tags/collinear", "stereo_tags/perch")
        if (folder / name / "boards.yaml").is_file()
    ]
    if (folder / "kitti" / "kitti1.mcap").is_file():
        tasks.append(RealTask(str(folder), "kitti", "kitti"))
    if (folder / "aviary" / "boards.yaml").is_file():
        boards = yaml.safe_load((folder / "aviary" / "boards.yaml").read_text())
        tasks.append(RealTask(str(folder), "aviary", "aviary"))
        tasks += [RealTask(str(folder), "aviary", "held_out", str(one["id"])) for one in boards["distances"]]
    return tasks


def run_real(task: RealTask) -> dict[str, Any]:
    """Rows of one task as data, or the reason why there are none."""
    folder = Path(task.folder) / task.recording
    cases: dict[str, Callable[[], Iterator[RealRow]]] = {
        "aviary": lambda: _aviary(folder),
        "tags": lambda: _tags(folder),
        "kitti": lambda: _kitti(folder),
        "photos": lambda: photo_rows(folder),
        "turntable": lambda: turntable_rows(folder),
    }
    try:
        if task.kind == "held_out":
            return {"rows": [], "held_out": _held_out(folder, task.key)}
        return {"rows": [asdict(row) for row in cases[task.kind]()]}
    except SurecutError as error:
        return {"rows": [asdict(RealRow("", f"no result ({task.kind} {task.key})", str(error), ""))]}


def real_table(
    folder: Path, output: Path, executor: Executor, done: Callable[[str], None] = lambda name: None
) -> list[RealRow]:
    """Everything under a folder of real recordings that has a reference; what cannot be run says why.

    Args:
        folder: of the recordings.
        output: each task leaves a file here, and is not done again where it is there already.
        executor: where the tasks run.
        done: called with the name of each task that is done.
    """
    tasks = real_tasks(folder)
    files = {task: output / "real" / f"{task.name}.json" for task in tasks}
    (output / "real").mkdir(parents=True, exist_ok=True)
    for task in tasks:
        if files[task].exists():
            done(task.name)
    for outcome in executor.run(run_real, [task for task in tasks if not files[task].exists()]):
        found = outcome.value
        if found is None:
            found = {"rows": [asdict(RealRow("", "no result", outcome.error or "no reason", ""))]}
        write_whole(files[outcome.item], json.dumps(found))
        done(outcome.item.name)
    return _rows({task: json.loads(files[task].read_text()) for task in tasks})


def _rows(found: Mapping[RealTask, Mapping[str, Any]]) -> list[RealRow]:
    """One table; held-out distances become two lines."""
    rows = [
        RealRow(task.recording, row["quantity"], row["value"], row["reference"])
        for task, one in found.items()
        for row in one["rows"]
    ]
    held = [one["held_out"] for one in found.values() if "held_out" in one]
    if held:
        rms_mm = 1e3 * float(np.sqrt(np.mean([one["error_m"] ** 2 for one in held])))
        inside = sum(one["inside"] for one in held)
        rows.append(RealRow("aviary", f"{len(held)} distances, each held out, rms", f"{rms_mm:.1f} mm", "truth"))
        text = f"{inside} of {len(held)}"
        rows.append(RealRow("aviary", "of these inside the stated 95 % interval", text, "truth"))
    return rows


def real_text(rows: list[RealRow]) -> str:
    """The table in Markdown."""
    lines = ["| recording | quantity | value | against |", "|---|---|---|---|"]
    lines += [f"| {row.recording} | {row.quantity} | {row.value} | {row.reference} |" for row in rows]
    return "\n".join(lines) + "\n"


def rig_of_tags(boards: dict[str, Any], held_out: str | None = None) -> Rig:
    """The rig of a `boards.yaml`: AprilTag boards on the walls and distances between their corners.

    Args:
        boards: the file's content.
        held_out: id of a distance that is left out.
    """
    distances = [
        Distance.model_validate(
            {
                "from": f"{one['from']['tag']}/{one['from']['corner']}",
                "to": f"{one['to']['tag']}/{one['to']['corner']}",
                "distance_m": one["distance_m"],
                "sigma_m": one["sigma_m"],
            }
        )
        for one in boards.get("distances", ())
        if one["id"] != held_out
    ]
    rig = Rig(boards=tuple(_board(board) for board in boards["boards"]), distances=tuple(distances))
    pair = boards.get("left_T_right")
    if pair is None:
        return rig
    # The calibration of such a pair comes with the recording and was estimated with it; the source states 1 px.
    cameras = {
        name: getattr(rig.cameras, name).model_copy(update={"freeze": ("focal", "centre", "distortion")})
        for name in ("m_left", "m_right")
    }
    pose = Pose(translation_m=pair["translation_m"], rotation_vector_rad=pair["rotation_vector_rad"])
    return rig.model_copy(
        update={
            "cameras": rig.cameras.model_copy(update=cameras),
            "stereo": Stereo(m_left_T_m_right=pose, rotation_sigma_rad=0.002),
            "noise": Noise(marker_message_sigma_px=1.0, marker_common_px=0.3),
        }
    )


def _board(board: dict[str, Any]) -> Board:
    pitch_m = board["tag_size_m"] * (1.0 + board.get("tag_spacing", 0.0))
    markers = tuple(
        Marker(id=number, centre_m=(column * pitch_m, row * pitch_m))
        for row, numbers in enumerate(board["tag_ids"])
        for column, number in enumerate(numbers)
    )
    return Board(
        id=str(board["id"]),
        dictionary="DICT_APRILTAG_36h11",
        side_m=board["tag_size_m"],
        centre_sigma_m=board.get("tag_position_sigma_m", 2e-4),
        attached_to="world",
        markers=markers,
    )


def _aviary(folder: Path) -> Iterator[RealRow]:
    boards = yaml.safe_load((folder / "boards.yaml").read_text())
    result = _optimise(folder / "aviary.mcap", rig_of_tags(boards))
    errors = np.array([d.distance_m - d.given_m for d in result.distances if d.given_m is not None])
    if len(errors):
        yield RealRow("", f"{len(errors)} given distances, rms", f"{1e3 * np.sqrt((errors**2).mean()):.1f} mm", "truth")
    yield from _against_tum(result, folder / "reference_tum.txt")


def _held_out(folder: Path, key: str) -> dict[str, Any]:
    """A distance predicted from the other ones: nothing in the estimate has seen it."""
    boards = yaml.safe_load((folder / "boards.yaml").read_text())
    one = next(one for one in boards["distances"] if str(one["id"]) == key)
    pair = (f"{one['from']['tag']}/{one['from']['corner']}", f"{one['to']['tag']}/{one['to']['corner']}")
    result = _optimise(folder / "aviary.mcap", rig_of_tags(boards, one["id"]), (pair,))
    found = next(d for d in result.distances if d.given_m is None)
    error = found.distance_m - one["distance_m"]
    inside = abs(error) <= HELD_OUT_SIGMA * np.hypot(found.sigma_m, one["sigma_m"])
    return {"error_m": float(error), "inside": bool(inside)}


def _tags(folder: Path) -> Iterator[RealRow]:
    boards = yaml.safe_load((folder / "boards.yaml").read_text())
    result = _optimise(folder / f"{folder.name}.mcap", rig_of_tags(boards))
    yield from _against_tum(result, folder / "reference_tum.txt")


def _kitti(folder: Path) -> Iterator[RealRow]:
    # A rig needs a board; this one is in no image.
    log = folder / "kitti1.mcap"
    result = _optimise(log, Rig(boards=(Board(id="none", markers=(Marker(id=0, centre_m=(0.0, 0.0)),)),)))
    stamps, poses = [], []
    with LogReader(log, ("/truth/pose/m",)) as reader:
        for message in reader:
            if isinstance(message.body, PoseBody):
                stamps.append(message.stamp_ns)
                poses.append(message.body.matrix)
    error = compare_trajectories(_trajectory(result), Trajectory(np.array(stamps), np.array(poses)))
    share = 100 * error.end_m / error.path_m
    yield RealRow("", f"end error after {error.path_m:.1f} m", f"{error.end_m:.2f} m ({share:.2f} %)", "truth")


def _against_tum(result: Result, path: Path) -> Iterator[RealRow]:
    error = compare_trajectories(_trajectory(result), read_tum(path))
    value = f"{1e3 * error.ate_aligned_rms_m:.1f} mm, {np.rad2deg(error.rotation_median_rad):.3f} deg"
    yield RealRow("", f"trajectory, aligned, rms of {error.pairs} poses", value, "reference")


def _trajectory(result: Result) -> Trajectory:
    poses = sorted(result.trajectory, key=lambda pose: pose.stamp_ns)
    return Trajectory(np.array([p.stamp_ns for p in poses], dtype=np.int64), np.array([p.matrix for p in poses]))


def _optimise(log: Path, rig: Rig, between: tuple[tuple[str, str], ...] = ()) -> Result:
    with TemporaryDirectory(prefix="surecut-rig-") as folder:
        path = Path(folder) / "rig.yaml"
        path.write_text(dump_rig(rig), encoding="utf-8")
        return optimise(log, path, between)
