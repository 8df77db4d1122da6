"""What survives a restart: boards, machine, calibration, pipes and points, and the surest landmarks, with their joint
covariance, as JSON.

Everything else in the graph is eliminated into one Gaussian over these. It stays in the same {o}, so that {b} and the
points keep their numbers; the camera has to find itself again by a board, or by the landmarks, whose patches are kept
(`album.py`). As they come with the joint, seeing one again counts against what was measured before exactly as in a run
without a break: nothing is used twice.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from ...factors import keys
from ...factors.camera import CameraModel
from ...factors.errors import LogError, SurecutError
from ...factors.rig import Pipe
from ...frontends.stereo.atlas import Atlas
from ...io.reader import LogReader
from ..batch import BatchSolution
from ..engine import Engine
from ..graph import Record, Update
from ..marginal import FAMILY, WIDTHS, GaussianPrior, gaussian_of, value_of
from ..observability import Undetermined, determined
from ..output_files import write_text
from ..pipe_parts import known_cylinder, known_point
from ..track_gate import AWAY
from .memory_atlas import from_data as atlas_from_data
from .memory_atlas import packed, unpacked
from .memory_atlas import to_data as atlas_to_data
from .remembered import KEY, LARGEST_BYTES, to_data
from .variables import LONG_LIVED, long_lived
from .wire import Answer

Float = NDArray[np.float64]

FORMAT = 2
READABLE = (1, 2)
"""Formats; the first knew no landmarks."""
JOINT_LANDMARKS = 100
"""The joint of all that is kept is dense: a megabyte with so many, a fiftieth of a second for each update."""
MARK, HEAD = '"surecut_memory"', 40
"""What a checkpoint begins with, and within how many characters."""


class MemoryFileError(SurecutError):
    """A checkpoint cannot be used."""


@dataclass(frozen=True, slots=True)
class Memory:
    """One checkpoint."""

    stamp_ns: int
    keyframes: int
    """Number that have been used up: later ones go on from there."""
    prior: GaussianPrior
    cameras: dict[str, CameraModel]
    boards: list[dict[str, Any]]
    points: list[dict[str, Any]]
    pipes: list[dict[str, Any]]
    mounted: bool
    distances_open: list[int]
    """Places in the rig's list of those that have not entered."""
    inset_sigma_px: list[tuple[str, str, float]]
    cylinders: list[str]
    """Pipes that the machine's depth camera has seen."""
    atlas: Atlas = field(default_factory=Atlas)
    """By which the front end finds its way."""
    laid: list[int] = field(default_factory=list)
    """Landmarks on surfaces that the machine's depth camera has seen."""
    shared: list[tuple[int, int, int]] = field(default_factory=list)
    """How many share the distortion of a part of its view: see `Surfaces`."""


def remember(engine: Engine, solution: BatchSolution | None = None) -> Memory | None:
    """What an engine knows now; None while it knows no board.

    Args:
        solution: of the batch refinement, where there has been one.
    """
    if not engine.boards.any_known() or engine.graph.unsolved:
        return None
    atlas, prior = _joint(engine, solution)
    landmarks = {keys.index(key) for key in prior.keys if keys.kind(key) == "l"}
    laid, shared = engine.surfaces.laid()
    return Memory(
        stamp_ns=engine.end_ns,
        keyframes=len(engine.odometry.keyframe_stamps),
        prior=prior,
        cameras=dict(engine.cameras),
        boards=[
            {
                "id": name,
                "epoch": sheet.epoch,
                "known": sheet.known,
                "page_known": sheet.page_known,
                "slots": sorted(sheet.slots.items()),
                "exchanged": sorted(sheet.exchanged.items()),
                "loose": sorted(sheet.loose),
                "last_seen_ns": sheet.last_seen_ns,
                "first_seen_ns": sheet.first_seen_ns,
            }
            for name, sheet in engine.boards.sheets.items()
        ],
        points=[
            {
                "index": p.index,
                "name": p.id,
                "role": p.role,
                "pipe": p.pipe,
                "on_axis": p.on_axis,
                "picks": p.picks,
                "stamp_ns": p.stamp_ns,
            }
            for p in engine.pipes.points.values()
            if p.known
        ],
        pipes=[
            {"index": c.index, "id": name, "outlines": c.outlines}
            for name, c in engine.pipes.cylinders.items()
            if c.known
        ],
        mounted=engine.machine.mounted,
        distances_open=[engine.rig.distances.index(d) for d in engine.distances.open],
        inset_sigma_px=[(*key, sigma) for key, sigma in engine.boards.corners.inset_sigma_px.items()],
        cylinders=sorted(_seen_by_machine(engine)),
        atlas=atlas,
        laid=sorted(laid & landmarks),
        shared=[(x, y, count) for (x, y), count in shared.items()],
    )


