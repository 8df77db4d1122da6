"""What is wrong now, by name, within two seconds: cameras, clocks, topics, pairs, calibration, boards, the answer."""

import zlib
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from ...factors.rig import Rig
from ...io.live.interfaces import Fault, Health, HealthState, Severity
from ...io.messages import CameraInfoBody, DepthBody, ImageBody, Message
from .settings import S, StreamSettings
from .wire import Answer

CLOCK_MESSAGES = 8
"""Messages by which a topic's clock is judged: the least delayed of so many tells."""
RECENT_NS = 2 * S
"""By receipt: what has been counted more recently than this is wrong now."""
KNOCK_NS = 60 * S
"""So long, by stamp, a knock of a board is told."""

REFUSALS = {
    "size_changed": "the image size has changed; restart the camera or the estimator",
    "calibration_changed": "another calibration came; the first one counts; restart to use the new one",
    "other_publisher": "a second sender publishes on the topic; stop one of them",
    "wrong_type": "messages of a wrong type; correct the topic in the rig file",
    "stamp_outlier": "stamps far from the clock's; synchronise the clocks",
    "malformed": "messages that cannot be decoded",
    "oversized": "messages beyond the size limit",
    "not_finite": "messages with numbers that are not finite",
    "dropped": "messages came faster than they are worked on; the oldest were dropped",
    "unstamped": "messages without header.stamp; set it in the driver",
}
"""Counters of the sources that are faults while they grow."""


@dataclass(slots=True)
class _Topic:
    heard_ns: int = 0
    offsets: deque[int] = field(default_factory=lambda: deque(maxlen=CLOCK_MESSAGES))
    settled_ns: int | None = None
    """Stamp less receipt, before the last messages."""
    print: int | None = None
    same: int = 0


