"""One JSON line per update over TCP, for the program that moves the arm: cut points in {b}, covariance, verdict, age.

Each line is one object, see `views.json_object`. A client may send commands, one JSON object per line, and gets one
line back for each: `{"accepted": true, "text": "..."}`.
"""

import asyncio
import contextlib
import json
import socket
import threading
from collections.abc import Mapping

from .access import Access, AccessError
from .commands import MAXIMUM_COMMAND, CommandDesk
from .descriptors import keep_alive
from .interfaces import LiveImage, LiveUpdate, OnCommand
from .loop import LoopThread, Mailbox
from .outbox import Outbox
from .tally import Tally
from .views import json_object

_SENDING = 64 << 10
_CLOSE_S = 3.0
_MAXIMUM_UNAUTHORISED = 5
_MAXIMUM_MALFORMED = 100


class JsonServer:
    """A sink; any number of clients up to `maximum_clients`.

    A client that does not keep up misses lines, the oldest first. A client that sends what is no command, such as a web
    browser, is shown the door.

    Raises:
        AccessError: from `Access`.
    """

    def __init__(
        self,
        access: Access | None = None,
        port: int = 0,
        *,
        maximum_clients: int = 16,
        client_bytes: int = 1 << 20,
    ) -> None:
        self._access = access or Access()
        self._port = port
        self._maximum_clients = maximum_clients
        self._client_bytes = client_bytes
        self._tally = Tally()
        self._desk = CommandDesk(self._access, self._tally)
        self._outbox = Outbox("surecut-json", self._send, self._tally)
        self._loop = LoopThread("surecut-json-server")
        self._server: asyncio.Server | None = None
        self._lock = threading.Lock()
        self._mailboxes: dict[asyncio.StreamWriter, Mailbox] = {}
        self._gone_dropped = 0

    @property
    def name(self) -> str:
        return f"JSON lines tcp://{self._access.host}:{self._port}"

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
            self._server = self._loop.run(self._serve())
        except OSError as error:
            self._loop.stop()
            reason = error.strerror or str(error)
            raise AccessError(
                f"{self._access.host}:{self._port}: cannot listen there ({reason}); choose another port"
            ) from error
        self._port = self._server.sockets[0].getsockname()[1]
        self._outbox.start()

    def publish(self, update: LiveUpdate) -> None:
        self._outbox.publish(update)

    def image(self, image: LiveImage) -> None:
        """Images are not for this sink."""

    def stop(self) -> None:
        self._outbox.stop()
        server, self._server = self._server, None
        if server is not None:
            with contextlib.suppress(TimeoutError):  # whoever does not let go is left behind
                self._loop.run(self._close(server), _CLOSE_S)
        self._loop.stop()

    def counters(self) -> Mapping[str, int]:
        counters = dict(self._outbox.counters())
        with self._lock:
            lost = self._gone_dropped + sum(mailbox.dropped() for mailbox in self._mailboxes.values())
            counters["clients"] = len(self._mailboxes)
        if lost:
            counters["dropped"] = counters.get("dropped", 0) + lost
        return counters

    async def _serve(self) -> asyncio.Server:
        return await asyncio.start_server(self._handle, self._access.host, self._port, limit=MAXIMUM_COMMAND + 1)

    async def _close(self, server: asyncio.Server) -> None:
        server.close()
        with self._lock:
            writers = list(self._mailboxes)
        for writer in writers:
            writer.transport.abort()

    def _send(self, item: LiveUpdate | LiveImage) -> None:
        if not isinstance(item, LiveUpdate):
            return
        with self._lock:
            mailboxes = list(self._mailboxes.values())
        if mailboxes:
            line = json.dumps(json_object(item), allow_nan=False, separators=(",", ":")).encode() + b"\n"
            for mailbox in mailboxes:
                mailbox.put(line, "updates")
        self._tally.add("sent")

    async def _handle(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if len(self._mailboxes) >= self._maximum_clients:
            self._tally.add("refused_connections")
            writer.transport.abort()
            return
        connection = writer.get_extra_info("socket")
        keep_alive(connection)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SENDING)  # what waits there only grows old
        writer.transport.set_write_buffer_limits(high=_SENDING)
        mailbox = Mailbox(self._loop.loop, maximum_bytes=self._client_bytes)
        with self._lock:
            self._mailboxes[writer] = mailbox
        writing = asyncio.create_task(_write(writer, mailbox))
        reading = asyncio.create_task(self._read(reader, mailbox))
        try:
            await asyncio.wait({reading, writing}, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for task in (reading, writing):
                task.cancel()
            with self._lock:
                del self._mailboxes[writer]
                self._gone_dropped += mailbox.dropped()
            writer.transport.abort()

    async def _read(self, reader: asyncio.StreamReader, mailbox: Mailbox) -> None:
        """Commands until the client goes away, or has sent nonsense often enough."""
        malformed = unauthorised = 0
        with contextlib.suppress(OSError):
            while malformed < _MAXIMUM_MALFORMED and unauthorised < _MAXIMUM_UNAUTHORISED:
                try:
                    line = await reader.readuntil(b"\n")
                except asyncio.IncompleteReadError:
                    return
                except asyncio.LimitOverrunError:
                    self._desk.refuse("a line that is too long")
                    return
                if not line.strip():
                    continue
                if not line.lstrip().startswith(b"{"):
                    self._desk.refuse("no JSON object")
                    return
                reply = self._desk.take_json(line)
                malformed += not reply.accepted and not reply.unauthorised
                unauthorised += reply.unauthorised
                mailbox.put(json.dumps({"accepted": reply.accepted, "text": reply.text}).encode() + b"\n", "replies")


async def _write(writer: asyncio.StreamWriter, mailbox: Mailbox) -> None:
    """Send one line after the other; a client that does not read keeps only itself waiting."""
    with contextlib.suppress(OSError):
        while True:
            line = await mailbox.get()
            assert isinstance(line, bytes)
            writer.write(line)
            await writer.drain()
