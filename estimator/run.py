"""Measurements to result: the one loop, its end, and the batch refinement."""

from collections.abc import Iterable, Mapping, Sequence
from functools import partial

from ..factors.camera import CameraModel
from ..factors.errors import ObservabilityError
from ..factors.measurements import Event, Rejection
from ..factors.rig import Rig, sha256_of
from .batch import BatchSolution, solve
from .board_faults import settle_boards
from .bundle import bundles
from .engine import Engine
from .result import Result
from .summary import Summary
from .surfaces import Associator

SETTLE_ROUNDS = 8


def solved(engine: Engine) -> BatchSolution:
    """Settles iSAM2, and refines in batch over the same factors.

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
    engine.state.values = engine.solver.settle(SETTLE_ROUNDS)
    solution = solve(engine.solver.log, engine.state.values, engine.rig.gates.robust_sigma)
    return settle_boards(engine, solution)


def finish(
    engine: Engine,
    between: tuple[tuple[str, str], ...] = (),
    timing: Mapping[str, float] | None = None,
    provenance: Mapping[str, str] | None = None,
    rejected: Sequence[Rejection] = (),
    events: Sequence[Event] = (),
    memory: bool = False,
    apart: bool = False,
) -> Result:
    """Settles iSAM2, refines in batch over the same factors, and reads the result.

    Args:
        memory: a later run may begin with the result.
        apart: copies of the process do a part of the work, where a second core is free.

    Raises:
        ObservabilityError: nothing ties the log together, or what was asked for is not determined by it.
    """
    solution = solved(engine)
    engine.boards.inspection.doubled_in_images(rejected)
    engine.rejected += rejected
    engine.events += events
    summary = Summary(engine, solution, apart)
    remembered = partial(_memory, engine, solution) if memory else str
    return summary.result(between, dict(timing or {}), dict(provenance or {}), remembered)


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
