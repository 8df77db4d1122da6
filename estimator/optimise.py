"""A recorded log in, the joint estimate out: reads, runs the pipeline, refines, checks what is missing."""

import hashlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING

from ..factors.errors import LogError, SurecutError
from ..factors.measurements import Event
from ..factors.rig import Rig, dump_rig, load_rig
from ..io.ordering import OrderReport
from ..io.reader import LogReader
from .sensed_log import SensedLog, opened
from .stopwatch import Stopwatch

if TYPE_CHECKING:
    from .result import Result

TOGETHER = 3
"""Keyframes that share an update of the solver: nobody waits for the answer in between."""

Progress = Callable[[int], None]
"""Called with each stamp (ns) that has been worked in."""


def rig_of(log: LogReader, given: Path | None) -> Rig:
    """The rig: the file that was given, or the one that the log carries.

    Raises:
        RigError: it is wrong. LogError: there is none.
    """
    if given is not None:
        return load_rig(given)
    text = log.attachment("rig.yaml")
    if text is None:
        next(log.raw(), None)  # what is no recording at all is told first
        raise LogError(f"{log.name}: carries no rig.yaml; give the rig file with --rig (`surecut rig --example`)")
    return load_rig(text, f"{log.name}: rig.yaml")


def optimise(
    log: Path,
    rig_file: Path | None = None,
    between: tuple[tuple[str, str], ...] = (),
    progress: Progress | None = None,
    command: str = "",
    processes: int = 1,
) -> "Result":
    """The joint estimate of one recording.

    Args:
        between: pairs of marker points whose distance is wanted too, such as ("29/0", "60/0").
        processes: 2 runs the front ends beside the graph, in a process of their own; the result is the same.

    Raises:
        SurecutError: one line; what is wrong with log or rig, where, and the cure.
    """
    watch = Stopwatch()
    with LogReader(log) as reader:
        rig = rig_of(reader, rig_file)
    with opened(log, rig, processes) as recording, told_of(log, recording):
        from .depth_run import depth_alone, depth_result  # the graph's libraries load while the front ends start
        from .long_recording import LongRecording
        from .pipeline import Pipeline
        from .run import finish

        pipeline = Pipeline(rig, together=TOGETHER)
        long = LongRecording(pipeline.engine)
        with watch("run"):
            for stamp_ns in pipeline.run(recording):
                long.tidy()
                if progress is not None:
                    progress(stamp_ns)
            report = recording.report
            provenance = _provenance(log, rig, report.sha256, command)
            alone = depth_alone(pipeline.engine, report.sensing)
            if not alone:
                pipeline.check(report.sensing)
        odd = [
            *_damage(report.warnings, pipeline.engine.end_ns),
            *odd_stamps(report.sensing.order, rig, pipeline.engine.end_ns),
        ]
        if alone:
            return depth_result(log, rig, watch.seconds, provenance, odd)
        with watch("refine"):
            return finish(
                pipeline.engine,
                between,
                watch.seconds,
                provenance,
                report.sensing.rejected,
                odd,
                memory=True,
                past=long.past,
                apart=processes > 1,
            )


def _provenance(log: Path, rig: Rig, sha256: str, command: str) -> dict[str, str]:
    """What made the result, of what."""
    return {
        "surecut": version("surecut"),
        "gtsam": version("gtsam"),
        "log": log.name,
        "log_sha256": sha256,
        "rig_sha256": hashlib.sha256(dump_rig(rig).encode()).hexdigest(),
        "command": command,
    }


@contextmanager
def told_of(log: Path, recording: SensedLog) -> Iterator[None]:
    """Errors name the log, and what of it could not be read: that may be why."""
    try:
        yield
    except SurecutError as error:
        text = str(error)
        name = "" if str(log) in text else f"{log}: "
        damage = "".join(f" (the log is damaged: {w})" for w in recording.report.warnings if w not in text)
        raise type(error)(f"{name}{text}{damage}") from error


def _damage(warnings: Sequence[str], end_ns: int) -> list[Event]:
    return [Event(end_ns, "log_damaged", warning, "warning") for warning in warnings]


def odd_stamps(order: OrderReport, rig: Rig, end_ns: int) -> list[Event]:
    """Stamps that run backwards or stand twice: the messages were sorted and used; whoever recorded should know."""
    told = []
    several = {topic: n for topic, n in order.duplicated.items() if topic != rig.picks_topic}  # clicks in one picture
    for kind, counts, text in (
        ("stamps_backwards", order.backwards, "run backwards; the messages were sorted by stamp"),
        ("stamps_duplicated", several, "stand twice"),
    ):
        for topic, count in sorted(counts.items()):
            told.append(Event(end_ns, kind, f"{topic}: {count} stamps {text}", "warning", {"messages": float(count)}))
    if order.zero:
        text = f"{order.zero} messages have no stamp; set header.stamp when recording"
        told.append(Event(end_ns, "stamps_unset", text, "warning", {"messages": float(order.zero)}))
    if order.late:
        text = f"{order.late} messages came too late to be sorted and were worked in out of order"
        told.append(Event(end_ns, "stamps_late", text, "warning", {"messages": float(order.late)}))
    return told
