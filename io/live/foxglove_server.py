"""A Foxglove WebSocket server: shows the estimate in Foxglove and Lichtblick, and takes the operator's commands.

Speaks `foxglove.sdk.v1` and the older `foxglove.websocket.v1`. Commands arrive as service calls (`/surecut/pick`,
`/surecut/reset`, `/surecut/freeze`, `/surecut/save`), as JSON messages on `/surecut/command`, or as a pick on `/picks`.
"""

import asyncio
import logging
import re
import struct
from collections.abc import Sequence
from typing import Any, cast

from websockets.asyncio.server import Server, ServerConnection, serve
from websockets.exceptions import ConnectionClosed
from websockets.typing import Origin

from .access import Access
from .foxglove_client import MESSAGE_DATA, SUBPROTOCOLS, VIOLATIONS
from .foxglove_session import SERVICES, Session
from .foxglove_views import View, description, image_views, views_of
from .interfaces import LiveImage, LiveUpdate
from .loop import Mailbox
from .loop_server import LoopServer

MAXIMUM_INBOUND = 64 << 10
_ORIGINS: tuple[Origin | re.Pattern[str] | None, ...] = (
    None,  # programs; browsers always name an origin
    Origin("https://app.foxglove.dev"),
    Origin("file://"),
    re.compile(r"https?://(localhost|127\.0\.0\.1|\[::1\])(:\d+)?"),
)
_QUIET = logging.Logger("surecut.live", logging.CRITICAL + 1)
"""Strangers' failed handshakes are counted, not printed."""


class FoxgloveServer(LoopServer[Server]):
    """A sink that any number of viewers (up to `maximum_clients`) may look at.

    Web pages of other origins than the viewers' cannot connect, so that a browser on this machine is no way in.

    Args:
        access: address, and what commands need.
        port: 0 for any free one; see `port`.
        origins: further web origins that may connect, such as `https://viewer.site.example`.
        picks_topic: where picks may be published as `surecut_msgs/msg/PixelPick`.

    Raises:
        AccessError: from `Access`.
    """

    def __init__(
        self,
        access: Access | None = None,
        port: int = 8765,
        *,
        origins: Sequence[str] = (),
        picks_topic: str = "/picks",
        maximum_clients: int = 16,
        client_bytes: int = 8 << 20,
    ) -> None:
        super().__init__("surecut-foxglove", access, port, images=True, maximum_clients=maximum_clients)
        self._origins = [*_ORIGINS, *(Origin(origin) for origin in origins)]
        self._picks_topic = picks_topic
        self._client_bytes = client_bytes
        self._channels: dict[str, dict[str, Any]] = {}
        """By topic, as advertised."""
        self._sessions: dict[ServerConnection, Session] = {}
        self._open = 0
        """Connections, those that have not said anything yet included; of the loop's thread."""

    @property
    def name(self) -> str:
        return f"Foxglove server ws://{self._access.host}:{self._port}"

    def _waiting(self) -> list[Mailbox]:
        return [session.mailbox for session in self._sessions.values()]

    async def _listen(self) -> tuple[Server, int]:
        server = await self._serve()
        return server, next(iter(server.sockets)).getsockname()[1]

    async def _serve(self) -> Server:
        return await serve(
            self._handle,
            self._access.host,
            self._port,
            subprotocols=SUBPROTOCOLS,
            origins=self._origins,
            compression=None,
            max_size=MAXIMUM_INBOUND,
            max_queue=8,
            open_timeout=3.0,
            ping_interval=10.0,
            ping_timeout=20.0,
            close_timeout=1.0,
            server_header=None,
            logger=_QUIET,
            create_connection=self._connection_class(),
        )

    def _connection_class(self) -> type[ServerConnection]:
        """Connections that are dropped at once when there are too many, before they cost anything."""
        server = self

        class Counted(ServerConnection):
            refused = False

            def connection_made(self, transport: asyncio.BaseTransport) -> None:
                server._open += 1
                self.refused = server._open > 2 * server._maximum_clients
                if self.refused:
                    server._tally.add("refused_connections")
                    cast(asyncio.Transport, transport).abort()
                else:
                    super().connection_made(transport)

            def connection_lost(self, exc: Exception | None) -> None:
                server._open -= 1
                if not self.refused:
                    super().connection_lost(exc)

            def data_received(self, data: bytes) -> None:
                if not self.refused:
                    super().data_received(data)

        return Counted

    async def _end(self, server: Server) -> None:
        server.close()
        await server.wait_closed()

    async def _handle(self, connection: ServerConnection) -> None:
        if connection.subprotocol is None or len(self._sessions) >= self._maximum_clients:
            self._tally.add("refused_connections")
            await connection.close(1013 if connection.subprotocol else 1002)
            return
        session = Session(self._loop.loop, self._desk, self._tally, self._picks_topic, self._client_bytes)
        with self._lock:
            self._greet(session)
            self._sessions[connection] = session
        writing = asyncio.create_task(_write(connection, session))
        try:
            async for frame in connection:
                if not session.take(frame):
                    await connection.close(1008, "too many commands without the token")
        except ConnectionClosed as error:
            self._count_violation(error)
        finally:
            writing.cancel()
            with self._lock:
                del self._sessions[connection]
                self._gone_dropped += session.mailbox.dropped()

    def _count_violation(self, error: ConnectionClosed) -> None:
        """What a client sent that made this side end the connection."""
        reason = VIOLATIONS.get(error.sent.code) if error.sent is not None and not error.rcvd_then_sent else None
        if reason is not None:
            self._tally.add(reason)

    def _greet(self, session: Session) -> None:
        commands = self._access.takes_commands
        session.tell(
            op="serverInfo",
            name="surecut",
            capabilities=["clientPublish", "services"] if commands else [],
            supportedEncodings=["json", "cdr"],
            metadata={},
        )
        session.tell(op="advertise", channels=list(self._channels.values()))
        if commands:
            session.tell(op="advertiseServices", services=SERVICES)

    def _send(self, item: LiveUpdate | LiveImage) -> None:
        """In the outbox's thread: encode once what somebody looks at, and put it into their mailboxes."""
        views = list(views_of(item) if isinstance(item, LiveUpdate) else image_views(item))
        self._advertise(views)
        with self._lock:
            sessions = list(self._sessions.values())
        watched = {number for session in sessions for number in session.channels()}
        for view in views:
            number = self._channels[view.topic]["id"]
            if number not in watched:
                continue
            payload = view.encode()
            for session in sessions:
                for subscription in session.subscriptions(number):
                    head = struct.pack("<BIQ", MESSAGE_DATA, subscription, max(view.stamp_ns, 0))
                    session.mailbox.put(head + payload, view.topic)
        self._tally.add("sent")

    def _advertise(self, views: list[View]) -> None:
        """Channels appear with their first message."""
        new = [view for view in views if view.topic not in self._channels]
        if not new:
            return
        with self._lock:
            added = []
            for view in new:
                channel = {"id": len(self._channels) + 1, "topic": view.topic, **description(view.schema_name)}
                self._channels[view.topic] = channel
                added.append(channel)
            for session in self._sessions.values():
                session.tell(op="advertise", channels=added)


async def _write(connection: ServerConnection, session: Session) -> None:
    """Send one after the other; a client that does not read keeps only itself waiting."""
    try:
        while True:
            await connection.send(await session.mailbox.get())
    except ConnectionClosed:
        pass
