"""ROS 2 over zenoh as rmw_zenoh speaks it: keys, attachments, and a session that opens no port of its own.

A key is `<domain>/<topic>/<type in DDS spelling>/<type hash>`; an attachment holds sequence number, time and the
publisher's id: int64, int64, a length byte 16, 16 bytes.
"""

import json
import re
import struct
from dataclasses import dataclass

import zenoh

from ...factors.errors import LogError
from ..decode import ChannelInfo
from ..schemas import schema

DEFAULT_ROUTER = "tcp/localhost:7447"
UNKNOWN_HASH = "TypeHashNotSupported"
"""What ROS 2 before Iron writes."""
_ATTACHMENT = struct.Struct("<qqB16s")
_TYPE = re.compile(r"(\w+)::msg::dds_::(\w+)_")
_ENDPOINT = re.compile(r"(tcp|tls|quic|unixsock-stream)/\S+")
_OPEN_MS = 1000
_NODE = "surecut"
_QOS = "::,1:,:,:,,"
"""Reliable, volatile, keep the last: rmw_zenoh's spelling of the defaults with depth 1."""


@dataclass(frozen=True, slots=True)
class Attachment:
    """What goes with each sample."""

    sequence: int
    time_ns: int
    publisher: bytes
    """16 bytes."""

    def encode(self) -> bytes:
        return _ATTACHMENT.pack(self.sequence, self.time_ns, 16, self.publisher)


def read_attachment(data: bytes) -> Attachment | None:
    """None when it is none."""
    if len(data) != _ATTACHMENT.size:
        return None
    sequence, time_ns, length, publisher = _ATTACHMENT.unpack(data)
    return Attachment(sequence, time_ns, publisher) if length == 16 else None


def key_of(domain: int, topic: str, type_name: str) -> str:
    """The key of a topic with a type that `schemas.typestore` knows."""
    package, _, name = type_name.partition("/msg/")
    return f"{domain}/{topic.strip('/')}/{package}::msg::dds_::{name}_/{schema(type_name).type_hash}"


def any_type(domain: int, topic: str) -> str:
    """A key expression for a topic with whatever type and hash."""
    return f"{domain}/{topic.strip('/')}/*/*"


def channel_of(topic: str, key: str) -> ChannelInfo:
    """What a key says about the samples of `topic`.

    Raises:
        LogError: it is no key of rmw_zenoh, or the type's definition is another one than ours.
    """
    parts = key.rsplit("/", 2)
    match = _TYPE.fullmatch(parts[1]) if len(parts) == 3 else None
    if match is None:
        raise LogError(f"{topic}: key {key[:120]!r} names no ROS 2 type")
    name = f"{match[1]}/msg/{match[2]}"
    try:
        own = schema(name).type_hash
    except KeyError:
        own = parts[2]  # a type that nobody here knows, which is told later
    if parts[2] not in (own, UNKNOWN_HASH):
        raise LogError(f"{topic}: the sender's definition of {name} is another one than ROS 2's; update the sender")
    return ChannelInfo(topic, "cdr", name, "ros2msg", b"")


class Announcements:
    """What ROS 2's graph shall know of a session: the node, its publishers and subscriptions; while this lives.

    Publishers that send only when somebody listens, as those of compressed images do, look there.
    """

    def __init__(self, session: zenoh.Session, domain: int) -> None:
        self._session = session
        self._domain = domain
        self._tokens = [session.liveliness().declare_token(self._key("NN", 0))]

    def publisher(self, topic: str, type_name: str) -> None:
        """Raises KeyError when `schemas.typestore` does not know the type."""
        self._endpoint("MP", topic, type_name)

    def subscription(self, topic: str, type_name: str) -> None:
        """Raises KeyError when `schemas.typestore` does not know the type."""
        self._endpoint("MS", topic, type_name)

    def _endpoint(self, kind: str, topic: str, type_name: str) -> None:
        _, dds_type, digest = key_of(self._domain, topic, type_name).rsplit("/", 2)
        what = f"{topic.replace('/', '%')}/{dds_type}/{digest}/{_QOS}"
        key = f"{self._key(kind, len(self._tokens))}/{what}"
        self._tokens.append(self._session.liveliness().declare_token(key))

    def _key(self, kind: str, number: int) -> str:
        return f"@ros2_lv/{self._domain}/{self._session.info.zid()}/0/{number}/{kind}/%/%/{_NODE}"


def open_session(router: str) -> zenoh.Session:
    """A session with a router; the library opens the link again by itself when it is lost later.

    Raises:
        LogError: the address is none, or nobody answers there within a second.
    """
    check_router(router)
    try:
        return zenoh.open(_config(router))
    except zenoh.ZError as error:
        raise LogError(f"zenoh router {router}: cannot be reached ({_first_line(error)}); start it") from error


def check_router(router: str) -> None:
    """Raises LogError when the address is none."""
    if not _ENDPOINT.fullmatch(router):
        raise LogError(f"{router}: is no address of a zenoh router; give one like {DEFAULT_ROUTER}")


def _config(router: str) -> zenoh.Config:
    """A client listens nowhere and searches for nobody."""
    config = zenoh.Config()
    for key, value in {
        "mode": "client",
        "connect/endpoints": [router],
        "connect/timeout_ms": _OPEN_MS,
        "connect/exit_on_failure": True,
        "listen/endpoints": [],
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
    }.items():
        config.insert_json5(key, json.dumps(value))
    return config


def _first_line(error: BaseException) -> str:
    return str(error).splitlines()[0][:160] if str(error) else type(error).__name__
