"""Commands of the operator, as JSON: `{"command": "pick", "camera": "m_left", "point_id": "P1", ...}`."""

import json
import re
from collections.abc import Mapping
from typing import Any, cast

from ...factors.errors import SurecutError
from ..messages import Message, PickBody
from .access import Access
from .interfaces import Command, Freeze, OnCommand, Pick, Reply, Reset, Save
from .tally import Tally

MAXIMUM_COMMAND = 4096
CAMERAS = ("m_left", "m_right", "b_rgb")
ROLES = ("cut", "grasp", "other")
COMMANDS = ("pick", "reset", "freeze", "save")
_NAME = re.compile(r"[\w.:\-]{1,64}")
_FIELDS = {
    "pick": {"camera", "point_id", "role", "u", "v", "stamp_ns", "sigma_px"},
    "reset": set[str](),
    "freeze": {"frozen"},
    "save": set[str](),
}


class CommandError(SurecutError):
    """What came is no command."""


def command_of(value: Mapping[str, Any], kind: str | None = None) -> Command:
    """A command from its JSON object.

    Args:
        kind: where the transport says which command it is; else the field `command` does.

    Raises:
        CommandError: a field is missing, unknown, of another type or out of range.
    """
    kind = value.get("command") if kind is None else kind
    if not isinstance(kind, str) or kind not in COMMANDS:
        raise CommandError(f"no such command; known: {', '.join(COMMANDS)}")
    unknown = set(value) - _FIELDS[kind] - {"command", "token"}
    if unknown:
        raise CommandError(f"{kind}: unknown field {min(map(str, unknown))[:40]!r}")
    if kind == "pick":
        return _pick(value)
    if kind == "freeze":
        frozen = value.get("frozen", True)
        if not isinstance(frozen, bool):
            raise CommandError("freeze: `frozen` is true or false")
        return Freeze(frozen)
    return Reset() if kind == "reset" else Save()


def pick_of(message: Message) -> Pick:
    """The same from a `surecut_msgs/msg/PixelPick` message.

    Raises:
        CommandError: as `command_of`.
    """
    body = message.body
    if not isinstance(body, PickBody):
        raise CommandError("not a pick")
    u, v = (float(value) for value in body.px)
    fields = {
        "camera": body.camera,
        "point_id": body.point_id,
        "role": body.role,
        "u": u,
        "v": v,
        "stamp_ns": max(message.stamp_ns, 0),
        "sigma_px": body.sigma_px,
    }
    return _pick(fields)


def _pick(value: Mapping[str, Any]) -> Pick:
    camera, point_id, role = value.get("camera"), value.get("point_id"), value.get("role", "cut")
    if camera not in CAMERAS:
        raise CommandError(f"pick: `camera` is one of {', '.join(CAMERAS)}")
    if not isinstance(point_id, str) or not _NAME.fullmatch(point_id):
        raise CommandError("pick: `point_id` is a name of at most 64 letters, digits, and . : - _")
    if role not in ROLES:
        raise CommandError(f"pick: `role` is one of {', '.join(ROLES)}")
    stamp_ns = value.get("stamp_ns", 0)
    if type(stamp_ns) is not int or not 0 <= stamp_ns < 1 << 63:
        raise CommandError("pick: `stamp_ns` is the image's stamp, or 0 for the newest image")
    u, v = _number(value, "u", -100.0, 1e5), _number(value, "v", -100.0, 1e5)
    sigma_px = _number({"sigma_px": 2.0, **value}, "sigma_px", 0.05, 100.0)
    return Pick(cast(str, camera), point_id, cast(str, role), (u, v), stamp_ns, sigma_px)


def _number(value: Mapping[str, Any], name: str, low: float, high: float) -> float:
    number = value.get(name)
    if isinstance(number, bool) or not isinstance(number, int | float):
        raise CommandError(f"pick: `{name}` is a number")
    if not low <= number <= high:  # nor is NaN
        raise CommandError(f"pick: `{name}` is between {low:g} and {high:g}")
    return float(number)


class CommandDesk:
    """Where the inbound sides of all sinks bring what came in: checks size, form and token, counts, answers."""

    def __init__(self, access: Access, tally: Tally) -> None:
        self._access = access
        self._tally = tally
        self._on_command: OnCommand | None = None

    def open(self, on_command: OnCommand | None) -> None:
        """Who carries commands out; None: nobody."""
        self._on_command = on_command

    def take_json(self, data: str | bytes, kind: str | None = None) -> Reply:
        """One command as JSON text. Never raises."""
        try:
            if len(data) > MAXIMUM_COMMAND:
                raise CommandError(f"a command of {len(data)} bytes")
            value = json.loads(data)
            if not isinstance(value, dict):
                raise CommandError("a command is a JSON object")
        except (ValueError, RecursionError) as error:
            return self._malformed(f"not JSON ({error})")
        except CommandError as error:
            return self._malformed(str(error))
        fields = cast(dict[str, Any], value)
        if not self._access.authorises(fields.get("token")):
            return self._unauthorised()
        try:
            return self._carry_out(command_of(fields, kind))
        except CommandError as error:
            return self._malformed(str(error))

    def take_pick(self, message: Message) -> Reply:
        """A pick that came as a ROS message, which cannot bring a token along. Never raises."""
        if not self._access.authorises(None):
            return self._unauthorised()
        try:
            return self._carry_out(pick_of(message))
        except CommandError as error:
            return self._malformed(str(error))

    def refuse(self, text: str) -> Reply:
        """Count something that was to be a command and is none."""
        return self._malformed(text)

    def _carry_out(self, command: Command) -> Reply:
        if self._on_command is None:
            self._tally.add("refused")
            return Reply(False, "no commands are taken here")
        self._tally.add("commands")
        try:
            return self._on_command(command)
        except Exception as error:  # the estimator's trouble must not end the server
            self._tally.add("errors")
            return Reply(False, f"failed: {type(error).__name__}")

    def _unauthorised(self) -> Reply:
        self._tally.add("unauthorised")
        return Reply(False, "the token is missing or wrong", unauthorised=True)

    def _malformed(self, text: str) -> Reply:
        self._tally.add("malformed")
        return Reply(False, text)
