"""What servers in an asyncio loop share: a thread for the loop, an outbox, one mailbox for each client, commands."""

import contextlib
import threading
from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Generic, TypeVar

from .access import Access, cannot_listen
from .commands import CommandDesk
from .interfaces import LiveImage, LiveUpdate, OnCommand
from .loop import LoopThread, Mailbox
from .outbox import Outbox, ThroughOutbox
from .tally import Tally

Listener = TypeVar("Listener")
_CLOSE_S = 3.0


class LoopServer(ThroughOutbox, ABC, Generic[Listener]):
    """A sink that clients connect to.

    Args:
        images: whether it sends images on.

    Raises:
        AccessError: from `Access`.
    """

    def __init__(self, name: str, access: Access | None, port: int, *, images: bool, maximum_clients: int) -> None:
        self._access = access or Access()
        self._port = port
        self._maximum_clients = maximum_clients
        self._tally = Tally()
        self._desk = CommandDesk(self._access, self._tally)
        self._outbox = Outbox(name, self._send, self._tally, images=images)
        self._loop = LoopThread(f"{name}-server")
        self._server: Listener | None = None
        self._lock = threading.Lock()
        """Over the clients."""
        self._gone_dropped = 0
        """What clients that left had lost."""

    @property
    @abstractmethod
    def name(self) -> str:
        """What it is and where it listens."""

    @abstractmethod
    async def _listen(self) -> tuple[Listener, int]:
        """Begins to listen; the server and its port."""

    @abstractmethod
    async def _end(self, server: Listener) -> None:
        """Lets go of everybody."""

    @abstractmethod
    def _send(self, item: LiveUpdate | LiveImage) -> None:
        """In the outbox's thread: into the mailboxes of those who want it."""

    @abstractmethod
    def _waiting(self) -> list[Mailbox]:
        """Each client's mailbox; the lock is held."""

    @property
    def port(self) -> int:
        """Where it listens."""
        return self._port

    def start(self, on_command: OnCommand | None = None) -> None:
        """
        Raises:
            AccessError: the address is in use or is none of this machine.
        """
        self._desk.open(on_command)
        self._loop.start()
        try:
            self._server, self._port = self._loop.run(self._listen())
        except OSError as error:
            self._loop.stop()
            raise cannot_listen(self._access.host, self._port, error) from error
        self._outbox.start()

    def stop(self) -> None:
        self._outbox.stop()
        server, self._server = self._server, None
        if server is not None:
            with contextlib.suppress(TimeoutError):  # whoever does not let go is left behind
                self._loop.run(self._end(server), _CLOSE_S)
        self._loop.stop()

    def counters(self) -> Mapping[str, int]:
        counters = dict(self._outbox.counters())
        with self._lock:
            mailboxes = self._waiting()
            lost = self._gone_dropped + sum(mailbox.dropped() for mailbox in mailboxes)
        counters["clients"] = len(mailboxes)
        if lost:
            counters["dropped"] = counters.get("dropped", 0) + lost
        return counters
