"""Stereo pairs from two topics, by stamp."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

from .messages import Message


@dataclass(frozen=True, slots=True)
class StereoPair:
    """A left and a right message of one exposure; the stamp is the left one's."""

    left: Message
    right: Message

    @property
    def stamp_ns(self) -> int:
        return self.left.stamp_ns


@dataclass(slots=True)
class PairingReport:
    """Counted while `stereo_pairs` runs."""

    pairs: int = 0
    unpaired: dict[str, int] = field(default_factory=dict)
    """By topic."""
    largest_difference_ns: int = 0
    """Between the stamps of a pair."""


def stereo_pairs(
    messages: Iterable[Message],
    left_topic: str,
    right_topic: str,
    tolerance_ns: int = 1_000_000,
    report: PairingReport | None = None,
    waiting: int = 64,
) -> Iterator[Message | StereoPair]:
    """All messages, those of the two topics joined to pairs.

    Each side is matched with the nearest stamp of the other within the tolerance; a pair appears where its second
    half came. A message without a partner is delivered as it is and counted: when the other side has gone past it,
    when `waiting` others of its side are waiting, or at the end. Cameras whose clocks differ by more than the
    tolerance have to be told to this function, not guessed.
    """
    told = report if report is not None else PairingReport()
    sides: dict[str, list[Message]] = {left_topic: [], right_topic: []}
    for message in messages:
        if message.topic not in sides:
            yield message
            continue
        is_left = message.topic == left_topic
        own, others = sides[message.topic], sides[right_topic if is_left else left_topic]
        index = _nearest(others, message.stamp_ns, tolerance_ns)
        if index is None:
            own.append(message)
            yield from _given_up(own, len(own) - waiting, told)
            continue
        partner = others.pop(index)
        yield from _given_up(others, _older(others, message.stamp_ns - tolerance_ns), told)
        yield from _given_up(own, _older(own, partner.stamp_ns - tolerance_ns), told)
        told.pairs += 1
        told.largest_difference_ns = max(told.largest_difference_ns, abs(message.stamp_ns - partner.stamp_ns))
        yield StereoPair(message, partner) if is_left else StereoPair(partner, message)
    for side in sides.values():
        yield from _given_up(side, len(side), told)


def _nearest(candidates: list[Message], stamp_ns: int, tolerance_ns: int) -> int | None:
    if not candidates:
        return None
    differences = [abs(message.stamp_ns - stamp_ns) for message in candidates]
    best = differences.index(min(differences))
    return best if differences[best] <= tolerance_ns else None


def _older(messages: list[Message], stamp_ns: int) -> int:
    """How many messages at the front are older."""
    return next((i for i, message in enumerate(messages) if message.stamp_ns >= stamp_ns), len(messages))


def _given_up(messages: list[Message], number: int, report: PairingReport) -> list[Message]:
    """Take the first `number` messages out."""
    given_up = messages[: max(number, 0)]
    del messages[: len(given_up)]
    for message in given_up:
        report.unpaired[message.topic] = report.unpaired.get(message.topic, 0) + 1
    return given_up
