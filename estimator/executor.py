"""Many independent tasks: one after another, on the cores of this machine, or on a Dask cluster.

A task is a function that can be pickled; it takes one item and returns a value. A task that fails, or that takes its
process down with it, is an outcome with its reason and does not stop the others.
"""

import importlib
import multiprocessing
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

from ..factors.errors import SurecutError
from .threads import single_threaded_children

Item = TypeVar("Item")
Value = TypeVar("Value")

ATTEMPTS = 2
"""A task whose process died is tried once more: another task in the pool may have been the cause."""


@dataclass(frozen=True, slots=True)
class Outcome(Generic[Item, Value]):
    """What became of one item: a value, or the reason why there is none."""

    item: Item
    value: Value | None
    error: str | None


class Executor(Protocol):
    """Runs a task over items; outcomes come as they are done, in any order."""

    def run(self, task: Callable[[Item], Value], items: Sequence[Item]) -> Iterator[Outcome[Item, Value]]: ...


@dataclass(frozen=True, slots=True)
class SerialExecutor:
    """One after another in this process."""

    def run(self, task: Callable[[Item], Value], items: Sequence[Item]) -> Iterator[Outcome[Item, Value]]:
        for item in items:
            yield _attempt(task, item)


@dataclass(frozen=True, slots=True)
class ProcessExecutor:
    """On this machine, one single-threaded process per job."""

    jobs: int

    def run(self, task: Callable[[Item], Value], items: Sequence[Item]) -> Iterator[Outcome[Item, Value]]:
        waiting = deque((item, 1) for item in items)
        suspects: deque[tuple[Item, int]] = deque()
        while waiting or suspects:
            # A process that dies breaks its whole pool. What was under way is tried again, each item alone, so that
            # none is blamed for another's crash; a new pool goes on with the rest.
            yield from self._run_pool(task, deque([suspects.popleft()]) if suspects else waiting, suspects)

    def _run_pool(
        self, task: Callable[[Item], Value], waiting: deque[tuple[Item, int]], suspects: deque[tuple[Item, int]]
    ) -> Iterator[Outcome[Item, Value]]:
        context = multiprocessing.get_context("spawn")
        with single_threaded_children(), ProcessPoolExecutor(self.jobs, mp_context=context) as pool:
            running: dict[Future[Outcome[Item, Value]], tuple[Item, int]] = {}
            try:
                while waiting or running:
                    while waiting and len(running) < self.jobs:
                        # taken out only once it is handed over: a pool that broke meanwhile refuses it
                        running[pool.submit(_attempt, task, waiting[0][0])] = waiting[0]
                        waiting.popleft()
                    done, _ = wait(running, return_when=FIRST_COMPLETED)
                    for future in done:
                        outcome = future.result()
                        running.pop(future)
                        yield outcome
            except BrokenProcessPool:
                yield from _give_back(running, suspects)
            finally:
                pool.shutdown(wait=False, cancel_futures=True)


@dataclass(frozen=True, slots=True)
class DaskExecutor:
    """On a Dask cluster that exists, by its scheduler's address. Its workers need surecut installed."""

    address: str
    timeout_s: float = 10.0

    def run(self, task: Callable[[Item], Value], items: Sequence[Item]) -> Iterator[Outcome[Item, Value]]:
        """Raises SurecutError when Dask is not installed or the scheduler does not answer."""
        try:
            distributed = importlib.import_module("distributed")
        except ImportError as error:
            raise SurecutError("--dask needs the package distributed; install surecut[cluster]") from error
        try:
            client = distributed.Client(self.address, timeout=self.timeout_s, set_as_default=False)
        except (OSError, ValueError) as error:
            raise SurecutError(f"{self.address}: no Dask scheduler answers there; check address and port") from error
        with client:
            futures = {client.submit(_attempt, task, item, pure=False, retries=0): item for item in items}
            for future in distributed.as_completed(list(futures), loop=client.loop, raise_errors=False):
                item = futures.pop(future)
                if future.status == "finished":
                    yield future.result()
                else:
                    yield Outcome(item, None, f"the cluster gave the task up ({future.status})")
                future.release()


def choose_executor(jobs: int = 1, dask: str | None = None) -> Executor:
    """The executor that the options `--jobs` and `--dask` ask for."""
    if dask is not None:
        return DaskExecutor(dask)
    return ProcessExecutor(jobs) if jobs > 1 else SerialExecutor()


def _attempt(task: Callable[[Item], Value], item: Item) -> Outcome[Item, Value]:
    try:
        return Outcome(item, task(item), None)
    except SurecutError as error:
        return Outcome(item, None, str(error))
    except Exception as error:  # a row with its reason, whatever it was
        return Outcome(item, None, f"{type(error).__name__}: {' '.join(str(error).split())}")


def _give_back(
    running: dict[Future[Outcome[Item, Value]], tuple[Item, int]], waiting: deque[tuple[Item, int]]
) -> Iterator[Outcome[Item, Value]]:
    """What was under way when a process died: tried again, or given up."""
    for future, (item, attempt) in running.items():
        if future.done() and future.exception() is None:
            yield future.result()
        elif attempt < ATTEMPTS:
            waiting.append((item, attempt + 1))
        else:
            yield Outcome(item, None, "its process died (killed, or a crash in a native library)")
