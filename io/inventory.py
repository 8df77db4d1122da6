"""What is in a recording: topics, rates, stamps, image sizes, calibrations, picks; read once, in flat memory."""

from array import array
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ..factors.camera import CameraModel
from ..factors.errors import LogError
from .messages import CameraInfoBody, DepthBody, DetectionsBody, ImageBody, Message, PickBody
from .pixels import RawPixels
from .reader import LogReader

Int = NDArray[np.int64]
PICKS_KEPT = 10_000


@dataclass(frozen=True, slots=True)
class StampCheck:
    """What a topic's stamps are like, in the order of the recording."""

    rate_hz: float | None
    """From the median step; None with fewer than two stamps."""
    largest_gap_s: float
    gap_at_s: float
    """Stamp before the largest gap."""
    gaps: int
    """Steps of more than five usual ones."""
    backwards: int
    duplicated: int
    unset: int


@dataclass(slots=True)
class TopicInventory:
    """One topic."""

    topic: str
    type_name: str
    encoding: str
    messages: int = 0
    kind: str = "other"
    """`image`, `depth`, `calibration`, `cloud`, `markers`, `pick`, `pose`, `points`, `json` or `other`."""
    frame_id: str = ""
    size: tuple[int, int] | None = None
    """Width and height of the first image."""
    camera: CameraModel | None = None
    """The first calibration."""
    calibration_changes: int = 0
    stamps_ns: "array[int]" = field(default_factory=lambda: array("q"))
    families: set[str] = field(default_factory=set)
    marker_ids: dict[int, int] = field(default_factory=dict)
    """How often each marker was seen."""

    def stamps(self) -> Int:
        """Shape (messages,), in the order of the recording."""
        return np.frombuffer(self.stamps_ns, dtype=np.int64) if self.stamps_ns else np.zeros(0, np.int64)


@dataclass(slots=True)
class Inventory:
    """One recording."""

    name: str
    topics: dict[str, TopicInventory] = field(default_factory=dict)
    picks: list[tuple[int, PickBody]] = field(default_factory=list)
    """Stamp and pick, the first ones."""
    problems: list[str] = field(default_factory=list)
    """What the reader could not read, and images that cannot be decoded."""
    rig_yaml: bytes | None = None
    profile: str = ""
    start_ns: int | None = None
    end_ns: int | None = None
    """Of the recording (log times)."""


_KINDS = {
    "ImageBody": "image",
    "DepthBody": "depth",
    "CameraInfoBody": "calibration",
    "CloudBody": "cloud",
    "DetectionsBody": "markers",
    "PickBody": "pick",
    "PoseBody": "pose",
    "PointsBody": "points",
    "JsonBody": "json",
}


def take_inventory(reader: LogReader) -> Inventory:
    """Read all of `reader`.

    Raises:
        LogError: not an MCAP.
    """
    inventory = Inventory(reader.name, rig_yaml=reader.attachment("rig.yaml"))
    for message in reader:
        topic = inventory.topics.get(message.topic)
        if topic is None:
            channel = reader.channels[message.topic]
            topic = TopicInventory(message.topic, channel.schema_name, channel.message_encoding)
            inventory.topics[message.topic] = topic
        _note(inventory, topic, message)
    for name, channel in reader.channels.items():  # topics of which no message could be decoded
        inventory.topics.setdefault(name, TopicInventory(name, channel.schema_name, channel.message_encoding))
    inventory.rig_yaml = inventory.rig_yaml or reader.attachments.get("rig.yaml")
    inventory.profile = reader.profile
    inventory.problems[:0] = reader.warnings
    return inventory


def _note(inventory: Inventory, topic: TopicInventory, message: Message) -> None:
    inventory.start_ns = min(message.log_time_ns, inventory.start_ns or message.log_time_ns)
    inventory.end_ns = max(message.log_time_ns, inventory.end_ns or 0)
    topic.messages += 1
    topic.stamps_ns.append(message.stamp_ns)
    body = message.body
    if topic.messages == 1:
        topic.kind = _KINDS.get(type(body).__name__, "other")
        topic.frame_id = message.frame_id
        if isinstance(body, ImageBody | DepthBody):
            topic.size = _size(inventory, body)
    if isinstance(body, CameraInfoBody):
        if topic.camera is not None and not _same(topic.camera, body.camera):
            topic.calibration_changes += 1
        topic.camera = topic.camera or body.camera
    elif isinstance(body, DetectionsBody):
        topic.families.update(body.families)
        for marker in body.ids.tolist():
            topic.marker_ids[marker] = topic.marker_ids.get(marker, 0) + 1
    elif isinstance(body, PickBody) and len(inventory.picks) < PICKS_KEPT:
        inventory.picks.append((message.stamp_ns, body))


def _size(inventory: Inventory, body: ImageBody | DepthBody) -> tuple[int, int] | None:
    if isinstance(body.source, RawPixels):
        return body.source.width, body.source.height
    try:
        shape = body.pixels().shape if isinstance(body, ImageBody) else body.depth_m().shape
    except LogError as error:
        inventory.problems.append(str(error))
        return None
    return shape[1], shape[0]


def _same(a: CameraModel, b: CameraModel) -> bool:
    return (a.width, a.height, a.distortion_model) == (b.width, b.height, b.distortion_model) and all(
        np.array_equal(x, y) for x, y in ((a.K, b.K), (a.D, b.D), (a.rectification, b.rectification))
    )


def check_stamps(stamps_ns: Int) -> StampCheck:
    """Rate, gaps and oddities of stamps, shape (n,), in the order of the recording."""
    set_ns = stamps_ns[stamps_ns > 0]
    steps = np.diff(set_ns)
    forward = steps[steps > 0]
    if forward.size == 0:
        return StampCheck(None, 0.0, 0.0, 0, int((steps < 0).sum()), int((steps == 0).sum()), _unset(stamps_ns))
    usual = float(np.median(forward))
    largest = int(np.argmax(steps))
    return StampCheck(
        rate_hz=1e9 / usual,
        largest_gap_s=float(steps[largest]) / 1e9,
        gap_at_s=float(set_ns[largest]) / 1e9,
        gaps=int((forward > 5 * usual).sum()),
        backwards=int((steps < 0).sum()),
        duplicated=int((steps == 0).sum()),
        unset=_unset(stamps_ns),
    )


def _unset(stamps_ns: Int) -> int:
    return int((stamps_ns <= 0).sum())


def unpaired(left_ns: Iterable[int] | Int, right_ns: Iterable[int] | Int, tolerance_ns: int) -> tuple[int, int, float]:
    """Left and right stamps that have no partner within the tolerance, and the median distance to the nearest (ns)."""
    left, right = np.unique(np.asarray(left_ns)), np.unique(np.asarray(right_ns))
    if left.size == 0 or right.size == 0:
        return left.size, right.size, 0.0
    to_right, to_left = _distance(left, right), _distance(right, left)
    return int((to_right > tolerance_ns).sum()), int((to_left > tolerance_ns).sum()), float(np.median(to_right))


def _distance(stamps: Int, others: Int) -> Int:
    after = np.clip(np.searchsorted(others, stamps), 0, others.size - 1)
    before = np.maximum(after - 1, 0)
    return np.minimum(np.abs(others[after] - stamps), np.abs(others[before] - stamps))
