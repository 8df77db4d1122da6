"""One JSON line per update over TCP, for the program that moves the arm: cut points in {b}, covariance, verdict, age.

Each line is one object, see `views.json_object`. A client may send commands, one JSON object per line, and gets one
line back for each: `{"accepted": true, "text": "..."}`.
"""

import asyncio
import contextlib
import json
import socket

from .access import Access
from .commands import MAXIMUM_COMMAND
from .descriptors import keep_alive
from .interfaces import LiveImage, LiveUpdate
from .loop import Mailbox
from .loop_server import LoopServer
from .views import json_object

_SENDING = 64 << 10
_MAXIMUM_UNAUTHORISED = 5
_MAXIMUM_MALFORMED = 100


class JsonServer(LoopServer[asyncio.Server]):
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
        super().__init__("surecut-json", access, port, images=False, maximum_clients=maximum_clients)
        self._client_bytes = client_bytes
        self._mailboxes: dict[asyncio.StreamWriter, Mailbox] = {}

    @property
    def name(self) -> str:
        return f"JSON lines tcp://{self._access.host}:{self._port}"

    def _waiting(self) -> list[Mailbox]:
        return list(self._mailboxes.values())

    async def _listen(self) -> tuple[asyncio.Server, int]:
        server = await asyncio.start_server(self._handle, self._access.host, self._port, limit=MAXIMUM_COMMAND + 1)
        return server, server.sockets[0].getsockname()[1]

    async def _end(self, server: asyncio.Server) -> None:
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
