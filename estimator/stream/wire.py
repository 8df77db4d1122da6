"""What the processes of one stream say to each other. Plain data over private pipes between a parent and its own
children; nothing that comes from outside is ever unpickled."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ...factors.measurements import Event, StereoFrame
from ...factors.rig import Rig
from ...frontends.stereo.atlas import Memorable
from ...io.live.interfaces import Outline
from ..decision import Decision
from ..items import Item
from ..result import CalibrationEstimate, PipeEstimate, PointEstimate
from ..validated_range import ValidatedRange
from .settings import StreamSettings

if TYPE_CHECKING:
    from ..sensing import Sensed  # loads all front ends

Float = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Group:
    """Messages of one stamp, for the front ends."""

    items: list[Item]


@dataclass(frozen=True, slots=True)
class Tracked:
    """From the tracking to the other front ends: a group, and what became of its pair."""

    items: list[Item]
    frame: StereoFrame | None
    """None where there is no pair, or none that can be used."""
    memorable: Memorable | None = None
    """What it added to what can be found again."""


@dataclass(frozen=True, slots=True)
class Frame:
    """From the tracking: how the mobile camera moved."""

    stamp_ns: int
    last_T_this: Float
    """Shape (4, 4)."""
    is_keyframe: bool
    lost: bool
    inliers: int
    taken_ns: int = 0
    """When the tracking took the pair, by the monotonic clock, which is the same for all processes."""
    tracked_ns: int = 0
    """When it was done."""
    cpu_s: float = 0.0
    """Processor time that it took."""
    early: bool = False
    """By the flow alone, of a keyframe that is still in the making: it comes again, with the same stamp."""


@dataclass(frozen=True, slots=True)
class Worked:
    """From the front ends: a group is done, or could not be tracked."""

    outlines: Mapping[str, tuple[Outline, ...]] = field(default_factory=dict)
    """Markers seen, by camera."""
    stamp_ns: int = 0
    problem: str | None = None
    """Why something in it was refused."""
    picks: int = 0
    cpu_s: float = 0.0
    """Processor time that it took."""
    left_out: int = 0
    """Images of the machine's camera that were left out, because the front ends are behind."""
    unreadable: tuple[str, ...] = ()
    """Topics of images in it that cannot be decoded."""
    thinned: int = 0
    """Frames that the graph was spared, see `thinning`."""


@dataclass(frozen=True, slots=True)
class LateClick:
    """Clicks in a frame that has passed, with all that is needed to make it a keyframe after the fact."""

    sensed: "Sensed"


@dataclass(frozen=True, slots=True)
class Place:
    """Where something stands in {o}."""

    matrix: Float
    """Shape (4, 4)."""
    covariance: Float | None
    """Shape (6, 6), rotation first, body frame."""


@dataclass(frozen=True, slots=True)
class Answer:
    """From the graph: what is known now."""

    stamp_ns: int
    """Of the newest measurement that was worked in."""
    keyframe_ns: int | None
    """Stamp of the newest keyframe; None while the camera has no place."""
    places: Mapping[str, Place]
    """`m` at that keyframe, `b`, and the boards."""
    points: tuple[PointEstimate, ...] = ()
    """In {b}, with the covariance of the moment of the last look at a board."""
    joint_m2: Float | None = None
    """Shape (3 n, 3 n), of all n points together, in their order."""
    pipes: tuple[PipeEstimate, ...] = ()
    decisions: tuple[Decision, ...] = ()
    """Of the cut plan, as if asked at the last look at a board."""
    calibration: tuple[CalibrationEstimate, ...] = ()
    events: tuple[Event, ...] = ()
    suspects: tuple[Event, ...] = ()
    """Boards that seem to have been knocked, and about which the graph has not decided."""
    last_tie_ns: int | None = None
    """When a board that ties {b} was last seen."""
    consistent: bool = True
    reasons: tuple[str, ...] = ()
    counts: Mapping[str, int] = field(default_factory=dict)
    cpu_s: float = 0.0
    """Processor time of the graph so far."""


@dataclass(frozen=True, slots=True)
class Order:
    """To the graph or the front ends: `reset`, `freeze`, `release`, `save`, `finish`."""

    what: str


@dataclass(frozen=True, slots=True)
class Done:
    """An order was carried out, or why it was not."""

    what: str
    text: str
    failed: bool = False


@dataclass(frozen=True, slots=True)
class Ready:
    """A process has loaded what it needs."""

    who: str


@dataclass(frozen=True, slots=True)
class Died:
    """A process ends by something that should not have happened."""

    who: str
    trace: str
    refusal: bool = False
    """It cannot begin with what it was given, and `trace` says why in one line."""


@dataclass(frozen=True, slots=True)
class GraphTask:
    """What the graph's process is started with."""

    rig: Rig
    settings: StreamSettings
    prior: Path | None
    """A checkpoint to begin with."""
    checkpoint: Path | None
    validated: ValidatedRange | None
    patient: bool = False
    """The sources wait, so that no pose is late."""
