"""One board's standing in the graph."""

from dataclasses import dataclass, field

import gtsam
import numpy as np
from numpy.typing import NDArray

from ..factors import keys
from ..factors.measurements import MarkerSighting
from ..factors.rig import Board, Marker

Float = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class PageFactor:
    """Where the factor stands that lays one marker on its page."""

    marker: int
    slot: int
    epoch: int
    detection_m: float
    """Lasting detection error of its corners, on the page."""


@dataclass(frozen=True, slots=True)
class Knock:
    """A board has another pose from a moment on."""

    before_ns: int
    """Last seen in its old place."""
    after_ns: int
    """First seen in its new one."""
    epoch: int
    """The new one."""


@dataclass(frozen=True, slots=True)
class Displaced:
    """A view in which a board does not stand where it should."""

    keyframe: int
    stamp_ns: int
    seen: list[MarkerSighting]
    o_T_f: gtsam.Pose3 | None
    """Where it seems to stand instead; None where the view is too poor to say."""
    covariance: Float | None
    """Of `o_T_f`, shape (6, 6), tangent of {f}, rotation first."""


@dataclass(slots=True)
class Sheet:
    """What is known of one board, and what is waiting to be."""

    index: int
    board: Board
    epoch: int = 0
    known: bool = False
    page_known: bool = False
    slots: dict[int, int] = field(default_factory=dict)
    """Marker id to slot, of the present epoch."""
    held: list[tuple[int, list[MarkerSighting]]] = field(default_factory=list)
    """Keyframe key and sightings, until the first pose is sure."""
    last_seen_ns: int | None = None
    first_seen_ns: int | None = None
    exchanged: dict[int, int] = field(default_factory=dict)
    """Printed id to the id whose place it has."""
    loose: set[int] = field(default_factory=set)
    """Markers that are left out, because they are not where the page says."""
    pages: dict[str, PageFactor] = field(default_factory=dict)
    """By the words of the factor's record."""
    displaced: list[Displaced] = field(default_factory=list)
    knocks: list[Knock] = field(default_factory=list)

    @property
    def key(self) -> int:
        return keys.board(self.index, self.epoch)

    @property
    def page(self) -> int:
        return keys.page(self.index)

    def marker(self, marker: int) -> Marker:
        return next(m for m in self.board.markers if m.id == marker)

    def place(self, marker: int) -> int:
        """The id that the rig gives to the place where a printed id stands."""
        return self.exchanged.get(marker, marker)
