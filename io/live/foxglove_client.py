"""A client of any Foxglove WebSocket server, such as foxglove_bridge on a robot with any middleware."""

import json
import struct
import time
from typing import Any, cast
from urllib.parse import urlsplit

from websockets.exceptions import ConnectionClosed, InvalidHandshake, InvalidURI
from websockets.sync.client import ClientConnection, connect
from websockets.typing import Subprotocol

from ...factors.errors import LogError
from ..decode import ChannelInfo
from .admission import Expected, Limits, plain_topic
from .backoff import Backoff
from .intake import Intake
from .interfaces import Clock
from .threaded_source import CONNECT_S, ThreadedSource

SUBPROTOCOLS = (Subprotocol("foxglove.sdk.v1"), Subprotocol("foxglove.websocket.v1"))
MESSAGE_DATA = 0x01
_DATA_HEADER = struct.Struct("<BIQ")
_MAXIMUM_TEXT = 4 << 20
_OVERHEAD = 64
_LOOK_S = 0.2
VIOLATIONS = {1002: "malformed", 1007: "malformed", 1009: "oversized"}
"""Why this side ended a connection, by WebSocket's code: protocol error, no UTF-8, too large."""


class FoxgloveClient(ThreadedSource):
    """A source that subscribes to the wanted topics as they are advertised, and connects again when it has to.

    Args:
        url: `ws://HOST:PORT` or `wss://HOST:PORT`.
    """

    def __init__(
        self,
        url: str,
        expected: Expected | None = None,
        *,
        limits: Limits | None = None,
        clock: Clock = time.time_ns,
    ) -> None:
        if urlsplit(url).scheme not in ("ws", "wss") or not urlsplit(url).hostname:
            raise LogError(f"{url}: is no address of a Foxglove WebSocket server; give ws://HOST:PORT")
        self._url = url
        super().__init__("surecut-foxglove-client", Intake(clock, expected, limits))
        self._channels: dict[int, ChannelInfo] = {}
        """By subscription, whose number is the channel's own."""

    @property
    def name(self) -> str:
        return f"Foxglove server {self._url}"

    def _visit(self, backoff: Backoff) -> str:
        try:
            with self._connect() as connection:
                self._opened()
                backoff.succeeded()
                self._read(connection)
            return "the server ended the connection"
        except ConnectionClosed as error:
            if error.sent is not None and not error.rcvd_then_sent and error.sent.code in VIOLATIONS:
                self._intake.refuse(VIOLATIONS[error.sent.code], None, str(error))
            return f"connection lost ({error})"
        except (OSError, InvalidHandshake, InvalidURI, EOFError) as error:
            return f"cannot connect ({error})"

    def _connect(self) -> ClientConnection:
        self._channels.clear()
        self._intake.forget_senders()
        return connect(
            self._url,
            subprotocols=SUBPROTOCOLS,
            compression=None,  # nothing to unpack, so nothing that unpacks to more than the limit
            max_size=self._intake.limits.message_bytes + _OVERHEAD,
            open_timeout=CONNECT_S,
            close_timeout=1.0,
            ping_interval=4.0,
            ping_timeout=6.0,
            proxy=None,  # a robot is reached directly
        )

    def _read(self, connection: ClientConnection) -> None:
        while not self._stopping.is_set():
            try:
                frame = connection.recv(timeout=_LOOK_S)
            except TimeoutError:
                continue
            if isinstance(frame, str):
                self._text(connection, frame)
            else:
                self._binary(frame)

    def _binary(self, frame: bytes) -> None:
        if not frame or frame[0] != MESSAGE_DATA:
            if not frame:
                self._intake.refuse("malformed", None, "an empty frame")
            return  # times and replies, which nobody here asked for
        if len(frame) < _DATA_HEADER.size:
            self._intake.refuse("malformed", None, f"a message of {len(frame)} bytes has no header")
            return
        _, number, sent_ns = _DATA_HEADER.unpack_from(frame)
        channel = self._channels.get(number)
        if channel is None:
            self._intake.refuse("malformed", None, f"a message for subscription {number}, which does not exist")
            return
        self._intake.take(channel, frame[_DATA_HEADER.size :], str(number), sent_ns)

    def _text(self, connection: ClientConnection, frame: str) -> None:
        try:
            value = json.loads(frame) if len(frame) <= _MAXIMUM_TEXT else None
        except (ValueError, RecursionError):
            value = None
        if not isinstance(value, dict):
            self._intake.refuse("malformed", None, "a text that is no JSON object")
            return
        if value.get("op") == "advertise":
            self._advertised(connection, value.get("channels"))
        elif value.get("op") == "unadvertise":
            ids = value.get("channelIds")
            for number in ids if isinstance(ids, list) else []:
                self._channels.pop(number if isinstance(number, int) else -1, None)

    def _advertised(self, connection: ClientConnection, channels: object) -> None:
        wanted = []
        described = [_channel(value) for value in (channels if isinstance(channels, list) else [None])]
        topics = {found[1].topic for found in described if found is not None and self._intake.wanted(found[1].topic)}
        topics |= {channel.topic for channel in self._channels.values()}
        for found in described:
            if found is None:
                self._intake.refuse("malformed", None, "a channel that is not described as the protocol asks for")
                continue
            number, channel = found
            plain = plain_topic(channel.topic)
            if plain != channel.topic and plain in topics:
                continue  # the same image once is enough
            if len(self._channels) < self._intake.limits.channels and self._intake.accepts(channel):
                self._channels[number] = channel
                wanted.append({"id": number, "channelId": number})
        if wanted:
            connection.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))


def _channel(value: object) -> tuple[int, ChannelInfo] | None:
    """Number and description of an advertised channel; None when it is none."""
    if not isinstance(value, dict):
        return None
    fields = cast(dict[str, Any], value)
    number = fields.get("id")
    names = [fields.get(key, "") for key in ("topic", "encoding", "schemaName", "schema")]
    if not (isinstance(number, int) and 0 <= number < 1 << 32 and all(isinstance(name, str) for name in names)):
        return None
    topic, encoding, schema_name, schema = names
    implied = {"cdr": "ros2msg", "protobuf": "protobuf", "json": "jsonschema"}
    schema_encoding = fields.get("schemaEncoding") or implied.get(encoding, "")
    if not isinstance(schema_encoding, str) or not topic:
        return None
    # a protobuf schema is base64 text here; it is not looked at, see `definitions`
    return number, ChannelInfo(topic, encoding, schema_name, schema_encoding, schema.encode(errors="replace"))
