"""Live messages by stamp, with no more delay than needed: what belongs together, in order, late data within a window.

A recording can be sorted by waiting long; a live pose cannot wait. Here an image waits only while something is missing:
its partner, or a frame before it, as the rhythm of the stamps tells. Everything that does not move with the mobile
camera passes at once.
"""

from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from ...factors.rig import Rig
from ...io.live.tally import Tally
from ...io.messages import CameraInfoBody, ImageBody, Message, PickBody
from ...io.pairing import StereoPair
from ..items import Item, plain

TOLERANCE_NS = 1_000_000
"""Stamps nearer to each other than this are one moment."""
WAITING = 64
"""Moments that wait at most."""
ALIVE_NS = 2_000_000_000
"""A topic that has been silent for so long, by receipt, is not waited for."""
RHYTHM = 20
"""Moments whose spacing is the rhythm."""
STRAY_NS = 5_000_000_000
"""A stamp that departs by more from what stamp less receipt was is not believed."""
CLICKS_NS = 20_000_000
"""Clicks in a picture that has passed wait so long, by receipt, for others in the same picture."""
FOREVER = 1 << 62
JUMPED = 10
"""So many strays in a row that agree are a clock that was set, not errors."""


@dataclass(slots=True)
class _Moment:
    stamp_ns: int
    arrived_ns: int
    """Of its first part, by receipt."""
    changed_ns: int
    """Of its last part."""
    parts: dict[str, Message] = field(default_factory=dict)


