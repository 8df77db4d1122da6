"""Messages to measurements: the front ends' half of the loop. It knows no graph, so it can run in another process."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, TypeGuard

import cv2
import numpy as np
from numpy.typing import NDArray

from ..factors.camera import CameraModel
from ..factors.measurements import MarkerSighting, Pick, Rejection, StereoFrame
from ..factors.rig import Rig
from ..frontends.pick_image import CutOut, cut_out
from ..frontends.stereo.atlas import Atlas, Memorable
from ..frontends.stereo.frontend import Early
from ..frontends.stereo.places import place_of
from ..io.messages import CameraInfoBody, CloudBody, DepthBody, DetectionsBody, ImageBody, Message, PickBody
from ..io.ordering import OrderReport, sorted_by_stamp
from ..io.pairing import PairingReport, StereoPair, stereo_pairs
from .bundle import Bundle
from .items import COLOUR_PERIOD_NS, Item, plain
from .sensors import PairImages, Sensors, by_info_topic
from .sides import Sides

if TYPE_CHECKING:
    from .depth_sensor import DepthView


@dataclass(frozen=True, slots=True)
class Sensed:
    """What the front ends make of all messages of one stamp. Plain data: it may cross a process border."""

    bundle: Bundle
    depth: "DepthView | None" = None
    """What the Kinect saw, when enough depth images have gathered."""
    pair: PairImages | None = None
    """The pictures, where the pair is a keyframe or was clicked in."""
    clicked: Mapping[tuple[str, int, str], CutOut] = field(default_factory=dict)
    """What was clicked, by camera, stamp and point id."""
    cameras: Mapping[str, CameraModel] = field(default_factory=dict)
    """Cameras whose calibration has become known with this stamp."""
    atlas: Atlas | None = None
    """What a keyframe adds to what can be found again."""

    @property
    def stamp_ns(self) -> int:
        return self.bundle.stamp_ns


@dataclass(frozen=True, slots=True)
class SensingReport:
    """What can be said of a recording once it has passed."""

    order: OrderReport = field(default_factory=OrderReport)
    pairing: PairingReport = field(default_factory=PairingReport)
    rejected: tuple[Rejection, ...] = ()
    """What the front ends themselves refused."""
    depths: int = 0
    """Depth images and clouds."""


class Sensing:
    """Front ends of one run, fed with messages."""

    def __init__(self, rig: Rig, atlas: Atlas | None = None) -> None:
        """
        Args:
            atlas: what an earlier run saw.
        """
        self.rig = rig
        self.sensors = Sensors(rig, atlas)
        self._order = OrderReport()
        self._pairing = PairingReport()
        self._sides = Sides(rig)
        self._info = by_info_topic(rig)
        self._known: set[str] = set()
        """Cameras whose calibration has been handed on."""
        self._started = False
        """The first pair is a keyframe whatever it shows."""
        self._any_needed = False
        """The same, of what `needed` has let pass."""
        self._needed_cameras: dict[str, CameraModel] = {}
        """The last calibrations that it has let pass, as the decoder gave them: mostly the very same object."""
        self._depths_seen = 0
        self._last_colour_ns: int | None = None
        self._colour: ImageBody | None = None
        """The Kinect's newest colour image, not decoded."""

    def run(self, messages: Iterable[Message]) -> Iterator[Sensed]:
        """Takes messages in the order of the log; yields what is seen at each stamp, in the order of the stamps."""
        for group in self.groups(messages):
            yield self.process(group)

    def groups(self, messages: Iterable[Message]) -> Iterator[list[Item]]:
        """Messages by stamp: sorted, stereo images paired, those of one stamp together."""
        ordered = sorted_by_stamp((plain(m) for m in messages), report=self._order)
        left, right = self.rig.cameras.m_left.image_topic, self.rig.cameras.m_right.image_topic
        return _same_stamp(stereo_pairs(ordered, left, right, report=self._pairing))

    def process(self, group: list[Item]) -> Sensed:
        """All messages of one stamp."""
        frame = self.follow(group)
        return self.look(self.needed(group, frame), frame, group[0].stamp_ns, self.memorable(frame))

    def follow(self, group: list[Item], early: Early | None = None) -> StereoFrame | None:
        """How the mobile camera moved: tracks and motion of the pair in a group, None where there is no pair.

        Args:
            early: told of a keyframe's motion before it is done.

        Raises:
            LogError: the pair cannot be used.
        """
        self.calibrate(group)
        pair = next((images(i) for i in group if isinstance(i, StereoPair)), None)
        return self.sensors.track(pair, _clicked(group), early) if pair is not None else None

    def memorable(self, frame: StereoFrame | None) -> Memorable | None:
        """What the frame that was followed last added to what can be found again."""
        return None if frame is None else self.sensors.memorable()

    def needed(self, group: list[Item], frame: StereoFrame | None) -> list[Item]:
        """What `look` needs of a group that has been followed: most pictures and calibrations tell it nothing new."""
        first, self._any_needed = not self._any_needed, self._any_needed or frame is not None
        shown = frame is None or frame.is_keyframe or first or _clicked(group)
        return [item for item in group if (shown or not isinstance(item, StereoPair)) and not self._known_before(item)]

    def _known_before(self, item: Item) -> bool:
        """Is it the calibration that a camera had already?"""
        if not self.is_calibration(item) or not isinstance(item.body, CameraInfoBody):
            return False
        camera, model = self._info[item.topic], item.body.camera
        known = self._needed_cameras.get(camera) is model
        self._needed_cameras[camera] = model
        return known

    def look(
        self,
        group: list[Item],
        frame: StereoFrame | None,
        stamp_ns: int | None = None,
        memorable: Memorable | None = None,
    ) -> Sensed:
        """Everything else that a group shows.

        Args:
            group: whole, or what is `needed` of it.
            frame: what `follow`, of this object or another, has said of the pair.
            stamp_ns: the group's, where nothing of it may be left.
            memorable: what the frame added to what can be found again.

        Raises:
            LogError: a part of it cannot be used.
        """
        stamp_ns = _stamp(group[0]) if stamp_ns is None else stamp_ns
        self.calibrate(group)
        pair = None
        if frame is not None:
            pair = next((images(i) for i in group if isinstance(i, StereoPair)), None)
        picks = tuple(self._pick(i) for i in group if isinstance(i, Message) and isinstance(i.body, PickBody))
        kept = pair if frame is not None and (frame.is_keyframe or picks or not self._started) else None
        self._started |= frame is not None
        sightings = self._sightings(stamp_ns, group, kept)
        depths = {}
        if pair is not None:
            depths = {p.point_id: d for p in picks if (d := self.sensors.depth_under(p, pair)) is not None}
        fresh = {name: camera for name, camera in self.sensors.cameras.items() if name not in self._known}
        self._known |= fresh.keys()
        return Sensed(
            Bundle(stamp_ns, frame, tuple(sightings), picks, depths),
            self._depth(stamp_ns, group),
            kept,
            self._clicked(picks, pair, group),
            fresh,
            None if memorable is None else _atlas_of(memorable),
        )

    def look_back(self, clicks: Sequence[Message], pair: PairImages, frame: StereoFrame) -> Sensed:
        """Clicks in a frame that has been processed before: what it needs to be a keyframe after all.

        Raises:
            LogError: a click cannot be used.
        """
        picks = tuple(self._pick(click) for click in clicks)
        sightings = [] if frame.is_keyframe else self._sightings(frame.stamp_ns, [], pair)
        bundle = Bundle(frame.stamp_ns, frame, tuple(sightings), picks, self._depths(picks, pair))
        return Sensed(bundle, pair=pair, clicked=self._clicked(picks, pair, []))

    def _depths(self, picks: Sequence[Pick], pair: PairImages) -> dict[str, tuple[float, float]]:
        """Surface depth under clicks, where it can be measured."""
        return {p.point_id: d for p in picks if (d := self.sensors.depth_under(p, pair)) is not None}

    def is_calibration(self, item: Item) -> TypeGuard[Message]:
        """Is it a calibration of one of the cameras?"""
        return isinstance(item, Message) and isinstance(item.body, CameraInfoBody) and item.topic in self._info

    def report(self) -> SensingReport:
        """What was odd, and what was refused, so far."""
        return SensingReport(self._order, self._pairing, tuple(self.sensors.rejected), self._depths_seen)

    def calibrate(self, group: list[Item]) -> None:
        """Calibrations among the messages open their cameras."""
        for item in group:
            if isinstance(item, Message) and isinstance(item.body, CameraInfoBody) and item.topic in self._info:
                self.sensors.calibrate(self._info[item.topic], item.body.camera)

    def camera_of(self, topic: str) -> str | None:
        """The camera that a topic with images or detections belongs to."""
        for name in ("m_left", "m_right", "b_rgb"):
            camera = getattr(self.rig.cameras, name)
            if topic in (camera.markers_topic, camera.image_topic):
                return name
        return None

    def _pick(self, message: Message) -> Pick:
        assert isinstance(message.body, PickBody)
        return self.sensors.pick(message.stamp_ns, message.body)

    def _sightings(self, stamp_ns: int, group: list[Item], pair: PairImages | None) -> list[MarkerSighting]:
        found: list[MarkerSighting] = []
        if pair is not None:
            found += self.sensors.markers("m_left", stamp_ns, pair.left)
            found += self.sensors.markers("m_right", stamp_ns, pair.right)
        for item in group:
            if not isinstance(item, Message):
                continue
            camera = self.camera_of(item.topic)
            if isinstance(item.body, DetectionsBody) and camera is not None:
                found += self.sensors.detections(camera, stamp_ns, item.body)
            if isinstance(item.body, ImageBody) and camera == "b_rgb" and self._colour_due(stamp_ns):
                found += self.sensors.markers("b_rgb", stamp_ns, item.body.pixels())
        if {"m_left", "m_right"} <= {s.camera for s in found}:
            self._sides.look(found, self.sensors.cameras, self.sensors.left_T_right())
        return found

    def _colour_due(self, stamp_ns: int) -> bool:
        """Is it time to look for boards in the machine's colour image?"""
        due = self._last_colour_ns is None or stamp_ns - self._last_colour_ns >= COLOUR_PERIOD_NS
        if due:
            self._last_colour_ns = stamp_ns
        return due

    def _depth(self, stamp_ns: int, group: list[Item]) -> "DepthView | None":
        view, kinect = None, self.sensors.kinect
        for item in group:
            if not isinstance(item, Message):
                continue
            if isinstance(item.body, DepthBody) and item.topic == self.rig.cameras.b_depth.image_topic:
                view = self.sensors.depth(stamp_ns, item.body.depth_m()) or view
                self._depths_seen += 1
            if isinstance(item.body, CloudBody) and item.topic == self.rig.kinect.points_topic:
                view = kinect.cloud(stamp_ns, item.body.points_m()) if kinect.cloud_due(stamp_ns) else view
                self._depths_seen += 1
        if view is None or self._colour is None:
            return view
        return replace(view, colour=grey(self._colour.pixels()))

    def _clicked(
        self, picks: tuple[Pick, ...], pair: PairImages | None, group: list[Item]
    ) -> dict[tuple[str, int, str], CutOut]:
        """Cuts out what was clicked. The machine stands still: its newest colour image shows what a click there saw."""
        for item in group:
            if isinstance(item, Message) and isinstance(item.body, ImageBody):
                self._colour = item.body if self.camera_of(item.topic) == "b_rgb" else self._colour
        found = {}
        for pick in picks:
            image = None
            if pick.camera == "b_rgb":
                image = None if self._colour is None else self._colour.pixels()
            elif pair is not None:
                image = pair.of(pick.camera)
            if image is not None:
                found[pick.camera, pick.stamp_ns, pick.point_id] = cut_out(image, pick.raw_px)
        return found


def _atlas_of(memorable: Memorable) -> Atlas:
    """With the view described."""
    view = memorable.view
    return Atlas(() if view is None else (place_of(view),), memorable.tracks)


def _clicked(group: list[Item]) -> bool:
    return any(isinstance(i, Message) and isinstance(i.body, PickBody) for i in group)


def images(pair: StereoPair) -> PairImages:
    """The pictures of a stereo pair."""
    left, right = (grey(m.body.pixels()) for m in (pair.left, pair.right) if isinstance(m.body, ImageBody))
    return PairImages(pair.stamp_ns, left, right)


def grey(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """One channel, shape (height, width)."""
    return image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)


def _stamp(item: Item) -> int:
    return item.stamp_ns


def _same_stamp(items: Iterable[Item]) -> Iterator[list[Item]]:
    """Neighbours of one stamp together."""
    group: list[Item] = []
    for item in items:
        if group and _stamp(item) != _stamp(group[0]):
            yield group
            group = []
        group.append(item)
    if group:
        yield group
