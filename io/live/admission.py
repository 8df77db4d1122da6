"""Which of the messages that can be decoded are let in: one sender, one type, one size, one calibration per topic.

What is refused here would spoil an estimate without ever being malformed. The first of its kind sets the rule.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from ...factors.camera import CameraModel
from ..messages import (
    Body,
    CameraInfoBody,
    CloudBody,
    DepthBody,
    DetectionsBody,
    ImageBody,
    Message,
    PickBody,
    PoseBody,
)
from ..pixels import CompressedPixels
from .sniff import image_size

COMPRESSED = ("/compressedDepth", "/compressed")
"""What image_transport appends to the topic of an image for its other forms."""
Expected = Mapping[str, tuple[type[Body], ...]]
"""What may come on a topic. Topics that are not in it are not wanted."""


@dataclass(frozen=True, slots=True)
class Limits:
    """Bounds on what a stranger may make the program hold or do."""

    message_bytes: int = 64 << 20
    image_pixels: int = 1 << 24
    channels: int = 1024
    """Remembered at a time."""
    sender_silence_ns: int = 2_000_000_000
    """After so long without a word another sender may take over a topic."""
    stamp_error_ns: int = 5_000_000_000
    """How far the difference of stamp and receipt may depart from what it was."""
    stamp_confirmations: int = 10
    """So many in a row that agree with each other are a clock that jumped, not errors."""


@dataclass(slots=True)
class _Topic:
    """What the messages before this one were like."""

    sender: str = ""
    heard_ns: int = 0
    size: tuple[int, int] | None = None
    camera: CameraModel | None = None
    offset_ns: int | None = None
    """Stamp less receipt."""
    strayed: list[int] = field(default_factory=list)
    """Offsets of the messages just refused for theirs."""


class Admission:
    """The rules of one source.

    Args:
        expected: types by topic; None: any.
    """

    def __init__(self, expected: Expected | None, limits: Limits) -> None:
        self._expected = expected
        self._limits = limits
        self._topics: dict[str, _Topic] = {}

    def wanted(self, topic: str) -> bool:
        """Whether anybody asked for the topic."""
        return self._expected is None or topic in self._expected

    def forget_senders(self) -> None:
        """The next sender on each topic is the one."""
        for known in self._topics.values():
            known.sender = ""

    def refusal(self, message: Message, sender: str, received_ns: int) -> str | None:
        """Why a message is not let in, as the name of a counter; None: it is.

        Args:
            sender: tells the publishers of one topic apart.
            received_ns: by the clock that `stamp_outlier` is about.
        """
        if self._expected is not None and not isinstance(message.body, self._expected.get(message.topic, ())):
            return "wrong_type"
        if not _is_finite(message.body):
            return "not_finite"
        if self._is_second_form(message, received_ns):
            return "redundant"
        known = self._topics.get(message.topic)
        if known is None:
            if len(self._topics) >= self._limits.channels:
                return "ignored"
            known = self._topics[message.topic] = _Topic()
        return (
            self._sender(known, message.body, sender, received_ns)
            or self._stamp(known, message, received_ns)
            or self._size(known, message.body)
            or _calibration(known, message.body)
        )

    def _is_second_form(self, message: Message, received_ns: int) -> bool:
        """Whether the same image comes uncompressed too."""
        plain = plain_topic(message.topic)
        if plain == message.topic or not isinstance(message.body, ImageBody | DepthBody):
            return False
        known = self._topics.get(plain)
        return known is not None and 0 <= received_ns - known.heard_ns < self._limits.sender_silence_ns

    def _sender(self, known: _Topic, body: Body, sender: str, received_ns: int) -> str | None:
        """Two cameras on one topic would be taken for one that leaps to and fro."""
        if not isinstance(body, ImageBody | DepthBody | CloudBody | CameraInfoBody | DetectionsBody):
            return None
        silent = not 0 <= received_ns - known.heard_ns < self._limits.sender_silence_ns
        if known.sender and known.sender != sender and not silent:
            return "other_publisher"
        known.sender, known.heard_ns = sender, received_ns
        return None

    def _stamp(self, known: _Topic, message: Message, received_ns: int) -> str | None:
        """A clock may be wrong by any amount, as long as it goes on so; one stamp from the future is an error."""
        if isinstance(message.body, CameraInfoBody | PickBody):
            return None  # a calibration holds always, and a click may be in an image of a while ago
        if message.stamp_ns <= 0:
            return "unstamped"
        offset = message.stamp_ns - received_ns
        if known.offset_ns is None:
            known.offset_ns = offset
        difference = offset - known.offset_ns
        if abs(difference) <= self._limits.stamp_error_ns:
            known.offset_ns += difference // 16  # clocks drift apart over a shift
            known.strayed.clear()
            return None
        if known.strayed and abs(offset - known.strayed[-1]) > self._limits.stamp_error_ns:
            known.strayed.clear()
        known.strayed.append(offset)
        if len(known.strayed) < self._limits.stamp_confirmations:
            return "stamp_outlier"
        known.offset_ns = offset
        known.strayed.clear()
        return "clock_jumps"

    def _size(self, known: _Topic, body: Body) -> str | None:
        if not isinstance(body, ImageBody | DepthBody):
            return None
        source = body.source
        if isinstance(source, CompressedPixels):
            start = 12 if "compressedDepth" in source.format else 0
            size = image_size(source.data[start:].data)
            if size is None:
                return "malformed"
        else:
            size = source.width, source.height
        if min(size) <= 0 or size[0] * size[1] > self._limits.image_pixels:
            return "oversized" if min(size) > 0 else "malformed"
        known.size = known.size or size
        return None if size == known.size else "size_changed"


def plain_topic(topic: str) -> str:
    """The topic of the uncompressed form of an image."""
    for suffix in COMPRESSED:
        topic = topic.removesuffix(suffix)
    return topic


def _calibration(known: _Topic, body: Body) -> str | None:
    if not isinstance(body, CameraInfoBody):
        return None
    known.camera = known.camera or body.camera
    return None if _same(known.camera, body.camera) else "calibration_changed"


def _same(a: CameraModel, b: CameraModel) -> bool:
    return (
        (a.width, a.height, a.distortion_model, a.baseline_m) == (b.width, b.height, b.distortion_model, b.baseline_m)
        and np.array_equal(a.K, b.K)
        and np.array_equal(a.D, b.D)
        and np.array_equal(a.rectification, b.rectification)
    )


def _is_finite(body: Body) -> bool:
    if isinstance(body, DetectionsBody):
        return bool(np.isfinite(body.corners_px).all())
    if isinstance(body, PoseBody) and body.covariance is not None:
        return bool(np.isfinite(body.covariance).all())
    return True