def _joint(engine: Engine, solution: BatchSolution | None) -> tuple[Atlas, GaussianPrior]:
    """What is known of all that is kept, and by what the landmarks among it are found again.

    Raises:
        ObservabilityError: something else than a landmark is not determined.
    """
    values = engine.solver.values() if solution is None else solution.values
    views = {
        t: n
        for t, n in engine.odometry.observations.items()
        if values.exists(keys.landmark(t)) and not engine.adrift.holds(keys.landmark(t))
    }
    while True:
        atlas, joint = engine.album.chosen(views, JOINT_LANDMARKS)
        stay = [*long_lived(values), *map(keys.landmark, joint)]
        try:
            if solution is None:
                return atlas, engine.solver.joint_gaussian(stay)
            with determined():
                return atlas, gaussian_of(solution.at.graph(), values, stay)
        except Undetermined as error:
            if error.key not in stay or keys.kind(error.key) != "l":
                raise
            del views[keys.index(error.key)]


def recall(engine: Engine, memory: Memory) -> None:
    """Puts what is remembered into a fresh engine: it goes on in the same {o}, its camera astray.

    Raises:
        MemoryFileError: the memory is of another rig.
    """
    missing = {b["id"] for b in memory.boards} ^ set(engine.boards.sheets)
    if missing:
        raise MemoryFileError(
            f"the checkpoint and the rig disagree about board {sorted(missing)[0]}; give another checkpoint or rig"
        )
    engine.cameras.update(memory.cameras)
    update = Update()
    update.values.insert(memory.prior.at)
    what = "what an earlier run found out"
    update.add(memory.prior.factor(), Record(FAMILY, "earlier run", memory.stamp_ns, what, rejectable=False))
    for stored in memory.boards:
        sheet = engine.boards.sheets[stored["id"]]
        sheet.epoch, sheet.known, sheet.page_known = stored["epoch"], stored["known"], stored["page_known"]
        sheet.slots = {int(m): int(s) for m, s in stored["slots"]}
        sheet.exchanged = {int(a): int(b) for a, b in stored["exchanged"]}
        sheet.loose = set(stored["loose"])
        sheet.last_seen_ns, sheet.first_seen_ns = stored["last_seen_ns"], stored["first_seen_ns"]
    used = [slot for sheet in engine.boards.sheets.values() for slot in sheet.slots.values()]
    corners = [keys.index(k) // 4 for k in memory.prior.keys if keys.kind(k) == "q"]
    engine.boards.begin_slots(max([*used, *corners], default=-1) + 1)
    engine.boards.corners.inset_sigma_px = {(c, b): s for c, b, s in memory.inset_sigma_px}
    for stored in memory.points:
        engine.pipes.points[stored["name"]] = known_point(**stored)
    for stored in memory.pipes:
        given = next((p for p in engine.rig.pipes if p.id == stored["id"]), Pipe(id=stored["id"]))
        engine.pipes.cylinders[stored["id"]] = known_cylinder(stored["index"], given, stored["outlines"])
    engine.depth_pipes.remembered = {(pipe, engine.base) for pipe in memory.cylinders}
    _recall_landmarks(engine, memory)
    engine.resume(update, memory.keyframes, memory.mounted, [engine.rig.distances[i] for i in memory.distances_open])


def _recall_landmarks(engine: Engine, memory: Memory) -> None:
    """Those of the joint are landmarks again as soon as they are seen; they count as away until then."""
    tracks = memory.atlas.tracks
    views = dict(zip(tracks.ids.tolist(), tracks.views.tolist(), strict=True))
    there = [keys.index(key) for key in memory.prior.keys if keys.kind(key) == "l"]
    engine.odometry.observations = {t: views.get(t, 0) for t in there}
    engine.odometry.seen_in = dict.fromkeys(there, memory.keyframes - 1 - AWAY)
    engine.surfaces.recall(set(memory.laid), {(x, y): count for x, y, count in memory.shared})
    engine.album.recall(memory.atlas)


def _seen_by_machine(engine: Engine) -> set[str]:
    entered = {pipe for (pipe, _), seen in engine.depth_pipes.seen.items() if seen.entered}
    return entered | {pipe for pipe, _ in engine.depth_pipes.remembered}


# The file -------------------------------------------------------------------------------------------------------------


def save(memory: Memory, path: Path, rig_sha256: str, answer: Answer | None = None) -> None:
    """Writes it whole or not at all: to a file beside it, then renamed.

    Args:
        answer: what was said last, see `remembered`.
    """
    write_text(path, to_json(memory, rig_sha256, answer))


def load(path: Path) -> Memory:
    """From a checkpoint, or from a result of a recording (JSON or MCAP).

    Raises:
        MemoryFileError: it cannot be read, or is neither.
    """
    try:
        if path.suffix == ".mcap":
            with LogReader(path) as reader:
                text = (reader.attachment("result.json") or b"").decode("utf-8")
        else:
            if path.stat().st_size > LARGEST_BYTES:
                raise MemoryFileError(f"{path}: is larger than {LARGEST_BYTES >> 20} MB; remove it")
            text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError, LogError) as error:
        raise MemoryFileError(f"{path}: cannot be read ({error}); remove it to start without memory") from error
    return from_json(_of_result(text, str(path)), str(path))


