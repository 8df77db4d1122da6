"""Health and metrics over HTTP: `/healthz` for whoever restarts services, `/metrics` for Prometheus."""

import json
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from socket import AF_INET, AF_INET6, socket
from typing import Any, cast

from numpy.linalg import eigvalsh
from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily
from prometheus_client.exposition import CONTENT_TYPE_LATEST
from prometheus_client.metrics_core import Metric

from ..build_views import CHI_95_3D
from .access import Access, cannot_listen
from .interfaces import Clock, HealthState, LiveImage, LivePoint, LiveUpdate, OnCommand
from .tally import Tally
from .views import health_object

_MAXIMUM_POINTS = 64
_REQUEST_S = 3.0
_VERDICTS = ("GO", "NO-GO", "MEASURE MORE", "EXPIRED")


class WebServer:
    """A sink that shows the newest update to whoever asks. It takes nothing in.

    Args:
        stale_s: without an update for so long the process is not healthy, whatever the last one said.
        extra: further totals to show, such as those of sources and sinks, by name.
        clock: what the time since the last update is taken with.

    Raises:
        AccessError: from `Access`.
    """

    def __init__(
        self,
        access: Access | None = None,
        port: int = 0,
        *,
        stale_s: float = 5.0,
        extra: Callable[[], Mapping[str, int]] | None = None,
        clock: Clock = time.time_ns,
        maximum_requests: int = 8,
    ) -> None:
        self._access = access or Access()
        self._port = port
        self._stale_s = stale_s
        self._extra = extra
        self._clock = clock
        self._maximum_requests = maximum_requests
        self._tally = Tally()
        self._newest: tuple[LiveUpdate, int] | None = None
        self._server: _Server | None = None
        self._thread: threading.Thread | None = None
        self._registry = CollectorRegistry(auto_describe=False)
        self._registry.register(cast(Any, self))

    @property
    def name(self) -> str:
        return f"health and metrics http://{self._access.host}:{self._port}"

    @property
    def port(self) -> int:
        """Where it listens."""
        return self._port

    def start(self, on_command: OnCommand | None = None) -> None:
        """
        Raises:
            AccessError: the address is in use or is none of this machine.
        """
        try:
            self._server = _Server((self._access.host, self._port), self._maximum_requests, self._answer, self._tally)
        except OSError as error:
            raise cannot_listen(self._access.host, self._port, error) from error
        self._port = self._server.server_address[1]
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.1,), name="surecut-web", daemon=True)
        self._thread.start()

    def publish(self, update: LiveUpdate) -> None:
        self._newest = update, self._clock()
        self._tally.add("published")

    def image(self, image: LiveImage) -> None:
        """Images are not for this sink."""

    def stop(self) -> None:
        server, self._server = self._server, None
        if server is not None and self._thread is not None:
            server.shutdown()
            server.server_close()
            self._thread.join(5.0)

    def counters(self) -> Mapping[str, int]:
        return self._tally.totals()

    def collect(self) -> Iterator[Metric]:
        """For prometheus_client: everything, as it is now."""
        yield from _process_metrics(self._healthy(), self._age_s())
        if self._newest is not None:
            update = self._newest[0]
            yield from _state_metrics(update)
            yield from _point_metrics(update.points[:_MAXIMUM_POINTS])
        totals = dict(self._newest[0].counters) if self._newest is not None else {}
        totals.update(self._extra() if self._extra is not None else {})
        family = CounterMetricFamily("surecut_events", "What happened since the start, by name", labels=["name"])
        for name, number in sorted(totals.items()):
            family.add_metric([name], number)
        yield family

    def _answer(self, path: str) -> tuple[int, str, bytes]:
        if path == "/metrics":
            return 200, CONTENT_TYPE_LATEST, generate_latest(self._registry)
        if path == "/healthz":
            body = json.dumps(self._health(), allow_nan=False).encode() + b"\n"
            return (200 if self._healthy() else 503), "application/json", body
        return 404, "text/plain", b"there are /healthz and /metrics\n"

    def _health(self) -> dict[str, Any]:
        if self._newest is None:
            return {"healthy": False, "reason": "no update yet", "state": str(HealthState.STARTING), "faults": []}
        update = self._newest[0]
        age_s = self._age_s() or 0.0
        reason = f"no update for {age_s:.1f} s" if age_s > self._stale_s else ""
        return {
            "healthy": self._healthy(),
            "reason": reason,
            **health_object(update.health),
            "verdict": update.verdict,
            "update_age_s": round(age_s, 3),
            "stamp_ns": update.stamp_ns,
        }

    def _healthy(self) -> bool:
        """A degraded process still answers; one that is starting, has failed or says nothing does not."""
        if self._newest is None:
            return False
        age_s = self._age_s()
        state = self._newest[0].health.state
        return age_s is not None and age_s <= self._stale_s and state in (HealthState.OK, HealthState.DEGRADED)

    def _age_s(self) -> float | None:
        return None if self._newest is None else (self._clock() - self._newest[1]) / 1e9


