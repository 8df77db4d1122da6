"""A recording as the front ends see it, read in this process.

The front ends' libraries take half a second to load. They are imported where they run.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Protocol, Self

from ..factors.rig import Rig
from ..io.reader import LogReader

if TYPE_CHECKING:
    from .sensing import Sensed, SensingReport


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