class Monitor:
    """Watches one stream. All times are handed in: `now_ns` is of receipt.

    Args:
        required: topics that must come even if they never have.
    """

    def __init__(self, rig: Rig, settings: StreamSettings) -> None:
        self._settings = settings
        left, right = rig.cameras.m_left.image_topic, rig.cameras.m_right.image_topic
        self._required = {left, right}
        self._topics: dict[str, _Topic] = {}
        self._since: dict[str, tuple[int, str, Severity]] = {}
        self._began_ns: int | None = None
        self._grown: dict[tuple[str, str, str], tuple[int, int]] = {}
        """By reason, topic and who counted: the number, and when it last grew."""
        self._jumped: dict[str, tuple[int, float]] = {}
        """By topic: when its clock jumped, by receipt, and by how much (s)."""
        self._answer: Answer | None = None
        self._astray = True
        self._unpaired = 0.0
        self._pose_ns: int | None = None

    # What comes in --------------------------------------------------------------------------------------------

    def heard(self, message: Message, now_ns: int) -> None:
        """Every message, as it comes."""
        self._began_ns = now_ns if self._began_ns is None else self._began_ns
        topic = self._topics.setdefault(message.topic, _Topic())
        topic.heard_ns = now_ns
        if message.stamp_ns > 0 and not isinstance(message.body, CameraInfoBody):
            self._clock(message.topic, topic, message.stamp_ns - now_ns, now_ns)
        if isinstance(message.body, ImageBody | DepthBody):
            found = zlib.crc32(np.ascontiguousarray(message.body.source.data).data)
            topic.same = topic.same + 1 if found == topic.print else 0
            topic.print = found

    def _clock(self, name: str, topic: _Topic, offset_ns: int, now_ns: int) -> None:
        """Delay only makes stamp less receipt smaller: the largest of several is the clock's own."""
        topic.offsets.append(offset_ns)
        if len(topic.offsets) < CLOCK_MESSAGES:
            return
        largest = max(topic.offsets)
        if topic.settled_ns is not None and abs(largest - topic.settled_ns) > self._settings.clock_jump_ns:
            self._jumped[name] = now_ns, (largest - topic.settled_ns) / S
        topic.settled_ns = largest

    def paired(self, unpaired: deque[bool]) -> None:
        """Whether each of the last moments lacked one of its two images."""
        self._unpaired = sum(unpaired) / len(unpaired) if len(unpaired) == unpaired.maxlen else 0.0

    def counted(self, by_topic: Mapping[str, Mapping[str, int]], now_ns: int, whose: str = "") -> None:
        """Refusals, by reason and topic.

        Args:
            whose: who counted them: two sources may have one topic.
        """
        for reason in REFUSALS.keys() & by_topic.keys():
            for topic, value in by_topic[reason].items():
                key = reason, topic, whose
                if value > self._grown.get(key, (0, 0))[0]:
                    self._grown[key] = value, now_ns

    def answered(self, answer: Answer) -> None:
        self._answer = answer
        self._astray = answer.keyframe_ns is None

    # What is wrong --------------------------------------------------------------------------------------------

    def health(self, now_ns: int, stamp_ns: int) -> Health:
        """The state at a moment.

        Args:
            stamp_ns: newest stamp.
        """
        found = {fault[0]: fault for fault in self._found(now_ns, stamp_ns)}
        self._since = {name: self._since.get(name, (now_ns, text, bad)) for name, text, bad in found.values()}
        faults = tuple(Fault(name, self._since[name][0], text, bad) for name, text, bad in found.values())
        if any(f.severity is Severity.ERROR for f in faults):
            return Health(HealthState.FAILED, faults)
        if self._answer is None:
            return Health(HealthState.STARTING, faults)
        warned = any(f.severity is Severity.WARNING for f in faults)
        return Health(HealthState.DEGRADED if warned else HealthState.OK, faults)

    def _found(self, now_ns: int, stamp_ns: int) -> list[tuple[str, str, Severity]]:
        return [
            *self._silent(now_ns),
            *self._frozen(),
            *self._clocks(now_ns),
            *self._pairs(),
            *self._refused(now_ns),
            *self._told(stamp_ns),
        ]

    def _silent(self, now_ns: int) -> list[tuple[str, str, Severity]]:
        faults = []
        for name in sorted(self._required | self._topics.keys()):
            topic = self._topics.get(name)
            if topic is not None and isinstance(topic.print, int | None) and topic.print is None:
                if name not in self._required:
                    continue  # clicks and calibrations come when they come
            since = topic.heard_ns if topic is not None else self._began_ns
            if since is not None and now_ns - since > self._settings.silence_ns:
                seconds = (now_ns - since) / S
                bad = Severity.ERROR if name in self._required else Severity.WARNING
                text = f"{name}: nothing for {seconds:.1f} s; check the camera and its driver"
                faults.append((f"topic_missing {name}", text, bad))
        return faults

    def _frozen(self) -> list[tuple[str, str, Severity]]:
        return [
            (
                f"camera_frozen {name}",
                f"{name}: {topic.same + 1} images are identical, their stamps go on; restart the camera",
                Severity.ERROR if name in self._required else Severity.WARNING,
            )
            for name, topic in sorted(self._topics.items())
            if topic.same >= self._settings.frozen_frames
        ]

    def _clocks(self, now_ns: int) -> list[tuple[str, str, Severity]]:
        self._jumped = {n: j for n, j in self._jumped.items() if now_ns - j[0] < 5 * RECENT_NS}
        return [
            (
                f"clock_jump {name}",
                f"{name}: its clock jumped by {seconds:+.2f} s; synchronise the clocks (NTP or PTP) before the work",
                Severity.WARNING,
            )
            for name, (_, seconds) in sorted(self._jumped.items())
        ]

    def _pairs(self) -> list[tuple[str, str, Severity]]:
        if self._unpaired < self._settings.unpaired_share:
            return []
        text = (
            f"{100 * self._unpaired:.0f} % of the stereo images have no partner of their moment; synchronise the pair"
        )
        return [("pair_apart", text, Severity.ERROR)]

    def _refused(self, now_ns: int) -> list[tuple[str, str, Severity]]:
        faults = []
        for (reason, topic, _), (value, at_ns) in sorted(self._grown.items()):
            if now_ns - at_ns < RECENT_NS:
                faults.append((f"{reason} {topic}", f"{topic}: {value} {REFUSALS[reason]}", Severity.WARNING))
        return faults

    def _told(self, stamp_ns: int) -> list[tuple[str, str, Severity]]:
        answer = self._answer
        if answer is None:
            return []
        faults = []
        if self._astray:
            text = "the camera has not found its place in the earlier map; show it a board, or what it saw then"
            faults.append(("relocalising", text, Severity.WARNING))
        for row in answer.calibration:
            off = abs(row.value - row.prior) / row.prior_sigma
            if off > self._settings.drift_sigma:
                text = (
                    f"{row.name} is {row.value:.6g} {row.unit}, {off:.1f} sigma from {row.prior:.6g}; calibrate again"
                )
                faults.append((f"calibration_drift {row.name}", text, Severity.WARNING))
        for event in answer.events:
            if event.kind == "board_knocked" and stamp_ns - event.stamp_ns < KNOCK_NS:
                faults.append(("board_knocked", event.text, Severity.WARNING))
            elif event.severity == "error":
                faults.append((event.kind, event.text, Severity.ERROR))
        faults += [(event.kind, event.text, Severity.ERROR) for event in answer.suspects]
        if not answer.consistent:
            reason = answer.reasons[0] if answer.reasons else "residuals"
            faults.append(("inconsistent", f"the data contradict the model: {reason}", Severity.WARNING))
        return faults
