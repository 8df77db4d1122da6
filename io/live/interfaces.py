"""What a live estimator and the world agree on: sources of messages, sinks of updates, commands of the operator.

Plain data and protocols, no transport. A source delivers from a thread of its own; a sink takes updates into a bounded
queue of its own and never makes its caller wait. Whatever is lost on either side is counted.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ...factors.measurements import Float
from ..messages import Message

Clock = Callable[[], int]
"""Nanoseconds since 1970. Handed in, so that tests and replays have their own."""
Deliver = Callable[[Message], None]
"""Takes one message. Returns at once, except to a source that is `patient`: there it may wait for room."""


class Source(Protocol):
    """Where messages come from."""

    @property
    def name(self) -> str:
        """For people: kind and address."""
        ...

    @property
    def patient(self) -> bool:
        """Whether `deliver` may keep the source waiting: a recording can wait, a network must not."""
        ...

    def start(self, deliver: Deliver) -> None:
        """Begin to deliver from a thread of the source's own. `log_time_ns` is the time of receipt.

        Malformed messages are counted and skipped. A link that is lost is opened again.

        Raises:
            SurecutError: the source can never work (no such file, address not understood).
        """
        ...

    def stop(self) -> None:
        """End delivery; returns when nothing will be delivered any more. Twice is once."""
        ...

    def ended(self) -> bool:
        """Whether nothing will come any more: the recording or the pipe is at its end, or `stop` was called."""
        ...

    def connected(self) -> bool:
        """Whether the link stands now. Says nothing about whether messages come."""
        ...

    def status(self) -> str:
        """One line for people: what it is connected to, or why it is not, and the last thing that was wrong."""
        ...

    def counters(self) -> Mapping[str, int]:
        """Totals since `start`: `received` (all that arrived), `delivered`, and what was skipped, by reason.

        Reasons: `malformed`, `oversized`, `ignored` (a topic that nobody asked for), `unknown_type`,
        `unknown_encoding`, `wrong_type`, `unstamped`, `stamp_outlier`, `size_changed`, `calibration_changed`,
        `other_publisher`, `redundant` (an image that comes uncompressed too), `not_finite`, `dropped`; `reconnects`
        and `clock_jumps` tell of the link. A name may be absent until it has happened.
        """
        ...

    def by_topic(self) -> Mapping[str, Mapping[str, int]]:
        """Per counter, how often by topic; topics beyond a bound are summed under `other`."""
        ...


class Severity(StrEnum):
    """How bad a fault is."""

    INFORMATION = "information"
    WARNING = "warning"
    ERROR = "error"
    """No answer of the estimator may be used while it lasts."""


class HealthState(StrEnum):
    """The process in one word."""

    STARTING = "starting"
    OK = "ok"
    DEGRADED = "degraded"
    FAILED = "failed"


@dataclass(frozen=True, slots=True)
class Fault:
    """Something that is wrong now."""

    name: str
    """Fixed word for programs, such as `camera_frozen`."""
    since_ns: int
    text: str
    """One line for people: what, where, and the cure."""
    severity: Severity


@dataclass(frozen=True, slots=True)
class Health:
    """The state and what it is due to."""

    state: HealthState
    faults: tuple[Fault, ...] = ()


@dataclass(frozen=True, slots=True)
class LivePose:
    """`parent_T_name`."""

    matrix: Float
    """Shape (4, 4)."""
    covariance: Float | None
    """Shape (6, 6), translation first, fixed axes of the parent, m and rad; None where it was not computed."""
    parent: str = "o"


@dataclass(frozen=True, slots=True)
class LivePoint:
    """A pipe point in the robot's frame, its covariance from the joint with the robot's pose."""

    name: str
    role: str
    """`cut`, `grasp` or `other`."""
    xyz_m: Float
    """Shape (3,), in {b}."""
    covariance_m2: Float
    """Shape (3, 3)."""
    verdict: str
    """May we cut here: `GO`, `NO-GO` or `MEASURE MORE`; `EXPIRED` when the answer is too old to be used."""
    age_s: float
    """Since the last measurement that ties this point to {b}."""
    axis: Float | None = None
    """Shape (3,), unit direction of the pipe's axis in {b}, where a pipe is known."""
    radius_m: float | None = None
    """Of that pipe."""


