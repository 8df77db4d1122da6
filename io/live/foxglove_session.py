"""One client of the Foxglove server: what it looks at, and what it sends."""

import asyncio
import json
import struct
import threading
from collections.abc import Mapping
from typing import Any, cast

from ...factors.errors import LogError
from ..decode import ChannelInfo, decoder_for
from ..schemas import PIXEL_PICK
from .commands import COMMANDS, CommandDesk
from .definitions import with_own_definition
from .interfaces import Reply
from .loop import Mailbox
from .tally import Tally

COMMAND_TOPIC = "/surecut/command"
_PUBLISH, _CALL, _CALL_REPLY = 0x01, 0x02, 0x03
_MAXIMUM_SUBSCRIPTIONS = 1024
_MAXIMUM_CHANNELS = 32
_MAXIMUM_UNAUTHORISED = 5
_WARNING = 1

SERVICES: list[dict[str, Any]] = [
    {
        "id": number,
        "name": f"/surecut/{command}",
        "type": f"surecut/{command}",
        "requestSchema": "",
        "responseSchema": "",
        "request": {
            "encoding": "json",
            "schemaName": f"surecut.{command}",
            "schemaEncoding": "jsonschema",
            "schema": '{"type": "object"}',
        },
        "response": {
            "encoding": "json",
            "schemaName": "surecut.Reply",
            "schemaEncoding": "jsonschema",
            "schema": '{"type": "object"}',
        },
    }
    for number, command in enumerate(COMMANDS, start=1)
]


