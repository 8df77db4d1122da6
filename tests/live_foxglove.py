"""A small Foxglove viewer and a small Foxglove server, written from the protocol alone, for tests."""

import contextlib
import json
import struct
import threading
import time
from typing import Any

from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect
from websockets.sync.server import ServerConnection, serve


class Viewer:
    """Connects, reads everything in a thread, and keeps it."""

    def __init__(self, port: int, subprotocol: str = "foxglove.sdk.v1", **options: Any) -> None:
        self._stack = contextlib.ExitStack()
        self.connection = self._stack.enter_context(
            connect(
                f"ws://127.0.0.1:{port}",
                subprotocols=[subprotocol],
                compression=None,
                proxy=None,
                max_size=None,
                close_timeout=1.0,
                **options,
            )
        )
        self.texts: list[dict[str, Any]] = []
        self.data: list[tuple[int, int, bytes]] = []
        self.replies: list[tuple[int, int, dict[str, Any]]] = []
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def _read(self) -> None:
        with contextlib.suppress(ConnectionClosed):
            self._read_all()

    def _read_all(self) -> None:
        for frame in self.connection:
            if isinstance(frame, str):
                self.texts.append(json.loads(frame))
            elif frame[0] == 1:
                _, number, stamp = struct.unpack_from("<BIQ", frame)
                self.data.append((number, stamp, frame[13:]))
            elif frame[0] == 3:
                _, service, call, length = struct.unpack_from("<BIII", frame)
                self.replies.append((service, call, json.loads(frame[13 + length :])))

    def of(self, op: str) -> list[dict[str, Any]]:
        return [text for text in list(self.texts) if text["op"] == op]

    def channels(self) -> dict[str, dict[str, Any]]:
        return {channel["topic"]: channel for text in self.of("advertise") for channel in text["channels"]}

    def send(self, **message: Any) -> None:
        self.connection.send(json.dumps(message))

    def subscribe(self, **topics: str) -> None:
        """Subscription number by topic: `n5="/tf"`."""
        channels = self.channels()
        entries = [{"id": int(key[1:]), "channelId": channels[topic]["id"]} for key, topic in topics.items()]
        self.send(op="subscribe", subscriptions=entries)

    def call(self, service: int, value: Any, call: int = 1) -> None:
        payload = value if isinstance(value, bytes) else json.dumps(value).encode()
        self.connection.send(struct.pack("<BIII", 2, service, call, 4) + b"json" + payload)

    def close(self) -> None:
        self._stack.close()
        self._thread.join(5)

    def __enter__(self) -> "Viewer":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class Robot:
    """A server that advertises the given channels, and sends to every subscription what it is told to."""

    def __init__(self, channels: list[dict[str, Any]], port: int = 0) -> None:
        self.advertise = {"op": "advertise", "channels": channels}
        self.subscribed: dict[int, int] = {}
        """Subscription by channel."""
        self.connections: list[ServerConnection] = []
        self._server = serve(
            self._handle,
            "127.0.0.1",
            port,
            subprotocols=["foxglove.websocket.v1"],  # pyright: ignore[reportArgumentType]
            compression=None,
            max_size=None,
        )
        self.port = self._server.socket.getsockname()[1]
        self._thread = threading.Thread(target=self._server.serve_forever, daemon=True)
        self._thread.start()

    def _handle(self, connection: ServerConnection) -> None:
        self.connections.append(connection)
        connection.send(json.dumps({"op": "serverInfo", "name": "robot", "capabilities": []}))
        connection.send(json.dumps(self.advertise))
        for frame in connection:
            message = json.loads(frame)
            for entry in message.get("subscriptions", []):
                self.subscribed[entry["channelId"]] = entry["id"]

    def publish(self, channel: int, payload: bytes, stamp_ns: int = 0) -> None:
        self.raw(struct.pack("<BIQ", 1, self.subscribed[channel], stamp_ns or time.time_ns()) + payload)

    def raw(self, frame: bytes | str) -> None:
        self.connections[-1].send(frame)

    def close(self) -> None:
        for connection in self.connections:
            connection.close()
        self._server.shutdown()
        self._thread.join(5)

    def __enter__(self) -> "Robot":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
