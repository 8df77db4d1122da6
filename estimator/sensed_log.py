"""A recording as the front ends see it: read in this process, or in two of their own while the graph is being solved.

```
[reader, tracking] ──> [markers, surfaces, clicks] ──> graph
```

Where that is safe the two are copies (forks) of this process: what has been loaded is there at once, and the first
begins before the graph's libraries are loaded.
"""

import importlib
import multiprocessing
import queue
import traceback
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from multiprocessing.process import BaseProcess
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from ..factors.errors import SurecutError
from ..factors.rig import Rig
from ..io.reader import LogReader
from .passage import ROOM_BYTES, Passage
from .sensed_here import RecordingReport, SensedHere, SensedLog
from .threads import single_threaded_children

if TYPE_CHECKING:
    from ..factors.measurements import StereoFrame
    from ..frontends.stereo.atlas import Memorable
    from .items import Item
    from .sensing import Sensed

AHEAD = 64
"""Stamps that each process may be ahead of the next: what bounds the memory."""
POLL_S = 1.0
SHARED_SIZE = 256
"""Rows of a matrix whose products are shared among threads, if there are any."""


def opened(log: Path, rig: Rig, processes: int = 1) -> "AbstractContextManager[SensedLog]":
    """A recording and its front ends, in this process or, with two, beside it."""
    return SensedElsewhere(log, rig) if processes > 1 else SensedHere(log, rig)


@dataclass(frozen=True, slots=True)
class _Followed:
    """How the mobile camera moved, and what of the messages of one stamp is still of use."""

    stamp_ns: int
    items: "list[Item]"
    frame: "StereoFrame | None"
    warnings: tuple[str, ...]
    """What has been found wrong with the recording so far."""
    memorable: "Memorable | None" = None
    """What the frame added to what can be found again."""


@dataclass(frozen=True, slots=True)
class _End:
    """The last that comes out of a process of front ends."""

    report: RecordingReport
    error: SurecutError | None = None
    defect: str | None = None
    """Traceback of what should not have happened."""


class SensedElsewhere:
    """Front ends in processes of their own, a bounded number of stamps ahead."""

    def __init__(self, log: Path, rig: Rig) -> None:
        self._report: RecordingReport | None = None
        self._log, self._rig = log, rig
        self._processes: list[BaseProcess] = []
        self._context: Any = None
        self._followed: Passage
        self._sensed: Passage

    @property
    def report(self) -> RecordingReport:
        return self._report or RecordingReport.empty()

    def __enter__(self) -> Self:
        forks = may_fork()
        self._context = multiprocessing.get_context("fork" if forks else "spawn")
        room_bytes = ROOM_BYTES if forks else 0
        self._followed, self._sensed = (Passage(self._context, AHEAD, room_bytes) for _ in range(2))
        if forks:
            importlib.import_module(".sensing", __package__)  # here, for all processes
        self._start(_follow, self._log, self._rig, self._followed)
        if not forks:
            self._start(_look, self._rig, self._followed, self._sensed)
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        for process in self._processes:
            process.terminate()
        for process in self._processes:
            process.join()
        self._followed.close()
        self._sensed.close()

    def __iter__(self) -> Iterator["Sensed"]:
        """
        Raises:
            SurecutError: what the front ends found wrong, or one of their processes was killed.
        """
        if len(self._processes) == 1:  # this copy needs what the graph has loaded by now
            self._start(_look, self._rig, self._followed, self._sensed)
        while not isinstance(item := self._next(), _End):
            yield item
        self._report = item.report
        if item.error is not None:
            raise item.error
        if item.defect is not None:
            raise RuntimeError(item.defect)

    def _start(self, work: Callable[..., None], *given: object) -> None:
        process = self._context.Process(target=work, args=given, daemon=True)
        with single_threaded_children():
            process.start()
        self._processes.append(process)

    def _next(self) -> "Sensed | _End":
        while True:
            try:
                return self._sensed.get(timeout=POLL_S)
            except queue.Empty:
                dead = next((p.exitcode for p in self._processes if p.exitcode), None)
                if dead is not None and self._sensed.empty():
                    raise SurecutError(
                        f"{self._log}: the process that reads it was killed (exit code {dead}); is there enough memory?"
                    ) from None


def may_fork() -> bool:
    """Is a copy of this process safe? It has none of the threads, and whatever these have locked stays locked."""
    tasks = Path("/proc/self/task")
    if "fork" not in multiprocessing.get_all_start_methods() or not tasks.is_dir():
        return False
    work = np.ones((SHARED_SIZE, SHARED_SIZE))
    np.linalg.norm(work @ work)  # where NumPy has threads for this, they are there now
    return len([*tasks.iterdir()]) == 1


def _follow(log: Path, rig: Rig, out: Passage) -> None:
    """The first process: reads, and follows the mobile camera."""
    from .items import wanted_topics
    from .sensing import Sensing

    _prepare()
    reader, sensing = LogReader(log, wanted_topics(rig)), Sensing(rig)

    def report() -> RecordingReport:
        return RecordingReport(sensing.report(), tuple(reader.warnings))

    try:
        for group in sensing.groups(reader):
            frame = sensing.follow(group)
            needed, memorable = sensing.needed(group, frame), sensing.memorable(frame)
            out.put(_Followed(group[0].stamp_ns, needed, frame, tuple(reader.warnings), memorable))
        out.put(_End(replace(report(), sha256=reader.sha256())))
    except SurecutError as error:
        out.put(_End(report(), error))
    except Exception:
        out.put(_End(report(), defect=traceback.format_exc()))


def _look(rig: Rig, followed: Passage, out: Passage) -> None:
    """The second process: everything else that can be seen."""
    from .sensing import Sensing, SensingReport

    _prepare()
    sensing, warnings = Sensing(rig), ()

    def report(of: RecordingReport) -> RecordingReport:
        own = sensing.report()
        return replace(of, sensing=replace(of.sensing, rejected=own.rejected, depths=own.depths))

    try:
        while not isinstance(item := followed.get(), _End):
            warnings = item.warnings
            out.put(sensing.look(item.items, item.frame, item.stamp_ns, item.memorable))
        out.put(replace(item, report=report(item.report)))
    except SurecutError as error:
        out.put(_End(report(RecordingReport(SensingReport(), warnings)), error))
    except Exception:
        out.put(_End(report(RecordingReport(SensingReport(), warnings)), defect=traceback.format_exc()))


def _prepare() -> None:
    import cv2

    from .stream.parent import end_with_parent

    cv2.setNumThreads(1)  # the cores are shared with the others
    end_with_parent()
