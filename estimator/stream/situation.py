"""What is known at this moment, shared by the threads of a stream: the camera's pose, the graph's answer, health."""

import threading
import time
from collections import deque
from collections.abc import Mapping, Sequence

from ...factors.rig import Rig
from ...io.live.interfaces import Health, Source
from ...io.messages import Message
from .follower import Followed, Follower
from .health import Monitor
from .settings import StreamSettings
from .wire import Answer, Frame

Counts = Mapping[str, Mapping[str, int]]


class Situation:
    """Every method may be called from any thread.

    Args:
        live: time goes on without messages; else (a replay) it stands with them.
    """

    def __init__(self, rig: Rig, settings: StreamSettings, live: bool) -> None:
        self._live = live
        self._lock = threading.Lock()
        self._follower = Follower()
        self._monitor = Monitor(rig, settings)
        self._answer: Answer | None = None
        self._now_ns = 0
        self._heard_at = time.monotonic_ns()
        self._stamp_ns = 0

    def heard(self, message: Message, arrived_ns: int) -> int:
        """A message has come; the time of receipt now, ns."""
        with self._lock:
            self._now_ns = max(self._now_ns, message.log_time_ns)
            self._heard_at = arrived_ns
            self._monitor.heard(message, self._now_ns)
            return self._now_ns

    def ticked(self) -> int:
        """Nothing has come; the time of receipt now, ns."""
        with self._lock:
            if self._live and self._now_ns:
                passed = time.monotonic_ns() - self._heard_at
                self._heard_at += passed
                self._now_ns += passed
            return self._now_ns

    def framed(self, frame: Frame) -> Followed | None:
        """The camera has moved; where it is now, None while that is not known."""
        with self._lock:
            self._stamp_ns = max(frame.stamp_ns, 0)
            return self._follower.frame(frame)

    def answered(self, answer: Answer) -> Followed | None:
        """The graph has said something new; where the camera is by it, None while that is not known."""
        with self._lock:
            self._answer = answer
            self._stamp_ns = max(self._stamp_ns, answer.stamp_ns)
            self._monitor.answered(answer)
            if answer.keyframe_ns is not None and "m" in answer.places:
                return self._follower.anchor(answer.keyframe_ns, answer.places["m"])
            return None

    def astray(self, forget_answer: bool) -> None:
        """The camera's pose is not known any more; nor, where that is asked for, anything else."""
        with self._lock:
            self._follower.forget()
            if forget_answer:
                self._answer = None

    def health(self, unpaired: deque[bool], sources: Sequence[Source], own: Counts) -> Health:
        """What is wrong now.

        Args:
            unpaired: whether each of the last moments lacked an image.
            own: what the stream itself refused or dropped, by reason and topic.
        """
        with self._lock:
            self._monitor.paired(unpaired)
            for source in sources:
                self._monitor.counted(source.by_topic(), self._now_ns, source.name)
            self._monitor.counted(own, self._now_ns, "stream")
            return self._monitor.health(self._now_ns, self._stamp_ns)

    def now_ns(self) -> int:
        """Time of receipt."""
        return self._now_ns

    def stamp_ns(self) -> int:
        """Newest stamp that was worked on."""
        return self._stamp_ns

    def answer(self) -> Answer | None:
        """What the graph said last."""
        return self._answer
