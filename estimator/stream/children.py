"""The two processes of a stream and the queues between them."""

import multiprocessing
import queue
from dataclasses import replace
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

from ..threads import single_threaded_children
from .graph_process import GraphTask, solve
from .sense_process import sense
from .wire import Group, Order


class Children:
    """Front ends and graph, each in a process of its own. They end with their parent."""

    def __init__(self, task: GraphTask) -> None:
        self._task = task
        self._context = multiprocessing.get_context("spawn")
        self._processes: list[BaseProcess] = []
        self.out: Any = self._context.Queue()
        """What both say."""
        self._to_sense: Any = None
        self._to_graph: Any = None

    def start(self, prior: Path | None) -> None:
        """Starts both.

        Args:
            prior: checkpoint that the graph begins with.
        """
        settings = self._task.settings
        self._to_sense = self._context.Queue(settings.sensing_ahead)
        self._to_graph = self._context.Queue(settings.graph_ahead)
        task = replace(self._task, prior=prior)
        self._processes = [
            self._context.Process(
                target=sense, args=(task.rig, settings, self._to_sense, self._to_graph, self.out), daemon=True
            ),
            self._context.Process(target=solve, args=(task, self._to_graph, self.out), daemon=True),
        ]
        with single_threaded_children():
            for process in self._processes:
                process.start()

    def put(self, item: Group | Order, timeout_s: float = 0.5) -> bool:
        """Hands something to the front ends; False when they have not taken it in time."""
        try:
            self._to_sense.put(item, timeout=timeout_s)
        except queue.Full:
            return False
        return True

    def backlog(self) -> int:
        """Stamps that wait for the graph."""
        try:
            return self._to_graph.qsize()
        except NotImplementedError:  # macOS cannot tell
            return 0

    def dead(self) -> str | None:
        """What has ended although nobody asked it to."""
        names = ("front ends", "graph")
        for name, process in zip(names, self._processes, strict=True):
            if not process.is_alive():
                return f"{name} (exit code {process.exitcode})"
        return None

    def pids(self) -> list[int]:
        return [process.pid for process in self._processes if process.pid is not None]

    def stop(self) -> None:
        """Ends both at once."""
        for process in self._processes:
            process.terminate()
        for process in self._processes:
            process.join(5.0)
        for line in (self._to_sense, self._to_graph):
            if line is not None:
                line.cancel_join_thread()
                line.close()
