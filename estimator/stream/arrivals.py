"""Messages as they arrive: when each came, which tell nothing new, and a picture now and then for people."""

from collections import OrderedDict

import numpy as np

from ...factors.rig import Rig
from ...io.messages import CameraInfoBody, ImageBody, Message
from ..items import COLOUR_PERIOD_NS, Item
from .settings import StreamSettings

KEPT = 4000
PICTURES = 20


class Arrivals:
    """Of one run. `arrived` and `picture` may be called from another thread than the rest."""

    def __init__(self, rig: Rig, settings: StreamSettings) -> None:
        self._colour_topic = rig.cameras.b_rgb.image_topic
        self._settings = settings
        self._arrived: OrderedDict[int, int] = OrderedDict()
        self._pictures: OrderedDict[int, Message] = OrderedDict()
        self._next_image_ns = 0
        self._known: dict[str, CameraInfoBody] = {}
        self._next_colour_ns = 0

    def note(self, message: Message, arrived_ns: int) -> None:
        """Remembers when an image came; of the two of a moment the later one stays."""
        if isinstance(message.body, ImageBody) and message.stamp_ns > 0:
            self._arrived[message.stamp_ns] = arrived_ns
            while len(self._arrived) > KEPT:
                self._arrived.popitem(last=False)

    def arrived(self, stamp_ns: int) -> int | None:
        """When the images of a stamp had come; once."""
        return self._arrived.pop(stamp_ns, None)

    def forget_calibrations(self) -> None:
        """They are to be handed on again."""
        self._known.clear()

    def redundant(self, message: Message) -> bool:
        """Repetitions of a calibration, and colour images beyond what is looked at."""
        body = message.body
        if isinstance(body, CameraInfoBody):
            known = self._known.setdefault(message.topic, body)
            return known is not body and np.array_equal(known.camera.K, body.camera.K)
        if isinstance(body, ImageBody) and message.topic == self._colour_topic:
            if abs(self._next_colour_ns - message.stamp_ns) > 2 * COLOUR_PERIOD_NS:
                self._next_colour_ns = message.stamp_ns
            if message.stamp_ns < self._next_colour_ns:
                return True
            self._next_colour_ns = message.stamp_ns + COLOUR_PERIOD_NS
        return False

    def keep_picture(self, group: list[Item]) -> None:
        """One image now and then for people to look at."""
        first, period_ns = group[0], self._settings.image_period_ns
        if isinstance(first, Message):
            return
        if abs(self._next_image_ns - first.stamp_ns) > 5 * period_ns:
            self._next_image_ns = min(self._next_image_ns, first.stamp_ns)
        if first.stamp_ns < self._next_image_ns:
            return
        self._next_image_ns = first.stamp_ns + period_ns
        self._pictures[first.stamp_ns] = first.left
        while len(self._pictures) > PICTURES:
            self._pictures.popitem(last=False)

    def picture(self, stamp_ns: int) -> Message | None:
        """The kept image of a stamp; once."""
        return self._pictures.pop(stamp_ns, None)
