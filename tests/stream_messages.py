"""Images of a stream that tell nothing but when they were made and when they came."""

import numpy as np

from surecut.factors.rig import Rig
from surecut.io.messages import ImageBody, Message
from surecut.io.pixels import RawPixels

RIG = Rig()
LEFT, RIGHT = RIG.cameras.m_left.image_topic, RIG.cameras.m_right.image_topic
MS = 1_000_000
START = 1_700_000_000_000_000_000


def image(topic, stamp_ms, value=0, arrived_ms=None):
    pixels = RawPixels("mono8", 4, 2, 4, False, np.full(8, value % 251, np.uint8))
    arrived = stamp_ms if arrived_ms is None else arrived_ms
    return Message(topic, START + round(arrived * MS), START + round(stamp_ms * MS), "m", ImageBody(pixels, topic))
