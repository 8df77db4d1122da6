"""The thread and the bounded queue behind every sink: whoever publishes never waits."""

import threading
import time
from collections.abc import Callable, Mapping

from .bounded import BoundedQueue
from .interfaces import LiveImage, LiveUpdate
from .tally import Tally

_STOP_S = 1.0
UPDATES = "updates"


class ThroughOutbox:
    """A sink that hands everything to its outbox."""

    _outbox: "Outbox"

    def publish(self, update: LiveUpdate) -> None:
        """See `interfaces.Sink`."""
        self._outbox.publish(update)

    def image(self, image: LiveImage) -> None:
        """See `interfaces.Sink`."""
        self._outbox.image(image)


class Outbox:
    """Hands updates and images to `send` in a thread of its own.

    Images are pushed out by newer images, updates by newer updates alone. An exception of `send` is counted.

    Args:
        send: may take its time.
        tick: is called at least every `tick_s`, also when nothing comes.
        images: whether images are wanted.
    """

    def __init__(
        self,
        name: str,
        send: Callable[[LiveUpdate | LiveImage], None],
        tally: Tally,
        *,
        tick: Callable[[], None] | None = None,
        tick_s: float = 1.0,
        images: bool = False,
        maximum_updates: int = 64,
        maximum_image_bytes: int = 16 << 20,
    ) -> None:
        self._name = name
        self._send = send
        self._tally = tally
        self._tick = tick
        self._tick_s = tick_s
        self._images = images
        self._queue: BoundedQueue[LiveUpdate | LiveImage] = BoundedQueue(64, maximum_image_bytes, maximum_updates)
        self._stopping = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Begin to send."""
        self._thread = threading.Thread(target=self._run, name=self._name, daemon=True)
        self._thread.start()

    def publish(self, update: LiveUpdate) -> None:
        """See `interfaces.Sink`."""
        self._tally.add("published")
        self._queue.put(update, UPDATES, 0, urgent=True)

    def image(self, image: LiveImage) -> None:
        """See `interfaces.Sink`."""
        if self._images:
            self._tally.add("images")
            self._queue.put(image, image.topic, image.pixels.nbytes)

    def stop(self) -> None:
        """Send what is queued for at most a second; what is left then counts as dropped."""
        self._queue.close()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join(_STOP_S)
            self._stopping.set()
            self._thread.join(_STOP_S)
        while self._queue.get(0.0) is not None:
            self._tally.add("dropped")

    def dropped(self) -> int:
        """Updates and images that did not fit."""
        return self._queue.dropped()

    def counters(self) -> Mapping[str, int]:
        """The tally with what was dropped here."""
        counters = dict(self._tally.totals())
        if dropped := self.dropped():
            counters["dropped"] = counters.get("dropped", 0) + dropped
        return counters

    def _run(self) -> None:
        next_tick_s = time.monotonic() + self._tick_s
        while not self._stopping.is_set():
            item = self._queue.get(max(0.0, next_tick_s - time.monotonic()))
            if item is not None:
                self._guarded(lambda item=item: self._send(item))
            if self._tick is not None and time.monotonic() >= next_tick_s:
                self._guarded(self._tick)
            if time.monotonic() >= next_tick_s:
                next_tick_s = time.monotonic() + self._tick_s
            if item is None and self._queue.closed:
                return

    def _guarded(self, action: Callable[[], None]) -> None:
        try:
            action()
        except Exception:  # a sink's trouble is its own: it is counted, and the next update is tried
            self._tally.add("errors")