class Session:
    """State of one client; `take` runs in the loop's thread, `topics` and `subscriptions` in any."""

    def __init__(
        self,
        loop: asyncio.AbstractEventLoop,
        desk: CommandDesk,
        tally: Tally,
        picks_topic: str,
        maximum_bytes: int,
    ) -> None:
        self.mailbox = Mailbox(loop, maximum_bytes=maximum_bytes)
        self._desk = desk
        self._tally = tally
        self._picks_topic = picks_topic
        self._lock = threading.Lock()
        self._subscribed: dict[int, int] = {}
        """Channel by subscription."""
        self._published: dict[int, ChannelInfo] = {}
        """The client's own channels."""
        self._unauthorised = 0

    def tell(self, **message: object) -> None:
        """Send a control message."""
        self.mailbox.put(json.dumps(message), "control", urgent=True)

    def channels(self) -> set[int]:
        """The server's channels that it looks at."""
        with self._lock:
            return set(self._subscribed.values())

    def subscriptions(self, channel: int) -> list[int]:
        """Its subscriptions to a channel."""
        with self._lock:
            return [number for number, subscribed in self._subscribed.items() if subscribed == channel]

    def take(self, frame: str | bytes) -> bool:
        """What the client sent. False: it has tried its luck with tokens often enough."""
        if isinstance(frame, str):
            self._text(frame)
        elif frame and frame[0] == _PUBLISH:
            self._message(frame)
        elif frame and frame[0] == _CALL:
            self._call(frame)
        else:
            self._malformed("a frame of no known kind")
        return self._unauthorised < _MAXIMUM_UNAUTHORISED

    def _text(self, frame: str) -> None:
        try:
            value = json.loads(frame)
        except (ValueError, RecursionError):
            value = None
        if not isinstance(value, dict):
            self._malformed("a text that is no JSON object")
            return
        fields = cast(dict[str, Any], value)
        handlers = {
            "subscribe": self._subscribe,
            "unsubscribe": self._unsubscribe,
            "advertise": self._advertise,
            "unadvertise": self._unadvertise,
        }
        handler = handlers.get(str(fields.get("op")))
        if handler is None:
            self._malformed("an operation that is not offered")
            return
        try:
            handler(fields)
        except (KeyError, TypeError, ValueError, AttributeError):
            self._malformed(f"{fields.get('op')}: not as the protocol asks for")

    def _subscribe(self, fields: Mapping[str, Any]) -> None:
        with self._lock:
            for entry in fields["subscriptions"]:
                if len(self._subscribed) < _MAXIMUM_SUBSCRIPTIONS:
                    self._subscribed[_u32(entry["id"])] = _u32(entry["channelId"])

    def _unsubscribe(self, fields: Mapping[str, Any]) -> None:
        with self._lock:
            for number in fields["subscriptionIds"]:
                self._subscribed.pop(_u32(number), None)

    def _advertise(self, fields: Mapping[str, Any]) -> None:
        for entry in fields["channels"]:
            number, topic, encoding = _u32(entry["id"]), str(entry["topic"]), str(entry["encoding"])
            if len(self._published) >= _MAXIMUM_CHANNELS or (topic, encoding) not in (
                (COMMAND_TOPIC, "json"),
                (self._picks_topic, "cdr"),
                (self._picks_topic, "json"),
            ):
                self._tally.add("refused")
                self._status(f"{topic[:80]}: only {COMMAND_TOPIC} (json) and {self._picks_topic} are taken")
                continue
            self._published[number] = ChannelInfo(topic, encoding, PIXEL_PICK, "ros2msg", b"")

    def _unadvertise(self, fields: Mapping[str, Any]) -> None:
        for number in fields["channelIds"]:
            self._published.pop(_u32(number), None)

    def _message(self, frame: bytes) -> None:
        if len(frame) < 5:
            self._malformed("a message without a channel")
            return
        (number,) = struct.unpack_from("<I", frame, 1)
        channel = self._published.get(number)
        if channel is None:
            self._malformed(f"a message on channel {number}, which was not advertised")
            return
        reply = self._carry_out(channel, frame[5:])
        if not reply.accepted:
            self._status(reply.text)

    def _carry_out(self, channel: ChannelInfo, payload: bytes) -> Reply:
        if channel.message_encoding == "json":
            return self._counted(self._desk.take_json(payload, None if channel.topic == COMMAND_TOPIC else "pick"))
        try:
            message = decoder_for(with_own_definition(channel))(payload, 0)
        except LogError as error:
            return self._desk.refuse(str(error))
        return self._counted(self._desk.take_pick(message))

    def _call(self, frame: bytes) -> None:
        if len(frame) < 13:
            self._malformed("a service call without a header")
            return
        service, call, length = struct.unpack_from("<III", frame, 1)
        encoding, payload = frame[13 : 13 + length], frame[13 + length :]
        if not 1 <= service <= len(COMMANDS) or encoding != b"json":
            self._malformed("a call of a service that is not offered, or not in JSON")
            self._fail(service, call, "no such service, or not JSON")
            return
        reply = self._counted(self._desk.take_json(payload or b"{}", COMMANDS[service - 1]))
        if not reply.accepted:
            self._fail(service, call, reply.text)
            return
        answer = json.dumps({"accepted": True, "text": reply.text}).encode()
        self.mailbox.put(struct.pack("<BIII", _CALL_REPLY, service, call, 4) + b"json" + answer, "control", urgent=True)

    def _fail(self, service: int, call: int, text: str) -> None:
        self.tell(op="serviceCallFailure", serviceId=service, callId=call, message=text)

    def _counted(self, reply: Reply) -> Reply:
        self._unauthorised += reply.unauthorised
        return reply

    def _malformed(self, text: str) -> None:
        self._tally.add("malformed")
        self._status(text)

    def _status(self, text: str) -> None:
        self.mailbox.put(json.dumps({"op": "status", "level": _WARNING, "message": text[:200]}), "status")


def _u32(value: object) -> int:
    """
    Raises:
        ValueError: it is no number that fits.
    """
    if isinstance(value, int) and not isinstance(value, bool) and 0 <= value < 1 << 32:
        return value
    raise ValueError("not an unsigned number of 32 bits")
