"""Messages of a robot that runs rmw_zenoh, through its router; needs no ROS installation."""

import threading
import time
from collections.abc import Mapping
from functools import partial

import zenoh

from ...factors.errors import LogError
from ..decode import ChannelInfo
from ..messages import Body, CameraInfoBody, CloudBody, DepthBody, DetectionsBody, ImageBody, PickBody
from ..schemas import MARKER_DETECTIONS, PIXEL_PICK
from .admission import Expected, Limits, plain_topic
from .backoff import Backoff
from .bounded import BoundedQueue
from .intake import Intake
from .interfaces import Clock, Deliver
from .zenoh_link import DEFAULT_ROUTER, Announcements, any_type, channel_of, check_router, open_session, read_attachment

_Sample = tuple[str, str, bytes, bytes]
"""Topic, key, payload, attachment."""
_LOOK_S = 0.5
_SMALL = 1 << 14
_TYPES: dict[type[Body], str] = {
    ImageBody: "sensor_msgs/msg/Image",
    DepthBody: "sensor_msgs/msg/Image",
    CloudBody: "sensor_msgs/msg/PointCloud2",
    CameraInfoBody: "sensor_msgs/msg/CameraInfo",
    DetectionsBody: MARKER_DETECTIONS,
    PickBody: PIXEL_PICK,
}


class ZenohSource:
    """A source that subscribes to the wanted topics.

    zenoh's own thread copies a sample into a bounded queue and is gone; decoding happens in this source's thread.

    Args:
        expected: types by topic: those that are subscribed to.
        domain: ROS_DOMAIN_ID of the robot.
        maximum_bytes: of the samples that wait to be decoded.
    """

    def __init__(
        self,
        expected: Expected,
        router: str = DEFAULT_ROUTER,
        *,
        domain: int = 0,
        limits: Limits | None = None,
        clock: Clock = time.time_ns,
        maximum_count: int = 256,
        maximum_bytes: int = 64 << 20,
    ) -> None:
        check_router(router)
        self._router = router
        self._domain = domain
        self._expected = expected
        self._dear = {topic for topic, types in expected.items() if set(types) & {PickBody, CameraInfoBody}}
        self._intake = Intake(clock, expected, limits)
        self._queue: BoundedQueue[_Sample] = BoundedQueue(maximum_count, maximum_bytes)
        self._channels: dict[tuple[str, str], ChannelInfo | str] = {}
        self._session: zenoh.Session | None = None
        self._announcements: Announcements | None = None
        self._subscribers: list[zenoh.Subscriber] = []
        self._stopping = threading.Event()
        self._status = "not started"
        self._threads: list[threading.Thread] = []

    @property
    def name(self) -> str:
        return f"zenoh router {self._router}"

    @property
    def patient(self) -> bool:
        return False

    def start(self, deliver: Deliver) -> None:
        self._intake.open(deliver)
        self._threads = [
            threading.Thread(target=self._connect, name="surecut-zenoh-link", daemon=True),
            threading.Thread(target=self._decode, name="surecut-zenoh", daemon=True),
        ]
        for thread in self._threads:
            thread.start()

    def stop(self) -> None:
        self._stopping.set()
        self._intake.close()
        self._queue.close()
        for thread in self._threads:
            thread.join(5.0)
        session, self._session = self._session, None
        if session is not None:
            session.close()

    def ended(self) -> bool:
        return self._stopping.is_set()

    def connected(self) -> bool:
        session = self._session
        return session is not None and bool(session.info.routers_zid())

    def status(self) -> str:
        problem = self._intake.last_problem()
        state = self._status if self._session is None or self.connected() else "the router is gone"
        return f"{self.name}: {state}" + (f"; last problem: {problem}" if problem else "")

    def counters(self) -> Mapping[str, int]:
        counters = dict(self._intake.counters())
        if dropped := self._queue.dropped():
            counters["dropped"] = dropped
        return counters

    def by_topic(self) -> Mapping[str, Mapping[str, int]]:
        topics = dict(self._intake.by_topic())
        if dropped := self._queue.dropped_by_topic():
            topics["dropped"] = dropped
        return topics

    def _connect(self) -> None:
        """Until the router answers for the first time; then watch whether it still does."""
        backoff = Backoff()
        while self._session is None:
            try:
                session = open_session(self._router)
                self._subscribers = [
                    session.declare_subscriber(any_type(self._domain, topic), partial(self._sample, topic))
                    for topic in self._expected
                ]
                self._announcements = self._announce(session)
                self._session, self._status = session, "connected"
            except (LogError, zenoh.ZError) as error:
                self._status = str(error)
                if backoff.wait(self._stopping):
                    return
        was_connected = True
        while not self._stopping.wait(_LOOK_S):
            if self.connected() and not was_connected:
                self._intake.tally.add("reconnects")
            was_connected = self.connected()

    def _announce(self, session: zenoh.Session) -> Announcements:
        """Ask for images uncompressed; where they come compressed all the same, they are taken so."""
        announcements = Announcements(session, self._domain)
        for topic, bodies in self._expected.items():
            if plain_topic(topic) == topic:
                for type_name in {_TYPES[body] for body in bodies if body in _TYPES}:
                    announcements.subscription(topic, type_name)
        return announcements

    def _sample(self, topic: str, sample: zenoh.Sample) -> None:
        """In zenoh's thread: never waits, for that would hold up the robot."""
        if len(sample.payload) > self._intake.limits.message_bytes:
            self._intake.refuse("oversized", topic)
            return
        attachment = sample.attachment.to_bytes() if sample.attachment is not None else b""
        payload = sample.payload.to_bytes()
        entry = topic, str(sample.key_expr), payload, attachment[:64]
        self._queue.put(entry, topic, len(payload) + 512, urgent=topic in self._dear and len(payload) < _SMALL)

    def _decode(self) -> None:
        while not self._stopping.is_set():
            sample = self._queue.get(_LOOK_S)
            if sample is None:
                continue
            topic, key, payload, attachment = sample
            channel = self._channel(topic, key)
            if isinstance(channel, str):
                self._intake.refuse("unknown_encoding", topic, channel)
                continue
            note = read_attachment(attachment)
            sender = "" if note is None else note.publisher.hex()
            self._intake.take(channel, payload, sender, 0 if note is None else max(note.time_ns, 0))

    def _channel(self, topic: str, key: str) -> ChannelInfo | str:
        """What the key describes, or what is wrong with it."""
        if (topic, key) not in self._channels:
            if len(self._channels) >= self._intake.limits.channels:
                self._channels.clear()
            try:
                self._channels[topic, key] = channel_of(topic, key)
            except LogError as error:
                self._channels[topic, key] = str(error)
        return self._channels[topic, key]