def _process_metrics(healthy: bool, age_s: float | None) -> Iterator[Metric]:
    yield GaugeMetricFamily("surecut_healthy", "1 while answers come and may be used", value=float(healthy))
    if age_s is not None:
        yield GaugeMetricFamily("surecut_update_age_seconds", "Since the last update", value=age_s)


def _state_metrics(update: LiveUpdate) -> Iterator[Metric]:
    delay_s = (update.sent_ns - update.stamp_ns) / 1e9
    yield GaugeMetricFamily("surecut_delay_seconds", "From newest measurement to publication", value=delay_s)
    state = GaugeMetricFamily("surecut_state", "1 for the state that the process is in", labels=["state"])
    for one in HealthState:
        state.add_metric([str(one)], float(one == update.health.state))
    yield state
    faults = GaugeMetricFamily("surecut_fault", "1 for each fault that lasts", labels=["fault", "severity"])
    for pair in sorted({(fault.name, str(fault.severity)) for fault in update.health.faults}):
        faults.add_metric(list(pair), 1.0)
    yield faults


def _point_metrics(points: tuple[LivePoint, ...]) -> Iterator[Metric]:
    radius = GaugeMetricFamily("surecut_point_radius95_metres", "Longest half axis of the 95 % body", labels=["point"])
    age = GaugeMetricFamily("surecut_point_age_seconds", "Since the point was last tied to {b}", labels=["point"])
    verdict = GaugeMetricFamily("surecut_point_verdict", "1 for the verdict that holds", labels=["point", "verdict"])
    for point in points:
        radius.add_metric([point.name], CHI_95_3D * max(float(eigvalsh(point.covariance_m2)[-1]), 0.0) ** 0.5)
        age.add_metric([point.name], point.age_s)
        for one in sorted({*_VERDICTS, point.verdict}):
            verdict.add_metric([point.name, one], float(one == point.verdict))
    yield from (radius, age, verdict)


class _Server(ThreadingHTTPServer):
    """As many requests at a time as are allowed; further connections are closed at once."""

    daemon_threads = True
    block_on_close = False
    request_queue_size = 64

    def __init__(
        self, address: tuple[str, int], maximum: int, answer: Callable[[str], tuple[int, str, bytes]], tally: Tally
    ) -> None:
        self.address_family = AF_INET6 if ":" in address[0] else AF_INET
        self.answer = answer
        self._slots = threading.BoundedSemaphore(maximum)
        self._tally = tally
        super().__init__(address, _Handler)

    def process_request(self, request: socket | tuple[bytes, socket], client_address: Any) -> None:
        if not self._slots.acquire(blocking=False):
            self._tally.add("refused_connections")
            self.shutdown_request(request)
            return
        super().process_request(request, client_address)

    def process_request_thread(self, request: socket | tuple[bytes, socket], client_address: Any) -> None:
        try:
            super().process_request_thread(request, client_address)
        finally:
            self._slots.release()

    def handle_error(self, request: socket | tuple[bytes, socket], client_address: Any) -> None:
        """Count what the standard library would print."""
        self._tally.add("errors")


class _Handler(BaseHTTPRequestHandler):
    timeout = _REQUEST_S
    server_version = "surecut"
    sys_version = ""

    def do_GET(self) -> None:  # the name that http.server asks for
        status, kind, body = cast(_Server, self.server).answer(self.path.partition("?")[0])
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(body)))
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *args: Any) -> None:  # noqa: A002  # the name that http.server asks for
        """Nothing is printed."""
