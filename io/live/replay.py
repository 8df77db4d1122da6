"""A recording as if it were live: `--replay LOG --rate R`."""

import threading
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import replace
from pathlib import Path

from ...factors.errors import LogError
from ..decode import ChannelInfo, Decoder, decoder_for
from ..messages import Message
from ..reader import LogReader
from .interfaces import Deliver
from .tally import Tally

Entry = tuple[ChannelInfo, int, bytes | memoryview]


class Replay:
    """Delivers what an offline reading of the log would, at the times at which it was recorded.

    `log_time_ns` stays the time of recording: that is this source's time of receipt. Each repetition continues the
    stamps of the one before it.

    Args:
        rate: 1 for real time, 2 for twice as fast; None for as fast as the receiver takes it.
        topics: those to deliver; None for all.
        repeat: how often the log is played.
        monotonic_ns: what the pace is kept with.
        sleep: waits so many seconds; None for a wait that `stop` ends.
    """

    def __init__(
        self,
        log: Path | str,
        rate: float | None = 1.0,
        topics: Collection[str] | None = None,
        *,
        repeat: int = 1,
        monotonic_ns: Callable[[], int] = time.monotonic_ns,
        sleep: Callable[[float], object] | None = None,
    ) -> None:
        self._log = log
        self._rate = rate
        self._topics = None if topics is None else frozenset(topics)
        self._repeat = repeat
        self._monotonic_ns = monotonic_ns
        self._stopping = threading.Event()
        self._sleep = sleep or self._stopping.wait
        self._tally = Tally()
        self._decoders: dict[ChannelInfo, Decoder | None] = {}
        self._thread: threading.Thread | None = None
        self._finished = threading.Event()
        self._problem = ""

    @property
    def name(self) -> str:
        return f"replay of {self._log}"

    @property
    def patient(self) -> bool:
        return self._rate is None

    def start(self, deliver: Deliver) -> None:
        """
        Raises:
            LogError: the log cannot be read, or the rate is not positive.
        """
        if self._rate is not None and not self._rate > 0:
            raise LogError(f"{self._log}: rate {self._rate:g} is not positive; give a number above 0, or max")
        entries = self._entries()
        first = next(entries, None)  # finds now what makes the log unreadable
        if first is None:
            raise LogError(f"{self._log}: holds no message that is asked for; give a recorded .mcap log")
        self._thread = threading.Thread(
            target=self._run, args=(first, entries, deliver), name="surecut-replay", daemon=True
        )
        self._thread.start()

    def stop(self) -> None:
        self._stopping.set()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join(5.0)
        self._finished.set()

    def ended(self) -> bool:
        return self._finished.is_set()

    def connected(self) -> bool:
        return self._thread is not None and not self.ended()

    def status(self) -> str:
        state = "at its end" if self.ended() else "playing"
        return f"{self.name}: {state}" + (f"; {self._problem}" if self._problem else "")

    def counters(self) -> Mapping[str, int]:
        return self._tally.totals()

    def by_topic(self) -> Mapping[str, Mapping[str, int]]:
        return self._tally.by_topic()

    def _run(self, first: tuple[Entry, int], entries: Iterator[tuple[Entry, int]], deliver: Deliver) -> None:
        origin_ns, begun_ns = first[0][1] + first[1], self._monotonic_ns()
        entry: tuple[Entry, int] | None = first
        try:
            while entry is not None and not self._stopping.is_set():
                (channel, log_time_ns, data), shift_ns = entry
                if self._rate is not None:
                    self._wait_until(begun_ns + int((log_time_ns + shift_ns - origin_ns) / self._rate))
                    if self._stopping.is_set():
                        break
                self._hand_over(channel, log_time_ns, data, shift_ns, deliver)
                entry = next(entries, None)
        except LogError as error:
            self._problem = str(error)
            self._tally.add("errors")
        finally:
            self._finished.set()

    def _entries(self) -> Iterator[tuple[Entry, int]]:
        """Wanted entries with what is to be added to their times."""
        shift_ns = 0
        for _ in range(self._repeat):
            first_ns: int | None = None
            last_ns = 0
            with LogReader(self._log) as reader:
                for entry in reader.raw():
                    if self._topics is None or entry[0].topic in self._topics:
                        first_ns = entry[1] if first_ns is None else first_ns
                        last_ns = max(last_ns, entry[1])
                        yield entry, shift_ns
                self._problem = "; ".join(reader.warnings)
            if first_ns is None:
                return
            shift_ns += last_ns - first_ns + 100_000_000

    def _wait_until(self, due_ns: int) -> None:
        wait_s = (due_ns - self._monotonic_ns()) / 1e9
        if wait_s > 0:
            self._sleep(wait_s)

    def _hand_over(
        self, channel: ChannelInfo, log_time_ns: int, data: bytes | memoryview, shift_ns: int, deliver: Deliver
    ) -> None:
        self._tally.add("received", channel.topic)
        decoder = self._decoder(channel)
        if decoder is None:
            self._tally.add("unknown_encoding", channel.topic)
            return
        try:
            message = decoder(data, log_time_ns)
        except LogError as error:
            self._problem = str(error)
            self._tally.add("malformed", channel.topic)
            return
        deliver(_shifted(message, shift_ns))
        self._tally.add("delivered", channel.topic)

    def _decoder(self, channel: ChannelInfo) -> Decoder | None:
        if channel not in self._decoders:
            try:
                self._decoders[channel] = decoder_for(channel)
            except LogError as error:
                self._problem = str(error)
                self._decoders[channel] = None
        return self._decoders[channel]


def _shifted(message: Message, shift_ns: int) -> Message:
    if not shift_ns:
        return message
    return replace(message, log_time_ns=message.log_time_ns + shift_ns, stamp_ns=message.stamp_ns + shift_ns)
