"""The estimate back to the robot, as ROS 2 topics through its zenoh router."""

import os
import threading
import time
from collections.abc import Mapping

import zenoh

from ...factors.errors import LogError
from ..schemas import typestore
from .backoff import Backoff
from .interfaces import Clock, LiveImage, LiveUpdate, OnCommand
from .outbox import Outbox, ThroughOutbox
from .tally import Tally
from .views import ros_messages
from .zenoh_link import DEFAULT_ROUTER, Announcements, Attachment, check_router, key_of, open_session


class ZenohSink(ThroughOutbox):
    """Publishes what a recording would hold, announced so that ROS 2 tools list the topics.

    What cannot be sent at once is dropped by zenoh; without a router everything is dropped and counted.

    Args:
        domain: ROS_DOMAIN_ID of the robot.
    """

    def __init__(self, router: str = DEFAULT_ROUTER, *, domain: int = 0, clock: Clock = time.time_ns) -> None:
        check_router(router)
        self._router = router
        self._domain = domain
        self._clock = clock
        self._tally = Tally()
        self._outbox = Outbox("surecut-zenoh-sink", self._send, self._tally)
        self._session: zenoh.Session | None = None
        self._announcements: Announcements | None = None
        self._publishers: dict[str, _Publisher] = {}
        self._stopping = threading.Event()
        self._linking: threading.Thread | None = None
        self._status = "not started"

    @property
    def name(self) -> str:
        return f"zenoh router {self._router}"

    def status(self) -> str:
        """One line for people."""
        return f"{self.name}: {self._status if self._session is None or self._linked() else 'the router is gone'}"

    def start(self, on_command: OnCommand | None = None) -> None:
        self._linking = threading.Thread(target=self._connect, name="surecut-zenoh-link", daemon=True)
        self._linking.start()
        self._outbox.start()

    def image(self, image: LiveImage) -> None:
        """Images come from there."""

    def stop(self) -> None:
        self._stopping.set()
        self._outbox.stop()
        if self._linking is not None:
            self._linking.join(5.0)
        session, self._session = self._session, None
        if session is not None:
            session.close()

    def counters(self) -> Mapping[str, int]:
        return self._outbox.counters()

    def _connect(self) -> None:
        backoff = Backoff()
        while self._session is None:
            try:
                session = open_session(self._router)
                self._announcements = Announcements(session, self._domain)
                self._session, self._status = session, "connected"
            except (LogError, zenoh.ZError) as error:
                self._status = str(error)
                if backoff.wait(self._stopping):
                    return

    def _linked(self) -> bool:
        return self._session is not None and bool(self._session.info.routers_zid())

    def _send(self, item: LiveUpdate | LiveImage) -> None:
        session = self._session
        if not isinstance(item, LiveUpdate):
            return
        if session is None or self._announcements is None or not self._linked():
            self._tally.add("dropped")
            return
        for topic, type_name, message in ros_messages(item):
            publisher = self._publishers.get(topic)
            if publisher is None:
                publisher = _Publisher(session, key_of(self._domain, topic, type_name))
                self._announcements.publisher(topic, type_name)
                self._publishers[topic] = publisher
            publisher.put(bytes(typestore().serialize_cdr(message, type_name)), self._clock())
        self._tally.add("sent")


class _Publisher:
    """One topic; rmw_zenoh's subscribers ask for an attachment with each sample."""

    def __init__(self, session: zenoh.Session, key: str) -> None:
        self._publisher = session.declare_publisher(
            key, congestion_control=zenoh.CongestionControl.DROP, priority=zenoh.Priority.DATA
        )
        self._gid = os.urandom(16)
        self._sequence = 0

    def put(self, data: bytes, now_ns: int) -> None:
        self._sequence += 1
        attachment = Attachment(self._sequence, now_ns, self._gid)
        self._publisher.put(data, attachment=attachment.encode())