def _of_result(text: str, name: str) -> str:
    """The memory in a result; another text as it is."""
    if MARK in text[:HEAD]:
        return text
    try:
        data = json.loads(text)
        if "trajectory" not in data:
            return text
        found = str(data.get("memory", ""))
    except (ValueError, AttributeError, TypeError, RecursionError):
        return text
    if not found:
        raise MemoryFileError(f"{name}: holds no memory of boards and machine; run `surecut optimise` again")
    return found


def to_json(memory: Memory, rig_sha256: str, answer: Answer | None = None) -> str:
    prior = memory.prior
    body = {
        "surecut_memory": FORMAT,
        "rig_sha256": rig_sha256,
        "stamp_ns": memory.stamp_ns,
        "keyframes": memory.keyframes,
        "variables": [
            {"kind": keys.kind(k), "index": keys.index(k), "value": _numbers(prior.at, k)} for k in prior.keys
        ],
        "information": packed(prior.H, "<f8"),
        "vector": packed(prior.g, "<f8"),
        "cameras": [_camera(c) for c in memory.cameras.values()],
        "boards": memory.boards,
        "points": memory.points,
        "pipes": memory.pipes,
        "mounted": memory.mounted,
        "distances_open": memory.distances_open,
        "inset_sigma_px": memory.inset_sigma_px,
        "cylinders": memory.cylinders,
        "atlas": atlas_to_data(memory.atlas),
        "laid": memory.laid,
        "shared": memory.shared,
    }
    if answer is not None:
        body[KEY] = to_data(answer)
    return json.dumps(body, allow_nan=False) + "\n"


def from_json(text: str, name: str = "checkpoint") -> Memory:
    """
    Raises:
        MemoryFileError: it is no checkpoint, or a newer one.
    """
    try:
        data = json.loads(text)
        if data["surecut_memory"] not in READABLE:
            found = data["surecut_memory"]
            raise MemoryFileError(f"{name}: is of format {found}, this one reads up to {FORMAT}; remove it")
        variables = [
            (gtsam.symbol(str(v["kind"])[:1], int(v["index"])), v["kind"], v["value"]) for v in data["variables"]
        ]
        if any(kind not in LONG_LIVED and kind != "l" for _, kind, _ in variables):
            raise ValueError("a kind of variable that does not live on")
        at = gtsam.Values()
        for key, kind, value in variables:
            at.insert(key, _value(str(kind), np.array(value, float)))
        widths = tuple(WIDTHS[str(kind)] for _, kind, _ in variables)
        size = sum(widths)
        H = unpacked(data["information"], "<f8", (size, size))
        g = unpacked(data["vector"], "<f8", (size,))
        if not (np.isfinite(H).all() and np.isfinite(g).all()):
            raise ValueError("numbers that are not finite")
        prior = GaussianPrior(tuple(key for key, _, _ in variables), widths, H, g, at)
        cameras = {c["name"]: _camera_of(c) for c in data["cameras"]}
        insets = [(str(c), str(b), float(s)) for c, b, s in data["inset_sigma_px"]]
        return Memory(
            int(data["stamp_ns"]), int(data["keyframes"]), prior, cameras, data["boards"], data["points"],
            data["pipes"], bool(data["mounted"]), [int(i) for i in data["distances_open"]], insets,
            [str(pipe) for pipe in data["cylinders"]],
            atlas_from_data(data["atlas"]) if "atlas" in data else Atlas(),
            [int(track) for track in data.get("laid", ())],
            [(int(x), int(y), int(count)) for x, y, count in data.get("shared", ())],
        )  # fmt: skip
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError, RecursionError) as error:
        what = " ".join(str(error).split())[:120]
        raise MemoryFileError(f"{name}: is no checkpoint ({what}); remove it to start without memory") from error


def _numbers(values: gtsam.Values, key: int) -> list[float]:
    value = value_of(values, key)
    if isinstance(value, gtsam.Pose3):
        return value.matrix().ravel().tolist()
    return (value.vector() if isinstance(value, gtsam.Cal3DS2) else np.asarray(value)).ravel().tolist()


def _value(kind: str, numbers: Float) -> gtsam.Pose3 | gtsam.Cal3DS2 | Float:
    if not np.isfinite(numbers).all():
        raise ValueError("numbers that are not finite")
    if kind in "fbe":
        return gtsam.Pose3(numbers.reshape(4, 4))
    return gtsam.Cal3DS2(numbers) if kind == "k" else numbers.reshape(WIDTHS[kind])


def _camera(camera: CameraModel) -> dict[str, Any]:
    return {
        "name": camera.name, "width": camera.width, "height": camera.height, "K": camera.K.ravel().tolist(),
        "distortion_model": camera.distortion_model, "D": camera.D.ravel().tolist(),
        "rectification": camera.rectification.ravel().tolist(), "baseline_m": camera.baseline_m,
    }  # fmt: skip


def _camera_of(data: Mapping[str, Any]) -> CameraModel:
    return CameraModel(
        str(data["name"]), int(data["width"]), int(data["height"]), np.array(data["K"], float).reshape(3, 3),
        str(data["distortion_model"]), np.array(data["D"], float), np.array(data["rectification"], float).reshape(3, 3),
        None if data["baseline_m"] is None else float(data["baseline_m"]),
    )  # fmt: skip
