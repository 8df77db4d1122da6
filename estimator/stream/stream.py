"""The streaming estimator: sources in, sinks out, two processes between, for as long as there is work."""

import threading
import time
from collections import OrderedDict, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ...factors.errors import SurecutError
from ...factors.rig import Rig
from ...io.live.bounded import BoundedQueue, is_urgent, message_size
from ...io.live.interfaces import (
    Clock,
    Command,
    Freeze,
    LiveImage,
    Outline,
    Pick,
    Reply,
    Reset,
    Save,
    Sink,
    Source,
)
from ...io.messages import CameraInfoBody, ImageBody, Message, PickBody
from ..sensing import COLOUR_PERIOD_NS, Item, plain
from ..validated_range import ValidatedRange
from .children import Children
from .follower import Followed, Follower
from .graph_process import GraphTask
from .health import Monitor
from .latency import Latencies
from .ordering import LiveOrder
from .publisher import update_of
from .settings import StreamSettings
from .wire import Answer, Died, Done, Frame, Group, Order, Ready, Worked

TICK_S = 0.003
IDLE_PUBLISH_NS = 500_000_000
"""Without frames, the state is published so often, so that age and health are seen."""
RESTARTS = 5
"""More within a minute: the fault does not go away by itself."""
FINISH_S = 120.0
START_S = 120.0


@dataclass(frozen=True, slots=True)
class Arrival:
    """A message, and when it came by the monotonic clock."""

    message: Message
    arrived_ns: int


