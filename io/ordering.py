"""Messages in the order of measurement: logs and streams bring them in the order of arrival."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from heapq import heappop, heappush

from .messages import Message


@dataclass(slots=True)
class OrderReport:
    """What was odd about the stamps, counted while `sorted_by_stamp` runs."""

    late: int = 0
    """Messages that came later than the window allows; delivered at once, out of order."""
    zero: int = 0
    """Messages whose stamp is not set (0 or negative); delivered at once."""
    backwards: dict[str, int] = field(default_factory=dict)
    """By topic: messages whose stamp is before that of the message before them, as recorded."""
    duplicated: dict[str, int] = field(default_factory=dict)
    """By topic: messages whose stamp is that of the message before them, as recorded."""


def sorted_by_stamp(
    messages: Iterable[Message], window_ns: int = 2_000_000_000, report: OrderReport | None = None
) -> Iterator[Message]:
    """The same messages by stamp; equal stamps in the order of arrival.

    A message waits until one has come whose stamp is `window_ns` later. What comes later still is delivered at once
    and counted in `report`: nothing is lost.
    """
    told = report if report is not None else OrderReport()
    waiting: list[tuple[int, int, Message]] = []
    last_by_topic: dict[str, int] = {}
    newest = delivered = -(1 << 63)
    for number, message in enumerate(messages):
        _count(message, last_by_topic, told)
        if message.stamp_ns <= 0:
            told.zero += 1
            yield message
            continue
        if message.stamp_ns < delivered:
            told.late += 1
            yield message
            continue
        newest = max(newest, message.stamp_ns)
        heappush(waiting, (message.stamp_ns, number, message))
        while waiting and waiting[0][0] <= newest - window_ns:
            delivered, _, first = heappop(waiting)
            yield first
    while waiting:
        yield heappop(waiting)[2]


def _count(message: Message, last_by_topic: dict[str, int], report: OrderReport) -> None:
    topic = message.topic
    last = last_by_topic.get(topic)
    last_by_topic[topic] = message.stamp_ns
    if last is None:
        return
    if message.stamp_ns < last:
        report.backwards[topic] = report.backwards.get(topic, 0) + 1
    elif message.stamp_ns == last:
        report.duplicated[topic] = report.duplicated.get(topic, 0) + 1