@dataclass(frozen=True, slots=True)
class LiveUpdate:
    """One state of the estimate. Plain data: sinks read it from their own threads."""

    stamp_ns: int
    """Time of the newest measurement in it."""
    sent_ns: int
    """When it was published."""
    poses: Mapping[str, LivePose]
    """By name: `m`, `b`, `f0`, ..."""
    points: tuple[LivePoint, ...]
    verdict: str
    """The worst of the points' verdicts, with its reason, in one line."""
    age_s: float
    """Of the oldest answer in it."""
    health: Health
    counters: Mapping[str, int] = field(default_factory=dict)
    """Of the whole process: received, dropped, malformed, ... by source, queue and sink."""
    robot_frame: str = "b"
    """Frame of the points: `b`, or `b1`, ... once the base has been moved."""
    points_stamp_ns: int = 0
    """Up to when measurements are in the points; 0 while nothing is known."""
    points_covariance_m2: Float | None = None
    """Shape (3 n, 3 n), of all points together in their order: they share the errors of machine and calibration."""


@dataclass(frozen=True, slots=True)
class Outline:
    """A marker as detected in an image."""

    label: str
    """Board and number, such as `f0/7`."""
    corners_px: Float
    """Shape (4, 2), raw pixels, OpenCV convention."""
    used: bool
    """Whether the estimate uses it."""


@dataclass(frozen=True, slots=True)
class LiveImage:
    """One input image with what was found in it, for people to look at and to click on."""

    topic: str
    """The input topic that it came on."""
    stamp_ns: int
    frame_id: str
    """Camera: `m_left`, `m_right` or `b_rgb`."""
    pixels: NDArray[np.uint8]
    """Shape (height, width) grey or (height, width, 3) BGR. Not copied: do not change it afterwards."""
    outlines: tuple[Outline, ...] = ()
    points_px: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    """Pipe points by name where the estimate projects them into this image, raw pixels."""


@dataclass(frozen=True, slots=True)
class Pick:
    """A click of the operator."""

    camera: str
    """`m_left`, `m_right` or `b_rgb`."""
    point_id: str
    role: str
    """`cut`, `grasp` or `other`."""
    px: tuple[float, float]
    """Raw pixels, OpenCV convention."""
    stamp_ns: int
    """Of the image that was clicked; 0 for the newest."""
    sigma_px: float


@dataclass(frozen=True, slots=True)
class Reset:
    """Forget map, poses and points, and begin again."""


@dataclass(frozen=True, slots=True)
class Freeze:
    """Hold the calibration where it is, or let it move again."""

    frozen: bool = True


@dataclass(frozen=True, slots=True)
class Save:
    """Write a checkpoint now."""


Command = Pick | Reset | Freeze | Save


@dataclass(frozen=True, slots=True)
class Reply:
    """What became of a command."""

    accepted: bool
    text: str
    unauthorised: bool = False
    """Refused for want of the token."""


OnCommand = Callable[[Command], Reply]
"""Takes a command that was checked (form, range, token). Called from a network thread: queue it and return at once."""


class Sink(Protocol):
    """Where updates go."""

    @property
    def name(self) -> str:
        """For people: kind and address."""
        ...

    def start(self, on_command: OnCommand | None = None) -> None:
        """Open it; sinks without an inbound side ignore `on_command`. None: every command is refused.

        Raises:
            SurecutError: it can never work (address in use or not allowed, folder missing).
        """
        ...

    def publish(self, update: LiveUpdate) -> None:
        """Hand over an update; never waits, never raises. What does not fit is dropped, oldest first, and counted."""
        ...

    def image(self, image: LiveImage) -> None:
        """Hand over an image; as `publish`. Sinks that show none ignore it at no cost."""
        ...

    def stop(self) -> None:
        """Send what is queued for at most a second, then close. Twice is once."""
        ...

    def counters(self) -> Mapping[str, int]:
        """Totals since `start`: `published`, `sent`, `dropped`, `errors`, `clients`; of the inbound side `commands`,
        `malformed`, `unauthorised`, `refused`."""
        ...
