"""A recording as the front ends see it: read in this process, or in one of its own while the graph is being solved.

The front ends' libraries take a second to load. They are imported where they run, so that the other process can start
before this one has loaded the graph's.
"""

import multiprocessing
import queue
import traceback
from collections.abc import Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass
from multiprocessing.process import BaseProcess
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Protocol, Self

from ..factors.errors import SurecutError
from ..factors.rig import Rig
from ..io.reader import LogReader
from .threads import single_threaded_children

if TYPE_CHECKING:
    from .sensing import Sensed, SensingReport

AHEAD = 64
"""Stamps that the front ends may be ahead of the graph: what bounds the memory."""
POLL_S = 1.0


@dataclass(frozen=True, slots=True)
class RecordingReport:
    """What can be said of a recording once it has been read."""

    sensing: "SensingReport"
    warnings: tuple[str, ...] = ()
    """Damage, one line each."""
    sha256: str = ""

    @classmethod
    def empty(cls) -> "RecordingReport":
        """Of a recording of which nothing has been read."""
        from .sensing import SensingReport

        return cls(SensingReport())


class SensedLog(Protocol):
    """What is seen in a recording, stamp by stamp; the report is complete after the last."""

    @property
    def report(self) -> RecordingReport: ...

    def __iter__(self) -> Iterator["Sensed"]: ...


def opened(log: Path, rig: Rig, processes: int = 1) -> "AbstractContextManager[SensedLog]":
    """A recording and its front ends, in this process or, with two, in one of their own."""
    return SensedElsewhere(log, rig) if processes > 1 else SensedHere(log, rig)


class SensedHere:
    """Front ends in this process."""

    def __init__(self, log: Path, rig: Rig) -> None:
        from .items import wanted_topics
        from .sensing import Sensing

        self._reader = LogReader(log, wanted_topics(rig))
        self._sensing = Sensing(rig)
        self._sha256 = ""

    @property
    def report(self) -> RecordingReport:
        return RecordingReport(self._sensing.report(), tuple(self._reader.warnings), self._sha256)

    def __iter__(self) -> Iterator["Sensed"]:
        yield from self._sensing.run(self._reader)
        self._sha256 = self._reader.sha256()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        self._reader.close()


@dataclass(frozen=True, slots=True)
class _End:
    """The last that comes out of a process of front ends."""

    report: RecordingReport
    error: SurecutError | None = None
    defect: str | None = None
    """Traceback of what should not have happened."""


class SensedElsewhere:
    """Front ends in a process of their own, a bounded number of stamps ahead."""

    def __init__(self, log: Path, rig: Rig) -> None:
        self._report: RecordingReport | None = None
        self._log, self._rig = log, rig
        self._process: BaseProcess | None = None
        self._queue: Any = None

    @property
    def report(self) -> RecordingReport:
        return self._report or RecordingReport.empty()

    def __enter__(self) -> Self:
        context = multiprocessing.get_context("spawn")
        self._queue = context.Queue(AHEAD)
        self._process = context.Process(target=_sense, args=(self._log, self._rig, self._queue), daemon=True)
        with single_threaded_children():
            self._process.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        if self._process is not None:
            self._process.terminate()
            self._process.join()
            self._queue.close()

    def __iter__(self) -> Iterator["Sensed"]:
        """
        Raises:
            SurecutError: what the front ends found wrong, or their process was killed.
        """
        while not isinstance(item := self._next(), _End):
            yield item
        self._report = item.report
        if item.error is not None:
            raise item.error
        if item.defect is not None:
            raise RuntimeError(item.defect)

    def _next(self) -> "Sensed | _End":
        assert self._process is not None
        while True:
            try:
                return self._queue.get(timeout=POLL_S)
            except queue.Empty:
                if not self._process.is_alive() and self._queue.empty():
                    raise SurecutError(
                        f"{self._log}: the process that reads it was killed (exit code {self._process.exitcode}); "
                        "is there enough memory?"
                    ) from None


def _sense(log: Path, rig: Rig, out: Any) -> None:
    """The process: reads, senses, and hands over what it saw or what went wrong."""
    import cv2

    cv2.setNumThreads(1)  # the graph has the other core
    here = SensedHere(log, rig)
    try:
        for sensed in here:
            out.put(sensed)
        out.put(_End(here.report))
    except SurecutError as error:
        out.put(_End(here.report, error))
    except Exception:
        out.put(_End(here.report, defect=traceback.format_exc()))
