"""Pipes and cut points of simulated recordings against their truth, and what stands in the way of smaller errors.

Each recording is estimated as any other. Then parts of the truth are held in its graph, one after the other, and the
cut points are solved again: the difference is what that part costs.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import gtsam
import numpy as np
from numpy.typing import NDArray

from ..estimator.batch import BatchSolution, solve
from ..estimator.engine import Engine
from ..estimator.linear import deviate
from ..estimator.optimise import TOGETHER, rig_of
from ..estimator.pipeline import Pipeline
from ..estimator.points_in_base import pipe_estimate, point_blocks
from ..estimator.run import solved
from ..estimator.sensed_log import opened
from ..factors import keys
from ..factors.errors import SurecutError
from ..io.reader import LogReader
from .campaign_pixels import truth_of_log
from .evaluate import normalised_square
from .held import HOLDS, with_truth
from .measurement_level_truth import Truth

Float = NDArray[np.float64]
SeenBy = Literal["stereo", "both", "neither"]
"""Who holds the pipe's cylinder: the mobile camera's images, these and the Kinect's cloud, or nobody (clicks only)."""
AS_IT_IS = "as it is"


@dataclass(frozen=True, slots=True)
class CutPoint:
    """One cut point of one estimate. Components: along the axis, away from the camera that was clicked in, across."""

    recording: str
    seen_by: SeenBy
    held: str
    id: str
    error_m: tuple[float, float, float]
    sigma_m: tuple[float, float, float]
    nees: float
    """Squared error in sigmas, 3 degrees of freedom."""

    @property
    def distance_m(self) -> float:
        """Length of the error."""
        return float(np.linalg.norm(self.error_m))


@dataclass(frozen=True, slots=True)
class FoundPipe:
    """The cylinder of one recording."""

    recording: str
    seen_by: SeenBy
    axis_rad: float
    """Angle between estimated and true axis."""
    radius_error_m: float
    radius_sigma_m: float
    outlines: int
    paths_sigma: float | None
    """How far stereo's pipe and the Kinect's are apart, sigmas; None where only one of them sees it."""


@dataclass(frozen=True, slots=True)
class Examined:
    """One recording."""

    recording: str
    points: tuple[CutPoint, ...]
    pipe: FoundPipe | None
    reason: str = ""
    """Why there is nothing."""


def examine(log: Path, holds: Sequence[str] = ()) -> Examined:
    """A simulated recording against its truth, also with parts of the truth held (names of `held.HOLDS`)."""
    try:
        truth = truth_of_log(log)
        with LogReader(log) as reader:
            rig = rig_of(reader, None)
        with opened(log, rig) as recording:
            pipeline = Pipeline(rig, together=TOGETHER)
            for _ in pipeline.run(recording):
                pass
            pipeline.check(recording.report.sensing)
        return examined(log.stem, pipeline.engine, truth, holds)
    except SurecutError as error:
        return Examined(log.stem, (), None, str(error))


def examined(name: str, engine: Engine, truth: Truth, holds: Sequence[str]) -> Examined:
    """The same of a run whose measurements are all in the graph."""
    solution = solved(engine)
    seen_by = _seen_by(engine, solution)
    points = _points(name, seen_by, AS_IT_IS, engine, solution, truth)
    for hold in holds:
        log = with_truth(engine, HOLDS[hold](engine, truth))
        again = solve(log, solution.values, engine.rig.gates.robust_sigma)
        points += _points(name, seen_by, hold, engine, again, truth)
    return Examined(name, tuple(points), _pipe(name, seen_by, engine, solution, truth))


def _seen_by(engine: Engine, solution: BatchSolution) -> SeenBy:
    families = {record.family for _, _, record in solution.at.active}
    if "pipe cylinder" in families:
        return "both"
    return "stereo" if "pipe outline" in families else "neither"


def _points(
    name: str, seen_by: SeenBy, held: str, engine: Engine, solution: BatchSolution, truth: Truth
) -> list[CutPoint]:
    found = []
    for point in engine.pipes.points.values():
        if not point.known or point.id not in truth.points_b_m:
            continue
        position, blocks = point_blocks(solution.values, engine.base, keys.point(point.index))
        covariance = solution.at.system.covariance(blocks)
        error = position - truth.points_b_m[point.id]
        axes = _axes(truth, _eye(engine, point.id, solution.values))
        found.append(
            CutPoint(
                name,
                seen_by,
                held,
                point.id,
                _three(axes @ error),
                _three(np.sqrt(np.diag(axes @ covariance @ axes.T))),
                normalised_square(error, covariance),
            )
        )
    return found


def _three(values: Float) -> tuple[float, float, float]:
    x, y, z = values.tolist()
    return x, y, z


def _eye(engine: Engine, point_id: str, values: gtsam.Values) -> Float:
    """Mean place of the cameras in which a point was clicked, in {b}."""
    o_T_b = values.atPose3(engine.base)
    clicked = [where for where, pick in engine.pipes.clicked if pick.point_id == point_id and pick.camera != "b_rgb"]
    places = [o_T_b.transformTo(where.o_T_c.translation()) for where in clicked] or [np.zeros(3)]
    return np.asarray(np.mean(places, axis=0), np.float64)


def _axes(truth: Truth, eye_b_m: Float) -> Float:
    """Rows: along the true axis, from the eye to the pipe, and across both; shape (3, 3)."""
    axis = truth.pipe.axis_b
    sight = truth.pipe.point_b_m - eye_b_m
    sight = sight - (sight @ axis) * axis
    sight /= np.linalg.norm(sight)
    return np.stack([axis, sight, np.cross(axis, sight)])


def _pipe(name: str, seen_by: SeenBy, engine: Engine, solution: BatchSolution, truth: Truth) -> FoundPipe | None:
    cylinder = engine.pipes.cylinders.get("pipe0")
    if cylinder is None or not cylinder.known:
        return None
    near = truth.pipe.point_b_m
    pipe = pipe_estimate("pipe0", "", cylinder.index, engine.base, near, solution.values, solution.at.system)
    return FoundPipe(
        name,
        seen_by,
        float(np.arccos(min(abs(float(pipe.axis @ truth.pipe.axis_b)), 1.0))),
        pipe.radius_m - truth.pipe.radius_m,
        float(np.sqrt(pipe.covariance[6, 6])),
        cylinder.outlines,
        _between_ways(engine, solution),
    )


def _between_ways(engine: Engine, solution: BatchSolution) -> float | None:
    """Chi-square of the Kinect's cylinder against all else, in sigmas of one normal variable."""

    positions = [i for i, (_, _, record) in enumerate(solution.at.active) if record.family == "pipe cylinder"]
    if not positions:
        return None
    found = solution.at.system.standardised(positions)
    return max(deviate(total, dof) if dof else 0.0 for total, dof in found)


def examine_all(
    folder: Path, holds: Sequence[str] = (), most: int | None = None, done: Callable[[], None] = lambda: None
) -> tuple[Examined, ...]:
    """All simulated recordings of a folder.

    Raises:
        SurecutError: there is none.
    """
    logs = sorted(folder.glob("*.mcap"))[:most]
    if not logs:
        raise SurecutError(f"{folder}: holds no recordings (*.mcap); `surecut campaign --recordings` keeps them")
    found = []
    for log in logs:
        found.append(examine(log, holds))
        done()
    return tuple(found)
