"""Messages to measurements to the engine: the one loop of offline and streaming runs."""

from collections import deque
from collections.abc import Iterable, Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from ..factors import keys
from ..factors.errors import LogError, ObservabilityError
from ..factors.measurements import MarkerSighting, OutlineSighting, Pick, Rejection, StereoFrame
from ..factors.rig import Rig
from ..frontends.fiducials.messages import UNKNOWN_IDS
from ..frontends.pick_image import cut_out
from ..frontends.pipe.pairs import OutlinePrior
from ..frontends.pipe.predict import predict_outline
from ..io.messages import CameraInfoBody, CloudBody, DepthBody, DetectionsBody, ImageBody, Message, PickBody
from ..io.ordering import OrderReport, sorted_by_stamp
from ..io.pairing import PairingReport, StereoPair, stereo_pairs
from .bundle import Bundle
from .engine import Engine
from .pipes import AXIS_ROLES
from .sensors import PairImages, Sensors, by_info_topic
from .sides import Sides
from .surfaces import Associator, lay_on_surfaces

Item = Message | StereoPair
Float = NDArray[np.float64]

KEPT_BYTES = 120_000_000
"""Pictures of keyframes that are kept to look for a pipe's outline once it is known."""
OUTLINE_VIEWS = 16
"""Views per pipe and camera in which its outline is looked for: their errors are alike, more would not tell more."""
OUTLINE_SPACING_M = 0.15
"""Views of a pipe nearer to each other than this tell nothing new."""
OUTLINE_PRIOR = (0.006, 0.02, 0.008)
"""Sigmas of axis [m], direction [rad] and radius [m] with which a known pipe's outline is looked for."""
PART_M = 0.1
"""A pipe is taken to go on so far beyond its picks."""
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


