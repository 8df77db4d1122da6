"""What front ends are fed with. It loads no front end: whoever only hands messages on starts quickly."""

from collections.abc import Iterable

from ..factors.errors import LogError
from ..factors.rig import Rig
from ..io.messages import DepthBody, ImageBody, Message
from ..io.pairing import StereoPair

Item = Message | StereoPair

COMPRESSED = "/compressed"
COLOUR_PERIOD_NS = 1_000_000_000
"""Boards in the Kinect's colour image: once a second is enough for a machine that stands still."""


def wanted_topics(rig: Rig) -> frozenset[str]:
    """The topics that the estimator reads; never the truth."""
    topics = {rig.picks_topic, rig.kinect.points_topic}
    for name in ("m_left", "m_right", "b_rgb", "b_depth"):
        camera = getattr(rig.cameras, name)
        topics |= {camera.image_topic, camera.image_topic + COMPRESSED, camera.info_topic}
        if camera.markers_topic:
            topics.add(camera.markers_topic)
    return frozenset(topics)


def plain(message: Message) -> Message:
    """A compressed topic counts as its raw one."""
    if not message.topic.endswith(COMPRESSED):
        return message
    topic = message.topic.removesuffix(COMPRESSED)
    return Message(topic, message.log_time_ns, message.stamp_ns, message.frame_id, message.body)


def unreadable(items: Iterable[Item]) -> tuple[str, ...]:
    """Topics of images whose pixels cannot be decoded."""
    found = []
    for item in items:
        for message in (item.left, item.right) if isinstance(item, StereoPair) else (item,):
            try:
                if isinstance(message.body, ImageBody):
                    message.body.pixels()
                elif isinstance(message.body, DepthBody):
                    message.body.depth_m()
            except LogError:
                found.append(message.topic)
    return tuple(found)
