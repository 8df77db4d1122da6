"""Work that only looks at the state, done by a copy of the process, so that nobody waits for it.

A copy (fork) sees everything as it stood at that moment, costs no time to make, and cannot change anything here. GTSAM
holds the interpreter while it works, so that a thread would not do.
"""

import contextlib
import gc
import os
import pickle
import select
import signal
import traceback
import warnings
from collections.abc import Callable
from typing import Any, Generic, TypeVar

from ..factors.errors import SurecutError

Made = TypeVar("Made")

NICENESS = 4
"""Of work that nobody waits for."""
BLOCK = 1 << 16


class Aside(Generic[Made]):
    """One piece of work at a time.

    Args:
        apart: in a copy; else at once and here, as where the system has no fork.
        niceness: below the process itself.
    """

    def __init__(self, apart: bool, niceness: int = NICENESS) -> None:
        self._apart = apart and hasattr(os, "fork")
        self._niceness = niceness
        self._pid = 0
        self._end = -1
        self._said = bytearray()
        self._result: list[Made | SurecutError] = []

    def busy(self) -> bool:
        """Is a piece of work under way, or its result not taken yet?"""
        return self._pid != 0 or bool(self._result)

    def begin(self, work: Callable[[], Made]) -> None:
        """Starts a piece of work; its result, or what it raises, must be something that can be pickled."""
        assert not self.busy()
        if not self._apart:
            self._result.append(_done(work))
            return
        self._end, theirs = os.pipe()
        self._said = bytearray()
        with warnings.catch_warnings():  # of other threads: the copy waits for nothing that they hold
            warnings.filterwarnings("ignore", ".*fork.*", DeprecationWarning)
            self._pid = os.fork()
        if self._pid == 0:
            _copy(work, theirs, self._niceness)
        os.close(theirs)

    def taken(self) -> Made | None:
        """The result, once; None while there is none.

        Raises:
            SurecutError: what the work has raised, or what it died of.
        """
        self._read()
        if not self._result:
            return None
        found = self._result.pop()
        if isinstance(found, SurecutError):
            raise found
        return found

    def awaited(self) -> Made:
        """The result of what has begun, as soon as it is there.

        Raises:
            SurecutError: what the work has raised, or what it died of.
        """
        while (found := self.taken()) is None:
            select.select([self._end], [], [])
        return found

    def stop(self) -> None:
        """Ends what is under way."""
        if self._pid:
            with contextlib.suppress(ProcessLookupError):
                os.kill(self._pid, signal.SIGKILL)
            self._close()
        self._result.clear()

    def _read(self) -> None:
        while self._pid and select.select([self._end], [], [], 0.0)[0]:
            block = os.read(self._end, BLOCK)
            self._said += block
            if not block:
                self._close()
                self._result.append(_understood(self._said))

    def _close(self) -> None:
        os.close(self._end)
        os.waitpid(self._pid, 0)
        self._pid, self._end = 0, -1


def _done(work: Callable[[], Made]) -> Made | SurecutError:
    try:
        return work()
    except SurecutError as error:
        return error
    except Exception as error:  # a defect: to be told, but no reason to end a shift
        what = traceback.extract_tb(error.__traceback__)[-1]
        return SurecutError(
            f"{type(error).__name__} in {what.name}, line {what.lineno}: {' '.join(str(error).split())}"
        )


def _copy(work: Callable[[], object], end: int, niceness: int) -> None:
    """The copy's life; it never returns."""
    try:
        os.nice(niceness)
        gc.disable()  # a search would write to all memory that is shared with the original until then
        said = pickle.dumps(_done(work))
        while said:
            said = said[os.write(end, said) :]
    finally:
        os._exit(0)  # no handlers, no buffers: they are the original's


def _understood(said: bytearray) -> Any:
    """From our own copy: nothing that comes from outside is ever unpickled."""
    return pickle.loads(said) if said else SurecutError("a copy of the process died at its work; is there memory?")