class Stream:
    """One run.

    Args:
        clock: time of day, ns.
        live: whether the sources' `log_time_ns` is this computer's time now; else (a replay) time stands with them.
        prior: checkpoint of an earlier run to begin with.
        checkpoint: file that is kept up to date, and begun with where it exists.
    """

    def __init__(
        self,
        rig: Rig,
        sources: Sequence[Source],
        sinks: Sequence[Sink],
        settings: StreamSettings,
        clock: Clock = time.time_ns,
        live: bool = True,
        prior: Path | None = None,
        checkpoint: Path | None = None,
        validated: ValidatedRange | None = None,
    ) -> None:
        self.rig, self.settings = rig, settings
        self._sources, self._sinks = list(sources), list(sinks)
        self._clock, self._live = clock, live
        self._patient = any(source.patient for source in sources)
        self._checkpoint = checkpoint
        begin = checkpoint if checkpoint is not None and checkpoint.exists() else prior
        self._begin = begin
        self._children = Children(GraphTask(rig, settings, begin, checkpoint, validated))
        self._queue: BoundedQueue[Arrival] = BoundedQueue(settings.queue_count, settings.queue_bytes)
        self._orders: deque[Order] = deque()
        self._order = LiveOrder(rig, settings.window_ns)
        self._follower = Follower()
        self._monitor = Monitor(rig, settings)
        self._lock = threading.Lock()
        """Over what both threads touch: monitor, follower, answer, the newest times."""
        self._answer: Answer | None = None
        self._now_ns = 0
        self._heard_at = time.monotonic_ns()
        self._stamp_ns = 0
        self._arrived: OrderedDict[int, int] = OrderedDict()
        self._pictures: OrderedDict[int, Message] = OrderedDict()
        self._next_image_ns = 0
        self._known: dict[str, CameraInfoBody] = {}
        self._next_colour_ns = 0
        self._published_at = 0
        self._stopping = threading.Event()
        self._finished = threading.Event()
        self._ready = threading.Event()
        self._deaths: list[float] = []
        self.problem: str | None = None
        """Why the stream ended, where it should not have."""
        self.latency = Latencies()
        """From the arrival of a frame's last image to its published pose."""
        self.counts: dict[str, int] = {}
        self.last_problem = ""

    # Run ------------------------------------------------------------------------------------------------------

    def run(self, progress: Callable[["Stream"], object] | None = None) -> None:
        """Until the sources end or `stop` is called.

        Raises:
            SurecutError: a source or sink cannot work, or the processes die again and again.
        """
        self._children.start(self._begin)
        results = threading.Thread(target=self._results, name="surecut-results", daemon=True)
        results.start()
        try:
            for sink in self._sinks:
                sink.start(self._commanded)
            self._wait_for_children()
            for source in self._sources:
                source.start(self._deliver_to(source))
            while not self._stopping.is_set():
                if not self._step():
                    break
                if progress is not None:
                    progress(self)
            self._end()
        finally:
            self._stopping.set()
            for source in self._sources:
                source.stop()
            self._children.stop()
            for sink in self._sinks:
                sink.stop()
        if self.problem is not None:
            raise SurecutError(self.problem)

    def _wait_for_children(self) -> None:
        """Messages that come before anybody can work on them would only be old when they are."""
        until = time.monotonic() + START_S
        while not self._ready.wait(0.1) and not self._stopping.is_set():
            dead = self._children.dead()
            if dead is not None or time.monotonic() > until:
                raise SurecutError(
                    f"the {dead or 'processes'} did not start; {self.last_problem or 'is there memory?'}"
                )

    def stop(self) -> None:
        """Ends the run; from any thread or signal handler."""
        self._stopping.set()
        self._queue.close()

    def pids(self) -> list[int]:
        """Front ends' and graph's processes."""
        return self._children.pids()

    def stamp_ns(self) -> int:
        """Newest stamp that was worked on."""
        return self._stamp_ns

    def answer(self) -> Answer | None:
        """What the graph said last."""
        return self._answer

    def _deliver_to(self, source: Source) -> Callable[[Message], None]:
        put = self._queue.put_waiting if source.patient else self._queue.put

        def deliver(message: Message) -> None:
            arrival = Arrival(message, time.monotonic_ns())
            put(arrival, message.topic, message_size(message), is_urgent(message))

        return deliver

    # Ordering (main thread) -----------------------------------------------------------------------------------

    def _step(self) -> bool:
        """One message, or one tick; False when nothing will come any more."""
        arrival = self._queue.get(TICK_S)
        self._carry_out()
        if arrival is None:
            if all(source.ended() for source in self._sources) and not len(self._queue):
                return False
            self._tick()
            return True
        message = plain(arrival.message)
        now_ns = self._noted(message, arrival.arrived_ns)
        if not self._redundant(message):
            for group in self._order.add(message, now_ns):
                self._send(group)
        return True

    def _noted(self, message: Message, arrived_ns: int) -> int:
        with self._lock:
            self._now_ns = max(self._now_ns, message.log_time_ns)
            self._heard_at = arrived_ns
            self._monitor.heard(message, self._now_ns)
            if isinstance(message.body, ImageBody) and message.stamp_ns > 0:
                self._arrived[message.stamp_ns] = arrived_ns  # the later of the two stays
                while len(self._arrived) > 4000:
                    self._arrived.popitem(last=False)
            return self._now_ns

    def _redundant(self, message: Message) -> bool:
        """Repetitions of a calibration, and colour images beyond what is looked at."""
        body = message.body
        if isinstance(body, CameraInfoBody):
            known = self._known.setdefault(message.topic, body)
            return known is not body and np.array_equal(known.camera.K, body.camera.K)
        if isinstance(body, ImageBody) and message.topic == self.rig.cameras.b_rgb.image_topic:
            if abs(self._next_colour_ns - message.stamp_ns) > 2 * COLOUR_PERIOD_NS:
                self._next_colour_ns = message.stamp_ns
            if message.stamp_ns < self._next_colour_ns:
                return True
            self._next_colour_ns = message.stamp_ns + COLOUR_PERIOD_NS
        return False

    def _tick(self) -> None:
        """Time goes on without messages, unless a replay stands still."""
        with self._lock:
            if self._live and self._now_ns:
                passed = time.monotonic_ns() - self._heard_at
                self._heard_at += passed
                self._now_ns += passed
            now_ns = self._now_ns
        if not self._patient:
            for group in self._order.due(now_ns + 1):  # nothing more comes at this time
                self._send(group)
        dead = self._children.dead()
        if dead is not None:
            self._restart(dead)
        if self._live and time.monotonic_ns() - self._published_at > IDLE_PUBLISH_NS:
            self._publish(None)

    def _send(self, group: list[Item]) -> None:
        self._keep_picture(group)
        while not self._stopping.is_set() and not self._children.put(Group(group)):
            dead = self._children.dead()
            if dead is not None:
                self._restart(dead)
                return

    def _keep_picture(self, group: list[Item]) -> None:
        """One image now and then for people to look at."""
        first = group[0]
        if isinstance(first, Message) or abs(self._next_image_ns - first.stamp_ns) > 5 * self.settings.image_period_ns:
            self._next_image_ns = min(self._next_image_ns, first.stamp_ns)
        if isinstance(first, Message) or first.stamp_ns < self._next_image_ns:
            return
        self._next_image_ns = first.stamp_ns + self.settings.image_period_ns
        with self._lock:
            self._pictures[first.stamp_ns] = first.left
            while len(self._pictures) > 20:
                self._pictures.popitem(last=False)

    def _end(self) -> None:
        """Everything that waits goes through, and the graph gives its last answer."""
        if self.problem is not None:
            return
        for group in self._order.rest():
            self._send(group)
        self._carry_out()
        self._stopping.clear()
        while not self._children.put(Order("finish")):
            if self._children.dead() is not None:
                return
        self._finished.wait(FINISH_S)

    def _restart(self, why: str) -> None:
        """A process has died: both begin again from the checkpoint."""
        now = time.monotonic()
        self._deaths = [t for t in self._deaths if now - t < 60.0] + [now]
        self._count("restarts")
        self.last_problem = self.last_problem or why  # a traceback says more than an exit code
        if len(self._deaths) > RESTARTS:
            self.problem = f"the {why.strip()} died {len(self._deaths)} times within a minute; report this as a defect"
            self._stopping.set()
            return
        self._children.stop()
        with self._lock:
            self._follower.forget()
        there = self._checkpoint if self._checkpoint is not None and self._checkpoint.exists() else self._begin
        self._known.clear()
        self._children.start(there)

    # Results (own thread) -------------------------------------------------------------------------------------

    def _results(self) -> None:
        ready: frozenset[str] = frozenset()
        while True:
            said = self._children.out.get()
            if isinstance(said, Frame):
                self._framed(said)
            elif isinstance(said, Answer):
                self._answered(said)
            elif isinstance(said, Worked):
                self._worked(said)
            elif isinstance(said, Done):
                self._done(said)
            elif isinstance(said, Ready):
                ready = ready | {said.who}
                if len(ready) == 2:
                    self._ready.set()
            elif isinstance(said, Died):
                self.last_problem = f"{said.who}: {said.trace}"
                self._count("deaths")

    def _framed(self, frame: Frame) -> None:
        with self._lock:
            followed = self._follower.frame(frame)
            self._stamp_ns = max(frame.stamp_ns, 0)
            arrived = self._arrived.pop(frame.stamp_ns, None)
        self._publish(followed)
        if arrived is not None:
            self.latency.add(time.monotonic_ns() - arrived)
        self._count("frames")
        self._count("lost_frames", int(frame.lost))

    def _answered(self, answer: Answer) -> None:
        with self._lock:
            self._answer = answer
            self._stamp_ns = max(self._stamp_ns, answer.stamp_ns)
            self._monitor.answered(answer)
            if answer.keyframe_ns is not None and "m" in answer.places:
                self._follower.anchor(answer.keyframe_ns, answer.places["m"])
        self._count("answers")

    def _worked(self, worked: Worked) -> None:
        self.counts["sensing_cpu_us"] = self.counts.get("sensing_cpu_us", 0) + round(1e6 * worked.cpu_s)
        if worked.problem is not None:
            self._count("refused_by_front_ends")
            self.last_problem = worked.problem
        with self._lock:
            picture = self._pictures.pop(worked.stamp_ns, None)
        if picture is None or not isinstance(picture.body, ImageBody):
            return
        outlines: tuple[Outline, ...] = worked.outlines.get("m_left", ())
        try:
            pixels = picture.body.pixels()
        except SurecutError:
            return
        image = LiveImage(picture.topic, picture.stamp_ns, "m_left", pixels, outlines)
        for sink in self._sinks:
            sink.image(image)

    def _done(self, done: Done) -> None:
        self._count(f"{done.what}_failed" if done.failed else f"{done.what}_done")
        if done.failed:
            self.last_problem = done.text
        if done.what == "reset":
            with self._lock:
                self._follower.forget()
                self._answer = None
        if done.what == "finish":
            self._publish(None)
            self._finished.set()

    def _publish(self, followed: Followed | None) -> None:
        with self._lock:
            self._monitor.paired(self._order.unpaired)
            for source in self._sources:
                self._monitor.counted(source.by_topic(), self._now_ns)
            health = self._monitor.health(self._now_ns, self._stamp_ns)
            stamp_ns, answer = self._stamp_ns, self._answer
        update = update_of(answer, followed, stamp_ns, self._clock(), health, self.counters(), self.settings)
        for sink in self._sinks:
            sink.publish(update)
        self._published_at = time.monotonic_ns()

    # Commands and counters ------------------------------------------------------------------------------------

    def _commanded(self, command: Command) -> Reply:
        """From a network thread: queued, and answered at once."""
        if isinstance(command, Pick):
            body = PickBody(command.camera, command.point_id, command.role, np.array(command.px), command.sigma_px)
            message = Message(self.rig.picks_topic, self._now_ns, command.stamp_ns, command.camera, body)
            taken = self._queue.put(Arrival(message, time.monotonic_ns()), message.topic, 0, urgent=True)
            return Reply(taken, "pick queued" if taken else "the stream is ending")
        what = {Reset: "reset", Save: "save"}.get(type(command))
        if isinstance(command, Freeze):
            what = "freeze" if command.frozen else "release"
        assert what is not None
        if len(self._orders) >= 16:
            return Reply(False, "too many commands wait; try again")
        self._orders.append(Order(what))
        return Reply(True, f"{what} queued")

    def _carry_out(self) -> None:
        while self._orders and self._children.put(self._orders[0]):
            self._orders.popleft()

    def _count(self, name: str, number: int = 1) -> None:
        self.counts[name] = self.counts.get(name, 0) + number

    def counters(self) -> dict[str, int]:
        """Totals of the whole process."""
        found = {**self.counts, **self.latency.counters("latency"), "queue_dropped": self._queue.dropped()}
        found |= {f"order_{name}": number for name, number in self._order.counts.items()}
        found["graph_behind"] = self._children.backlog()
        if self._answer is not None:
            found |= {f"graph_{name}": number for name, number in self._answer.counts.items()}
            found["graph_cpu_us"] = round(1e6 * self._answer.cpu_s)
        for i, source in enumerate(self._sources):
            found |= {f"source{i}_{name}": number for name, number in source.counters().items()}
        return found