class LiveOrder:
    """Messages of one run in the order in which front ends want them.

    Args:
        window_ns: how long, by receipt, a moment waits for what is missing.
    """

    def __init__(self, rig: Rig, window_ns: int) -> None:
        self._left, self._right = rig.cameras.m_left.image_topic, rig.cameras.m_right.image_topic
        markers = (rig.cameras.m_left.markers_topic, rig.cameras.m_right.markers_topic)
        self._mobile = {self._left, self._right, *(topic for topic in markers if topic)}
        self._window_ns = window_ns
        self._moments: list[_Moment] = []
        self._picks: list[tuple[Message, int]] = []
        """Clicks and when they came."""
        self._heard: dict[str, int] = {}
        self._released_ns: int | None = None
        self._steps: deque[int] = deque(maxlen=RHYTHM)
        self._offset_ns: int | None = None
        self._strayed: list[int] = []
        self._strays = Tally()
        self.counts: Counter[str] = Counter()
        """`late`, `repeated`, `unpaired`, `paired`, `stamp_outlier`, `clock_jumps`."""
        self.unpaired: deque[bool] = deque(maxlen=40)
        """Whether each of the last moments lacked an image."""

    def add(self, message: Message, now_ns: int) -> list[list[Item]]:
        """A message as it comes; groups that are ready.

        Args:
            now_ns: time of receipt.
        """
        message = plain(message)
        if not isinstance(message.body, PickBody | CameraInfoBody) and not self._believed(message.stamp_ns, now_ns):
            self.counts["stamp_outlier"] += 1
            self._strays.add("stamp_outlier", message.topic)
            return []
        if isinstance(message.body, PickBody) and message.body.camera != "b_rgb":
            self._picks = [*self._picks, (message, now_ns)][-WAITING:]
            return self.due(now_ns)
        if message.topic not in self._mobile:
            return [[message], *self.due(now_ns)]
        if self._released_ns is not None and message.stamp_ns <= self._released_ns + TOLERANCE_NS:
            self.counts["late"] += 1
            return []
        self._heard[message.topic] = now_ns
        moment = self._moment(message.stamp_ns, now_ns)
        if message.topic in moment.parts:
            self.counts["repeated"] += 1
        else:
            moment.parts[message.topic] = message
            moment.changed_ns = now_ns
        return self.due(now_ns)

    def strays(self) -> Mapping[str, int]:
        """Messages whose stamps were not believed, by topic."""
        return self._strays.by_topic().get("stamp_outlier", {})

    def due(self, now_ns: int) -> list[list[Item]]:
        """Groups that are ready, or have waited long enough."""
        groups: list[list[Item]] = []
        while self._moments and self._ready(self._moments[0], now_ns):
            groups += self._release(self._moments.pop(0))
        return [*groups, *self._late_picks(now_ns)]

    def rest(self) -> list[list[Item]]:
        """Everything that waits: nothing more will come."""
        groups: list[list[Item]] = []
        while self._moments:
            groups += self._release(self._moments.pop(0))
        self._released_ns = FOREVER
        return [*groups, *self._late_picks(FOREVER)]

    def _believed(self, stamp_ns: int, now_ns: int) -> bool:
        """Is the stamp near where this stream's clock is? One message from the future would make all others late.

        Clicks may be in images of a while ago, and calibrations carry any stamp: they are not asked.
        """
        if stamp_ns <= 0:
            return True  # a click in the newest image has no stamp of its own
        offset = stamp_ns - now_ns
        known = self._offset_ns
        if known is None or abs(offset - known) <= STRAY_NS:
            self._offset_ns = offset if known is None else known + (offset - known) // 16
            self._strayed.clear()
            return True
        if self._strayed and abs(offset - self._strayed[-1]) > STRAY_NS:
            self._strayed.clear()
        self._strayed.append(offset)
        if len(self._strayed) < JUMPED:
            return False
        self._offset_ns = offset
        self._strayed.clear()
        self._released_ns = None
        self._moments.clear()
        self.counts["clock_jumps"] += 1
        return True

    def _moment(self, stamp_ns: int, now_ns: int) -> _Moment:
        for moment in reversed(self._moments):
            if abs(moment.stamp_ns - stamp_ns) <= TOLERANCE_NS:
                return moment
        made = _Moment(stamp_ns, now_ns, now_ns)
        self._moments.append(made)
        self._moments.sort(key=lambda moment: moment.stamp_ns)
        return made

    def _ready(self, first: _Moment, now_ns: int) -> bool:
        if now_ns - first.arrived_ns >= self._window_ns or len(self._moments) > WAITING:
            return True
        alive = {topic for topic, heard in self._heard.items() if now_ns - heard < ALIVE_NS}
        if alive & {self._left, self._right}:
            alive |= {self._left, self._right}
        if not alive <= first.parts.keys() or self._released_ns is None:
            return False
        if now_ns <= first.changed_ns:
            return False  # what comes at the same time, such as a recorded click, belongs to it
        step = float(np.median(self._steps)) if self._steps else 0.0
        return first.stamp_ns - self._released_ns <= 1.5 * step

    def _release(self, moment: _Moment) -> list[list[Item]]:
        parts = moment.parts
        if self._released_ns is not None:
            self._steps.append(moment.stamp_ns - self._released_ns)
        self._released_ns = moment.stamp_ns
        left, right = parts.pop(self._left, None), parts.pop(self._right, None)
        group: list[Item] = []
        if left is not None and right is not None:
            group.append(StereoPair(left, replace(right, stamp_ns=left.stamp_ns)))
            self.counts["paired"] += 1
        elif left is not None or right is not None:
            self.counts["unpaired"] += 1
        if left is not None or right is not None:
            self.unpaired.append(left is None or right is None)
        group += [part for part in parts.values() if not isinstance(part.body, ImageBody)]
        if group:
            stamp_ns = group[0].stamp_ns
            apart = [abs(pick.stamp_ns - stamp_ns) for pick, _ in self._picks]
            mine = [pick for (pick, _), d in zip(self._picks, apart, strict=True) if d <= TOLERANCE_NS]
            self._picks = [waiting for waiting, d in zip(self._picks, apart, strict=True) if d > TOLERANCE_NS]
            group += [replace(pick, stamp_ns=stamp_ns) for pick in mine]
        return [group] if group else []

    def _late_picks(self, now_ns: int) -> list[list[Item]]:
        """Clicks in frames that have passed: a person is slower than a camera. Those in one picture go together."""
        passed: dict[int, list[Item]] = {}
        waiting = []
        for pick, came_ns in self._picks:
            gone = pick.stamp_ns <= 0 or (self._released_ns is not None and pick.stamp_ns <= self._released_ns)
            if gone and now_ns - came_ns >= CLICKS_NS:
                passed.setdefault(pick.stamp_ns, []).append(pick)
            else:
                waiting.append((pick, came_ns))
        self._picks = waiting
        return list(passed.values())
