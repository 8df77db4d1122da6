"""Measurements to result: the one loop, its end, and the batch refinement."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial

import gtsam

from ..factors.camera import CameraModel
from ..factors.errors import ObservabilityError
from ..factors.measurements import Event, Rejection
from ..factors.rig import Rig, sha256_of
from .aside import Aside
from .batch import BatchSolution, solve
from .board_faults import settle_boards
from .bundle import bundles
from .engine import Engine
from .pipe_tracks import widen_pipe_tracks
from .plain_tests import PlainTests
from .result import PoseEstimate, Result
from .summary import Summary
from .surfaces import Associator

Meanwhile = Callable[[BatchSolution], None]
"""Called with a solution while it is found out how the errors of its tracks are correlated."""


def solved(engine: Engine, apart: bool = False, meanwhile: Meanwhile | None = None) -> BatchSolution:
    """Settles iSAM2, and refines in batch over the same factors.

    Args:
        apart: both at the same time, the former in a copy of the process.

    Raises:
        ObservabilityError: nothing ties the log together.
    """
    engine.revisit()
    engine.flush()
    if engine.odometry.last_keyframe < 0:
        raise ObservabilityError(
            "there is nothing to estimate: no stereo pair and no known marker was seen; check topics and marker ids in "
            "the rig file (`surecut info LOG`)"
        )
    widen_pipe_tracks(engine)
    solution = _both_ways(engine, meanwhile) if apart else _refined(engine, meanwhile)
    return settle_boards(engine, solution)


def _refined(engine: Engine, meanwhile: Meanwhile | None) -> BatchSolution:
    engine.state.values = engine.solver.settle()
    return solve(engine.solver.log, engine.state.values, engine.rig.gates.robust_sigma, meanwhile)


def _both_ways(engine: Engine, meanwhile: Meanwhile | None) -> BatchSolution:
    """The batch solution needs no settled start; it only takes a few steps more."""
    solver = engine.solver
    running: Aside[tuple[gtsam.Values, int]] = Aside(apart=True, niceness=0)
    running.begin(lambda: (solver.settle(), len(solver.dropped)))
    try:
        solution = solve(solver.log, solver.values(), engine.rig.gates.robust_sigma, meanwhile)
        values, dropped = running.awaited()
    except ObservabilityError:
        return _refined(
            engine, meanwhile
        )  # which may give up landmarks that nothing determines, or tells what is missing
    finally:
        running.stop()
    if dropped != len(solver.dropped):
        return _refined(engine, meanwhile)
    engine.state.values = solver.relocate(values, (), gtsam.Pose3())
    return solution


def finish(
    engine: Engine,
    between: tuple[tuple[str, str], ...] = (),
    timing: Mapping[str, float] | None = None,
    provenance: Mapping[str, str] | None = None,
    rejected: Sequence[Rejection] = (),
    events: Sequence[Event] = (),
    memory: bool = False,
    past: Sequence[PoseEstimate] = (),
    apart: bool = False,
) -> Result:
    """Settles iSAM2, refines in batch over the same factors, and reads the result.

    Args:
        memory: a later run may begin with the result.
        past: the path of keyframes that have left the graph.
        apart: copies of the process do a part of the work, where a second core is free.

    Raises:
        ObservabilityError: nothing ties the log together, or what was asked for is not determined by it.
    """
    plain = PlainTests(engine, apart)
    try:
        solution = solved(engine, apart, plain.begin)
        engine.boards.inspection.doubled_in_images(rejected)
        engine.rejected += rejected
        engine.events += events
        remembered = partial(_memory, engine, solution) if memory else str
        summary = Summary(engine, solution, plain, past, apart)
        return summary.result(between, dict(timing or {}), dict(provenance or {}), remembered)
    finally:
        plain.stop()


def _memory(engine: Engine, solution: BatchSolution) -> str:
    from .stream.memory import remember, to_json  # which is only wanted for recordings

    found = remember(engine, solution)
    return "" if found is None else to_json(found, sha256_of(engine.rig))


def estimate(
    measurements: Iterable[object],
    rig: Rig,
    cameras: Mapping[str, CameraModel],
    associate: Associator,
    between: tuple[tuple[str, str], ...] = (),
) -> Result:
    """The result of measurements that are at hand already, such as simulated ones or a robot's own."""
    engine = Engine(rig, cameras, associate)
    for bundle in bundles(list(measurements)):
        engine.add(bundle)
    return finish(engine, between)
