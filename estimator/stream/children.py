"""The three processes behind a stream and the queues between them."""

import queue
import threading
from collections.abc import Callable
from dataclasses import replace
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

from ..threads import single_threaded_children
from .forking import context
from .wire import GraphTask, Group, Order

NAMES = ("tracking", "front ends", "graph")
Heard = Callable[[object], object]


def run(what: str, *given: Any) -> None:
    """The child's work; only there its modules are loaded."""
    from .graph_process import solve
    from .look_process import look
    from .track_process import track

    {"track": track, "look": look, "solve": solve}[what](*given)


class Line:
    """From a child to its parent: written at once by the child's own thread, so that a pose waits for no other, and
    no child for a lock that another one held when it was killed."""

    def __init__(self, end: "Connection[Any, Any]") -> None:
        self._end = end

    def put(self, said: object) -> None:
        self._end.send(said)


class Children:
    """Tracking, the other front ends and the graph, each in a process of its own. They end with their parent.

    Args:
        heard: takes what they say, from a thread for each of them.
    """

    def __init__(self, task: GraphTask, heard: Heard) -> None:
        self._task = task
        self._heard = heard
        self._context = context()
        self._processes: list[BaseProcess] = []
        self._to_track: Any = None
        self._to_look: Any = None
        self._to_graph: Any = None

    def start(self, prior: Path | None) -> None:
        """Starts them.

        Args:
            prior: checkpoint that tracking and graph begin with.
        """
        settings, processes = self._task.settings, self._context
        self._to_track = processes.Queue(settings.tracking_ahead)
        self._to_look = processes.Queue(settings.looking_ahead)
        self._to_graph = processes.Queue(settings.graph_ahead)
        task, rig = replace(self._task, prior=prior), self._task.rig
        work = (
            ("track", (rig, settings, task.patient, prior, self._to_track, self._to_look)),
            ("look", (rig, settings, task.patient, self._to_look, self._to_graph)),
            ("solve", (task, self._to_graph)),
        )
        self._processes = []
        with single_threaded_children():
            for what, given in work:
                mine, theirs = processes.Pipe(duplex=False)
                process = processes.Process(target=run, args=(what, *given, Line(theirs)), daemon=True)
                process.start()
                theirs.close()
                threading.Thread(target=self._listen, args=(mine,), name="surecut-results", daemon=True).start()
                self._processes.append(process)

    def _listen(self, end: "Connection[Any, Any]") -> None:
        """Until the child is gone."""
        while True:
            try:
                said = end.recv()
            except (EOFError, OSError):
                return
            self._heard(said)

    def put(self, item: Group | Order, timeout_s: float = 0.5) -> bool:
        """Hands something to the tracking; False when they have not taken it in time."""
        try:
            self._to_track.put(item, timeout=timeout_s)
        except queue.Full:
            return False
        return True

    def backlog(self) -> int:
        """Stamps that wait for the graph."""
        if self._to_graph is None:
            return 0
        try:
            return self._to_graph.qsize()
        except NotImplementedError:  # macOS cannot tell
            return 0

    def dead(self) -> str | None:
        """What has ended although nobody asked it to."""
        for name, process in zip(NAMES, self._processes, strict=True):
            if not process.is_alive():
                return f"{name} (exit code {process.exitcode})"
        return None

    def pids(self) -> list[int]:
        return [process.pid for process in self._processes if process.pid is not None]

    def stop(self) -> None:
        """Ends them at once."""
        for process in self._processes:
            process.terminate()
        for process in self._processes:
            process.join(5.0)
        for line in (self._to_track, self._to_look, self._to_graph):
            if line is not None:
                line.cancel_join_thread()
                line.close()
