"""What sources with a link of their own share: one thread that opens it, reads until it breaks, and opens it again."""

import threading
from abc import ABC, abstractmethod
from collections.abc import Mapping

from .backoff import Backoff
from .intake import Intake
from .interfaces import Deliver

CONNECT_S = 5.0


class ThreadedSource(ABC):
    """A source whose thread runs from `start` to `stop`, or to the end of a link that cannot be opened again.

    Args:
        thread_name: of the thread, for debuggers.
        intake: what is read goes through it.
        reopens: whether a link that ended is opened again.
        patient: see `interfaces.Source`.
    """

    def __init__(self, thread_name: str, intake: Intake, *, reopens: bool = True, patient: bool = False) -> None:
        self._intake = intake
        self._thread_name = thread_name
        self._reopens = reopens
        self._patient = patient
        self._stopping = threading.Event()
        self._finished = threading.Event()
        self._connected = False
        self._status = "not started"
        self._thread: threading.Thread | None = None

    @property
    @abstractmethod
    def name(self) -> str:
        """What it reads from, in words."""

    @abstractmethod
    def _visit(self, backoff: Backoff) -> str:
        """Opens the link, calls `_opened`, and reads until it ends; returns why it did.

        Args:
            backoff: is told when the link was of use.
        """

    @property
    def patient(self) -> bool:
        return self._patient

    def start(self, deliver: Deliver) -> None:
        self._intake.open(deliver)
        self._thread = threading.Thread(target=self._run, name=self._thread_name, daemon=True)
        self._thread.start()

    def stop(self) -> None:
        self._stopping.set()
        self._intake.close()
        if self._thread is not None:
            self._thread.join(CONNECT_S + 1)
        self._finished.set()

    def ended(self) -> bool:
        return self._finished.is_set()

    def connected(self) -> bool:
        return self._connected

    def status(self) -> str:
        problem = self._intake.last_problem()
        return f"{self.name}: {self._status}" + (f"; last problem: {problem}" if problem else "")

    def counters(self) -> Mapping[str, int]:
        return self._intake.counters()

    def by_topic(self) -> Mapping[str, Mapping[str, int]]:
        return self._intake.by_topic()

    def _opened(self) -> None:
        self._connected, self._status = True, "connected"

    def _run(self) -> None:
        backoff = Backoff()
        while not self._stopping.is_set():
            try:
                self._status = self._visit(backoff)
            except Exception as error:  # whatever a stranger's bytes provoke must not end the source
                self._intake.tally.add("errors")
                self._status = f"{type(error).__name__}: {error}"
            self._connected = False
            if not self._reopens or backoff.wait(self._stopping):
                break
            self._intake.tally.add("reconnects")
        self._finished.set()
