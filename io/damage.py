"""What could not be read of a log, and the one line that says so."""

from dataclasses import dataclass, field
from typing import Literal

Kind = Literal["corrupt", "cut", "lost"]


@dataclass(frozen=True, slots=True)
class Damage:
    """One place in a file."""

    kind: Kind
    """`corrupt`: a chunk or record is bad; `cut`: the file ends inside of it; `lost`: bytes that belong to nothing."""
    offset: int
    length: int
    """Bytes."""
    reason: str
    start_ns: int | None = None
    end_ns: int | None = None
    """Log times of the first and last message in it, where known."""


@dataclass(slots=True)
class DamageReport:
    """Everything that is wrong with one file, in the order of the file."""

    label: str
    places: list[Damage] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    """What is odd, but lost nothing that is known."""
    last_time_ns: int | None = None
    """Log time of the last message that was read."""
    messages: int = 0

    @property
    def ends_cut(self) -> bool:
        """Whether it is said already that the end is missing."""
        return bool(self.places) and self.places[-1].kind == "cut"

    def line(self) -> str | None:
        """One line; None for a sound file."""
        parts = [*_corrupt(self.places), *_ends(self.places), *self.notes]
        if not parts:
            return None
        read = f"{self.messages} messages read"
        if self.last_time_ns is not None:
            read += f", the last at {_seconds(self.last_time_ns)}"
        return f"{self.label}: damaged: {'; '.join(parts)}; {read}"


def _corrupt(places: list[Damage]) -> list[str]:
    bad = [place for place in places if place.kind != "cut"]
    if not bad:
        return []
    lost = sum(place.length for place in bad)
    text = f"{len(bad)} corrupt {'place' if len(bad) == 1 else 'places'} skipped ({lost} bytes, the first at byte"
    text += f" {bad[0].offset}: {bad[0].reason})"
    spans = [(p.start_ns, p.end_ns) for p in bad if p.start_ns is not None and p.end_ns is not None]
    if spans:
        text += ", messages lost between " + _span(min(s for s, _ in spans), max(e for _, e in spans))
    return [text]


def _ends(places: list[Damage]) -> list[str]:
    texts = []
    for place in places:
        if place.kind == "cut":
            text = f"cut off at byte {place.offset + place.length}"
            text += f", the last {place.length} bytes are unusable" if place.length else ""
            if place.start_ns is not None and place.end_ns is not None:
                text += f" (messages between {_span(place.start_ns, place.end_ns)})"
            texts.append(text)
    return texts


def _span(start_ns: int, end_ns: int) -> str:
    return f"{_seconds(start_ns)} and {_seconds(end_ns)}"


def _seconds(time_ns: int) -> str:
    return f"{time_ns // 1_000_000_000}.{time_ns % 1_000_000_000 // 1_000_000:03d} s"
