"""A recorded log in, the joint estimate out: reads, runs the pipeline, refines, checks what is missing."""

import hashlib
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path

from ..factors.errors import LogError
from ..factors.measurements import Event
from ..factors.rig import Rig, dump_rig, load_rig
from ..io.reader import LogReader
from .pipeline import Pipeline, wanted_topics
from .result import Result
from .run import finish
from .stopwatch import Stopwatch

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
        raise LogError(f"{log.name}: carries no rig.yaml; give the rig file with --rig (`surecut rig --example`)")
    return load_rig(text, f"{log.name}: rig.yaml")


def optimise(
    log: Path,
    rig_file: Path | None = None,
    between: tuple[tuple[str, str], ...] = (),
    progress: Progress | None = None,
    command: str = "",
) -> Result:
    """The joint estimate of one recording.

    Args:
        between: pairs of marker points whose distance is wanted too, such as ("29/0", "60/0").

    Raises:
        SurecutError: one line; what is wrong with log or rig, where, and the cure.
    """
    watch = Stopwatch()
    with LogReader(log) as reader:
        rig = rig_of(reader, rig_file)
    pipeline = Pipeline(rig)
    reader = LogReader(log, wanted_topics(rig))
    with watch("run"):
        for stamp_ns in pipeline.run(reader):
            if progress is not None:
                progress(stamp_ns)
    pipeline.check()
    sha256 = reader.sha256()
    with watch("refine"):
        result = finish(
            pipeline.engine,
            between,
            watch.seconds,
            {
                "surecut": version("surecut"),
                "gtsam": version("gtsam"),
                "log": log.name,
                "log_sha256": sha256,
                "rig_sha256": hashlib.sha256(dump_rig(rig).encode()).hexdigest(),
                "command": command,
            },
            [*pipeline.sensors.rejected],
            [Event(pipeline.engine.end_ns, "log_damaged", w, "warning") for w in reader.warnings],
        )
    return result