class Pipeline:
    """Feeds one engine from messages."""

    def __init__(self, rig: Rig, associate: Associator = lay_on_surfaces) -> None:
        self.rig = rig
        self.sensors = Sensors(rig)
        self.engine = Engine(rig, self.sensors.cameras, associate)
        self.order = OrderReport()
        self.pairing = PairingReport()
        self._sides = Sides(rig)
        self._info = by_info_topic(rig)
        self._kept: deque[PairImages] = deque()
        self._kept_bytes = 0
        self._looked: dict[str, dict[int, Float]] = {}
        """Where the camera stood in views whose outline was looked for, by pipe and camera, and stamp."""
        self._last_colour_ns: int | None = None
        self._colour: ImageBody | None = None
        """The Kinect's newest colour image, not decoded."""

    def run(self, messages: Iterable[Message]) -> Iterator[int]:
        """Takes messages in the order of the log; yields each stamp (ns) when it has been worked in."""
        ordered = sorted_by_stamp((self._plain(m) for m in messages), report=self.order)
        left, right = self.rig.cameras.m_left.image_topic, self.rig.cameras.m_right.image_topic
        paired = stereo_pairs(ordered, left, right, report=self.pairing)
        for group in _same_stamp(paired):
            self.process(group)
            yield _stamp(group[0])

    def _plain(self, message: Message) -> Message:
        """A compressed topic counts as its raw one."""
        if message.topic.endswith(COMPRESSED):
            return Message(
                message.topic.removesuffix(COMPRESSED),
                message.log_time_ns,
                message.stamp_ns,
                message.frame_id,
                message.body,
            )
        return message

    def process(self, group: list[Item]) -> None:
        """All messages of one stamp."""
        stamp_ns = _stamp(group[0])
        for item in group:
            if isinstance(item, Message) and isinstance(item.body, CameraInfoBody) and item.topic in self._info:
                self.sensors.calibrate(self._info[item.topic], item.body.camera)
        self.engine.cameras = self.sensors.cameras
        pair = next((self._images(i) for i in group if isinstance(i, StereoPair)), None)
        picks = [self._pick(i) for i in group if isinstance(i, Message) and isinstance(i.body, PickBody)]
        frame = self.sensors.track(pair) if pair is not None else None
        sightings = self._sightings(stamp_ns, group, pair, frame, picks)
        depths = {}
        if pair is not None:
            depths = {p.point_id: d for p in picks if (d := self.sensors.depth_under(p, pair)) is not None}
        self.engine.add(Bundle(stamp_ns, frame, tuple(sightings), tuple(picks), depths))
        self._keep_pick_images(picks, pair, group)
        if pair is not None and stamp_ns in self.engine.keyframe_at:
            self._keep(pair)
            self._seek_outlines(picks, pair)
        self._see_cloud(stamp_ns, group)

    @staticmethod
    def _images(pair: StereoPair) -> PairImages:
        left, right = (_grey(m.body.pixels()) for m in (pair.left, pair.right) if isinstance(m.body, ImageBody))
        return PairImages(pair.stamp_ns, left, right)

    def _pick(self, message: Message) -> Pick:
        assert isinstance(message.body, PickBody)
        return self.sensors.pick(message.stamp_ns, message.body)

    def _sightings(
        self, stamp_ns: int, group: list[Item], pair: PairImages | None, frame: StereoFrame | None, picks: list[Pick]
    ) -> list[MarkerSighting]:
        found: list[MarkerSighting] = []
        first = self.engine.odometry.last_keyframe < 0
        if pair is not None and frame is not None and (frame.is_keyframe or picks or first):
            found += self.sensors.markers("m_left", stamp_ns, pair.left)
            found += self.sensors.markers("m_right", stamp_ns, pair.right)
        for item in group:
            if not isinstance(item, Message):
                continue
            camera = self._camera_of(item.topic)
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

    def _camera_of(self, topic: str) -> str | None:
        for name in ("m_left", "m_right", "b_rgb"):
            camera = getattr(self.rig.cameras, name)
            if topic in (camera.markers_topic, camera.image_topic):
                return name
        return None

    def _see_cloud(self, stamp_ns: int, group: list[Item]) -> None:
        for item in group:
            if not isinstance(item, Message):
                continue
            cloud = None
            if isinstance(item.body, DepthBody) and item.topic == self.rig.cameras.b_depth.image_topic:
                cloud = self.sensors.depth(stamp_ns, item.body.depth_m())
            if isinstance(item.body, CloudBody) and item.topic == self.rig.kinect.points_topic:
                if self.sensors.kinect.cloud_due(stamp_ns):
                    cloud = self.sensors.kinect.cloud(stamp_ns, item.body.points_m())
            if cloud is not None:
                self.engine.add(Bundle(stamp_ns, cloud=cloud))
                self._seek_cylinders()

    def _seek_cylinders(self) -> None:
        """Pipes that are known roughly, in the Kinect's newest cloud."""
        base = keys.base(0)
        for pipe in self.engine.depth_pipes.wanted(base):
            predicted = self.engine.depth_pipes.predict(pipe, base, self.engine.solver)
            if predicted is not None:
                found = self.sensors.kinect.cylinder(pipe, predicted)
                if found is not None:
                    self.engine.add_cylinder(pipe, base, found)
        self.engine.flush()

    def check(self) -> None:
        """After the last message: is there anything to estimate from, and was everything understood?

        Raises:
            LogError: a pick without depth or second view, or on a camera that never delivered.
            ObservabilityError: a pick in a camera that nothing places.
        """
        self.engine.revisit()
        self._seek_cylinders()
        self._check_ids()
        report = self.pairing
        if report.pairs == 0 and report.unpaired and not self.engine.odometry.keyframe_stamps:
            counts = ", ".join(f"{topic} {count}" for topic, count in sorted(report.unpaired.items()))
            raise LogError(
                f"no stereo pair: stamps of left and right never agree ({counts} images); synchronise the cameras"
            )
        for name, point in self.engine.pipes.points.items():
            if not point.known:
                pick = point.held[-1][1]
                raise LogError(
                    f"{self.rig.picks_topic} at {pick.stamp_ns} ns: pick {name} in {pick.camera} has no depth and no "
                    "second view; pick the point again from another place"
                )
        self._check_open_picks()

    def _check_ids(self) -> None:
        """Markers were seen, and none of them is on a board."""
        if self.engine.odometry.keyframe_stamps:
            return
        for refused in self.sensors.rejected:
            if refused.reason.startswith(UNKNOWN_IDS):
                raise LogError(
                    f"no known marker was seen: at {refused.stamp_ns} ns {refused.what} are on no board of the rig; "
                    "correct dictionary and marker ids in the rig file"
                )

    def _check_open_picks(self) -> None:
        """A point all of whose picks hang on nothing."""
        for pick in self.engine.lost_picks():
            if pick.point_id in self.engine.pipes.points or not self.engine.odometry.keyframe_stamps:
                continue
            where = f"{self.rig.picks_topic} at {pick.stamp_ns} ns: pick {pick.point_id} in {pick.camera}"
            if pick.camera == "b_rgb":
                raise ObservabilityError(f"{where}: {self.engine.why_no_base()}")
            raise LogError(
                f"{where} has the stamp of no image or markers that could be placed; a pick's header.stamp is that of "
                "the image it was made in"
            )

    # Outlines -------------------------------------------------------------------------------------------------

    def _keep(self, pair: PairImages) -> None:
        self._kept.append(pair)
        self._kept_bytes += pair.nbytes
        while self._kept_bytes > KEPT_BYTES:
            self._kept_bytes -= self._kept.popleft().nbytes

    def _keep_pick_images(self, picks: list[Pick], pair: PairImages | None, group: list[Item]) -> None:
        """Cuts out what was clicked. The machine stands still: its newest colour image shows what a click there saw."""
        for item in group:
            if isinstance(item, Message) and isinstance(item.body, ImageBody):
                self._colour = item.body if self._camera_of(item.topic) == "b_rgb" else self._colour
        for pick in picks:
            image = None
            if pick.camera == "b_rgb":
                image = None if self._colour is None else self._colour.pixels()
            elif pair is not None:
                image = pair.of(pick.camera)
            if image is not None:
                self.engine.pick_images[pick.camera, pick.stamp_ns, pick.point_id] = cut_out(image, pick.raw_px)

    def _seek_outlines(self, picks: list[Pick], pair: PairImages) -> None:
        """Edges of the pipe: about a pick at once; in all other keyframes once the pipe is known."""
        for pick in picks:
            if pick.role in AXIS_ROLES and pick.camera in ("m_left", "m_right"):
                pipe = self.engine.pipes.pipe_of(pick.point_id)
                finder = self.sensors.outline_finder(pick.camera)
                click = float(np.sqrt(pick.covariance_px2.trace() / 2))
                prior = OutlinePrior(pick.px, click)
                self._take(finder.find(pair.stamp_ns, pipe, pair.of(pick.camera), prior))
                where = self.engine.seen_from(pick.camera, pair.stamp_ns)
                if where is not None:
                    looked = self._looked.setdefault(f"{pipe} {pick.camera}", {})
                    looked[pair.stamp_ns] = where.o_T_c.translation()
        self.engine.flush()
        for pipe in list(self.engine.pipes.cylinders):
            if self.engine.pipes.axis(pipe) is not None:
                for kept in list(self._kept):
                    for camera in ("m_left", "m_right"):
                        self._seek_predicted(pipe, camera, kept)
        self.engine.flush()

    def _seek_predicted(self, pipe: str, camera: str, pair: PairImages) -> None:
        """Looks for a known pipe's outline, in views that differ from those already used."""
        looked = self._looked.setdefault(f"{pipe} {camera}", {})
        axis = self.engine.pipes.axis(pipe)
        where = self.engine.seen_from(camera, pair.stamp_ns)
        if axis is None or where is None or len(looked) >= OUTLINE_VIEWS:
            return
        place = where.o_T_c.translation()
        if any(np.linalg.norm(place - other) < OUTLINE_SPACING_M for other in looked.values()):
            return
        ends = _part_of_axis(self.engine.pipes.places(pipe), axis)
        a, b = (where.o_T_c.transformTo(end) for end in ends)
        prior = predict_outline(self.sensors.cameras[camera], a, b, axis[2], *OUTLINE_PRIOR)
        if prior is not None:
            looked[pair.stamp_ns] = place
            self._take(self.sensors.outline_finder(camera).find(pair.stamp_ns, pipe, pair.of(camera), prior))

    def _take(self, found: OutlineSighting | Rejection) -> None:
        if isinstance(found, OutlineSighting):
            self.engine.add_outline(found)
        else:
            self.engine.rejected.append(found)


def _part_of_axis(places: list[Float], axis: tuple[Float, Float, float]) -> tuple[Float, Float]:
    """The part of an axis about the picked points, in {o}."""
    direction = (axis[1] - axis[0]) / np.linalg.norm(axis[1] - axis[0])
    along = [float((p - axis[0]) @ direction) for p in places] or [0.0]
    return axis[0] + (min(along) - PART_M) * direction, axis[0] + (max(along) + PART_M) * direction


def _grey(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
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
