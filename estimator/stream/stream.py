"""The streaming estimator: sources in, sinks out, three processes between, for as long as there is work."""

import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ...factors.errors import SurecutError
from ...factors.rig import Rig
from ...io.live.bounded import BoundedQueue, is_urgent, message_size
from ...io.live.interfaces import Clock, Command, Freeze, LiveImage, Pick, Reply, Reset, Save, Sink, Source
from ...io.live.tally import Tally
from ...io.messages import ImageBody, Message, PickBody
from ..items import Item, plain
from ..validated_range import ValidatedRange
from .arrivals import Arrivals
from .children import NAMES, Children
from .follower import Followed
from .latency import Latencies
from .ordering import LiveOrder
from .parent import keep_loaded
from .publisher import update_of
from .remembered import remembered
from .settings import StreamSettings
from .situation import Situation
from .wire import Answer, Died, Done, Frame, GraphTask, Group, Order, Ready, Worked

TICK_S = 0.003
SWITCH_S = 0.0005
"""A thread that has a pose to hand on waits at most about so long for one that is busy."""
IDLE_PUBLISH_NS = 500_000_000
"""Without frames, the state is published so often, so that age and health are seen."""
COUNT_NS = 250_000_000
"""Counters are gathered so often."""
RESTARTS = 5
"""More within a minute: the fault does not go away by itself."""
FINISH_S = 120.0
START_S = 120.0
LAST_WORDS_S = 1.0
"""What a process says of its death comes by a thread of its own."""
START_PUBLISH_S = 0.1
"""While the processes start, what is known is published so often."""


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
        self._begin = checkpoint if checkpoint is not None and checkpoint.exists() else prior
        task = GraphTask(rig, settings, self._begin, checkpoint, validated, self._patient)
        self._children = Children(task, self._hear)
        self._queue: BoundedQueue[Arrival] = BoundedQueue(settings.queue_count, settings.queue_bytes)
        self._orders: deque[Order] = deque()
        self._order = LiveOrder(rig, settings.window_ns)
        self._arrivals = Arrivals(rig, settings)
        self._situation = Situation(rig, settings, live)
        self._published_at = 0
        self._stopping = threading.Event()
        self._finished = threading.Event()
        self._ready: set[str] = set()
        self._all_ready = threading.Event()
        self._deaths: list[float] = []
        self._died = threading.Event()
        """A process has said what it died of."""
        self._refused = False
        """It was what it was given to begin with."""
        self.problem: str | None = None
        """Why the stream ended, where it should not have."""
        self.latency = Latencies()
        """From the arrival of a frame's last image to its published pose."""
        self._parts = {name: Latencies() for name in ("waiting", "tracking", "publishing")}
        self._tally = Tally()
        self._counters: dict[str, int] = {}
        self._counted_at = 0
        self.last_problem = ""

    # Run ------------------------------------------------------------------------------------------------------

    def run(self, progress: Callable[["Stream"], object] | None = None) -> None:
        """Until the sources end or `stop` is called.

        Raises:
            SurecutError: a source or sink cannot work, or the processes die again and again.
        """
        switch_s = sys.getswitchinterval()
        sys.setswitchinterval(SWITCH_S)
        try:
            for sink in self._sinks:
                sink.start(self._commanded)
            self._start_children()
            keep_loaded()
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
            sys.setswitchinterval(switch_s)
        if self.problem is not None:
            raise SurecutError(self.problem)

    def _start_children(self) -> None:
        """Messages that come before anybody can work on them would only be old when they are. Meanwhile whoever listens
        gets what was known at the last checkpoint."""
        known = None if self._begin is None else remembered(self._begin, self.rig)
        if known is not None:
            self._situation.answered(known)
        starting = threading.Thread(target=self._children.start, args=(self._begin,), name="surecut-start", daemon=True)
        starting.start()
        until = time.monotonic() + START_S
        while not self._all_ready.wait(START_PUBLISH_S) and not self._stopping.is_set():
            self._publish(None)
            dead = None if starting.is_alive() else self._children.dead()
            if dead is not None or time.monotonic() > until:
                self._died.wait(LAST_WORDS_S)
                why = self.last_problem or "is there memory?"
                raise SurecutError(why if self._refused else f"the {dead or 'processes'} did not start; {why}")
        starting.join()

    def stop(self) -> None:
        """Ends the run; from any thread or signal handler."""
        self._stopping.set()
        self._queue.close()

    def pids(self) -> list[int]:
        """Processes of the tracking, the other front ends and the graph."""
        return self._children.pids()

    def stamp_ns(self) -> int:
        """Newest stamp that was worked on."""
        return self._situation.stamp_ns()

    def answer(self) -> Answer | None:
        """What the graph said last."""
        return self._situation.answer()

    def counts(self) -> dict[str, int]:
        """What has happened so far, by name."""
        return dict(self._tally.totals())

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
        now_ns = self._situation.heard(message, arrival.arrived_ns)
        self._arrivals.note(message, arrival.arrived_ns)
        if not self._arrivals.redundant(message):
            for group in self._order.add(message, now_ns):
                self._send(group)
        return True

    def _tick(self) -> None:
        """Time goes on without messages, unless a replay stands still."""
        now_ns = self._situation.ticked()
        if not self._patient:
            for group in self._order.due(now_ns + 1):  # nothing more comes at this time
                self._send(group)
        dead = self._children.dead()
        if dead is not None:
            self._restart(dead)
        if self._live and time.monotonic_ns() - self._published_at > IDLE_PUBLISH_NS:
            self._publish(None)

    def _send(self, group: list[Item]) -> None:
        self._arrivals.keep_picture(group)
        while not self._stopping.is_set() and not self._children.put(Group(group)):
            dead = self._children.dead()
            if dead is not None:
                self._restart(dead)
                return

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
        if self._refused:
            self.problem = self.last_problem
            self._stopping.set()
            return
        if len(self._deaths) > RESTARTS:
            self.problem = f"the {why.strip()} died {len(self._deaths)} times within a minute; report this as a defect"
            self._stopping.set()
            return
        self._children.stop()
        self._situation.astray(forget_answer=False)
        there = self._checkpoint if self._checkpoint is not None and self._checkpoint.exists() else self._begin
        self._arrivals.forget_calibrations()
        self._children.start(there)

    # Results (a thread for each process) --------------------------------------------------------------------

    def _hear(self, said: object) -> None:
        """Something that one of the processes says."""
        if isinstance(said, Frame):
            self._framed(said)
        elif isinstance(said, Answer):
            self._publish(self._situation.answered(said))
            self._count("answers")
        elif isinstance(said, Worked):
            self._worked(said)
        elif isinstance(said, Done):
            self._done(said)
        elif isinstance(said, Ready):
            self._ready.add(said.who)
            if len(self._ready) == len(NAMES):
                self._all_ready.set()
        elif isinstance(said, Died):
            self.last_problem = said.trace if said.refusal else f"{said.who}: {said.trace}"
            self._refused |= said.refusal
            self._died.set()
            self._count("deaths")

    def _framed(self, frame: Frame) -> None:
        followed = self._situation.framed(frame)
        arrived = self._arrivals.arrived(frame.stamp_ns)
        self._publish(followed)
        if arrived is not None:
            now = time.monotonic_ns()
            self.latency.add(now - arrived)
            times = arrived, frame.taken_ns, frame.tracked_ns, now
            for part, began, ended in zip(self._parts.values(), times[:-1], times[1:], strict=True):
                part.add(ended - began)
        if frame.early:
            return
        self._count("frames")
        self._count("lost_frames", int(frame.lost))
        self._count("tracking_cpu_us", round(1e6 * frame.cpu_s))

    def _worked(self, worked: Worked) -> None:
        self._count("looking_cpu_us", round(1e6 * worked.cpu_s))
        self._count("left_out", worked.left_out)
        self._count("thinned", worked.thinned)
        for topic in worked.unreadable:
            self._tally.add("malformed", topic)
        if worked.problem is not None:
            self._count("refused_by_front_ends")
            self.last_problem = worked.problem
        picture = self._arrivals.picture(worked.stamp_ns)
        if picture is None or not isinstance(picture.body, ImageBody):
            return
        try:
            pixels = picture.body.pixels()
        except SurecutError:
            return
        image = LiveImage(picture.topic, picture.stamp_ns, "m_left", pixels, worked.outlines.get("m_left", ()))
        for sink in self._sinks:
            sink.image(image)

    def _done(self, done: Done) -> None:
        self._count(f"{done.what}_failed" if done.failed else f"{done.what}_done")
        if done.failed:
            self.last_problem = done.text
        if done.what == "reset":
            self._situation.astray(forget_answer=True)
        if done.what == "finish":
            self._publish(None)
            self._finished.set()

    def _publish(self, followed: Followed | None) -> None:
        own = {
            "dropped": self._queue.dropped_by_topic(),
            "stamp_outlier": self._order.strays(),
            "malformed": self._tally.by_topic().get("malformed", {}),
        }
        health = self._situation.health(self._order.unpaired, self._sources, own)
        answer, stamp_ns = self._situation.answer(), self._situation.stamp_ns()
        update = update_of(answer, followed, stamp_ns, self._clock(), health, self._recent_counters(), self.settings)
        for sink in self._sinks:
            sink.publish(update)
        self._published_at = time.monotonic_ns()

    # Commands and counters ------------------------------------------------------------------------------------

    def _commanded(self, command: Command) -> Reply:
        """From a network thread: queued, and answered at once."""
        if isinstance(command, Pick):
            body = PickBody(command.camera, command.point_id, command.role, np.array(command.px), command.sigma_px)
            message = Message(self.rig.picks_topic, self._situation.now_ns(), command.stamp_ns, command.camera, body)
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
        if number:
            self._tally.add(name, number=number)

    def _recent_counters(self) -> dict[str, int]:
        now = time.monotonic_ns()
        if now - self._counted_at > COUNT_NS:
            self._counted_at = now
            self._counters = self.counters()
        return self._counters

    def counters(self) -> dict[str, int]:
        """Totals of the whole process."""
        found = {**self._tally.totals(), **self.latency.counters("latency"), "queue_dropped": self._queue.dropped()}
        for name, part in self._parts.items():
            found |= part.counters(f"latency_{name}")
        found |= {f"order_{name}": number for name, number in self._order.counts.items()}
        found["graph_behind"] = self._children.backlog()
        answer = self.answer()
        if answer is not None:
            found |= {f"graph_{name}": number for name, number in answer.counts.items()}
            found["graph_cpu_us"] = round(1e6 * answer.cpu_s)
        for i, source in enumerate(self._sources):
            found |= {f"source{i}_{name}": number for name, number in source.counters().items()}
        return found
