"""An asyncio loop in a thread of its own, for the servers, and what waits there for a client."""

import asyncio
import contextlib
import threading
from collections.abc import Coroutine
from typing import Any, TypeVar

from .bounded import BoundedQueue

Value = TypeVar("Value")
_END_S = 2.0


class LoopThread:
    """Runs until `stop`; everything that is handed over runs there."""

    def __init__(self, name: str) -> None:
        self.loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._stopped = False

    def start(self) -> None:
        """Begin to run."""
        self._thread.start()

    def run(self, work: Coroutine[Any, Any, Value], timeout_s: float = 10.0) -> Value:
        """The result of a coroutine that runs in the loop; its exceptions are raised here."""
        return asyncio.run_coroutine_threadsafe(work, self.loop).result(timeout_s)

    def stop(self) -> None:
        """Cancel what runs and end the thread. Twice is once."""
        if self._stopped:
            return
        self._stopped = True
        if self._thread.is_alive():
            self.loop.call_soon_threadsafe(self.loop.stop)
            self._thread.join(2 * _END_S)
        if not self._thread.is_alive():
            self.loop.close()

    def _run(self) -> None:
        asyncio.set_event_loop(self.loop)
        self.loop.run_forever()
        tasks = asyncio.all_tasks(self.loop)
        for task in tasks:
            task.cancel()
        with contextlib.suppress(Exception):
            self.loop.run_until_complete(asyncio.wait(tasks, timeout=_END_S))


class Mailbox:
    """What waits to be sent to one client: bounded, oldest dropped first, filled from any thread."""

    def __init__(self, loop: asyncio.AbstractEventLoop, maximum_count: int = 256, maximum_bytes: int = 8 << 20) -> None:
        self._queue: BoundedQueue[bytes | str] = BoundedQueue(maximum_count, maximum_bytes)
        self._loop = loop
        self._ready = asyncio.Event()
        self._told = False

    def put(self, data: bytes | str, topic: str, urgent: bool = False) -> None:
        """From any thread; never waits."""
        self._queue.put(data, topic, len(data), urgent)
        if not self._told:
            self._told = True
            with contextlib.suppress(RuntimeError):  # the loop is closed: nobody reads any more
                self._loop.call_soon_threadsafe(self._ready.set)

    async def get(self) -> bytes | str:
        """The next, when there is one."""
        while (data := self._queue.get(0)) is None:
            # in this order, so that what is put meanwhile is either seen here or tells again
            self._told = False
            self._ready.clear()
            if not len(self._queue):
                await self._ready.wait()
        return data

    def dropped(self) -> int:
        """What was lost because the client did not keep up."""
        return self._queue.dropped()
