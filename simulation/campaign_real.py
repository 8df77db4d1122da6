"""Real recordings that have a reference, in one table: marker distances by laser, and trajectories."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import yaml
from scipy.stats import norm

from ..estimator.optimise import optimise
from ..estimator.result import Result
from ..factors.errors import SurecutError
from ..factors.rig import Board, Distance, Marker, Rig, dump_rig
from ..io.messages import PoseBody
from ..io.reader import LogReader
from .evaluate_trajectory import Trajectory, compare_trajectories, read_tum

HELD_OUT_SIGMA = float(norm.ppf(0.975))


@dataclass(frozen=True, slots=True)
class RealRow:
    """One comparison."""

    recording: str
    quantity: str
    value: str
    reference: str
    """`truth` (an instrument) or `reference` (another estimator)."""


def real_table(folder: Path) -> list[RealRow]:
    """Everything under a folder of real recordings that has a reference; what cannot be run says why."""
    cases: tuple[tuple[str, Callable[[Path], Iterator[RealRow]]], ...] = (
        ("aviary", _aviary),
        ("stereo_tags/collinear", _tags),
        ("stereo_tags/perch", _tags),
        ("kitti", _kitti),
    )
    rows: list[RealRow] = []
    for name, case in cases:
        if not (folder / name).is_dir():
            continue
        try:
            rows += [RealRow(name, row.quantity, row.value, row.reference) for row in case(folder / name)]
        except SurecutError as error:
            rows.append(RealRow(name, "no result", str(error), ""))
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
    return Rig(boards=tuple(_board(board) for board in boards["boards"]), distances=tuple(distances))


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
    log = folder / "aviary.mcap"
    result = _optimise(log, rig_of_tags(boards))
    errors = np.array([d.distance_m - d.given_m for d in result.distances if d.given_m is not None])
    if len(errors):
        yield RealRow("", f"{len(errors)} given distances, rms", f"{1e3 * np.sqrt((errors**2).mean()):.1f} mm", "truth")
    yield from _against_tum(result, folder / "reference_tum.txt")
    yield from _left_out(log, boards)


def _left_out(log: Path, boards: dict[str, Any]) -> Iterator[RealRow]:
    """Each distance predicted from the other ones: nothing in the estimate has seen it."""
    errors, inside = [], 0
    for one in boards["distances"]:
        pair = (f"{one['from']['tag']}/{one['from']['corner']}", f"{one['to']['tag']}/{one['to']['corner']}")
        result = _optimise(log, rig_of_tags(boards, one["id"]), (pair,))
        found = next(d for d in result.distances if d.given_m is None)
        error = found.distance_m - one["distance_m"]
        errors.append(error)
        inside += abs(error) <= HELD_OUT_SIGMA * np.hypot(found.sigma_m, one["sigma_m"])
    rms_mm = 1e3 * float(np.sqrt(np.mean(np.square(errors))))
    yield RealRow("", f"{len(errors)} distances, each held out, rms", f"{rms_mm:.1f} mm", "truth")
    yield RealRow("", "of these inside the stated 95 % interval", f"{inside} of {len(errors)}", "truth")


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
