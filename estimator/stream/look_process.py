"""The other front ends' process: markers, surfaces, clicks; what was seen at each stamp goes to the graph."""

import time
from collections import OrderedDict
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ...factors.errors import SurecutError
from ...factors.measurements import MarkerSighting, StereoFrame
from ...factors.rig import Rig
from ...frontends.undistort import distort
from ...io.live.interfaces import Outline
from ...io.messages import Message, PickBody
from ...io.pairing import StereoPair
from ..bundle import Bundle
from ..items import Item, unreadable
from ..sensing import Sensed, images
from ..sensors import PairImages
from .glances import Glances
from .parent import LOOK_NICE
from .serving import FrontEnd, serve
from .settings import StreamSettings
from .wire import LateClick, Tracked, Worked

REFUSALS = 1000
"""Refused measurements that are kept with their words."""


def look(rig: Rig, settings: StreamSettings, patient: bool, inbox: Any, graph: Any, out: Any) -> None:
    """The process. `inbox`, `graph` and `out` are queues between processes.

    Args:
        patient: the sources wait, so that no pose is late.
    """
    niceness = 0 if patient else LOOK_NICE
    serve("front ends", niceness, lambda known: LookLoop(rig, settings, patient, graph, out, known), inbox, graph, out)


@dataclass(frozen=True, slots=True)
class Recent:
    """A frame that somebody may still click in."""

    pair: PairImages
    frame: StereoFrame


class LookLoop(FrontEnd):
    """Looks at one group after the other."""

    def __init__(
        self,
        rig: Rig,
        settings: StreamSettings,
        patient: bool,
        graph: Any,
        out: Any,
        calibrations: Mapping[str, Message] | None = None,
    ) -> None:
        super().__init__(rig, settings, patient, graph, out, calibrations)
        self._glances = Glances(rig, settings)
        self._recent: OrderedDict[int, Recent] = OrderedDict()
        self._newest_ns = 0
        self._pair: StereoPair | None = None
        for message in [*self.calibrations.values()]:  # the graph has to know them too
            self.take(Tracked([message], None))

    def take(self, tracked: Tracked) -> None:
        """A group. Whatever is wrong with it is told, and the stream goes on."""
        items = tracked.items
        began = time.process_time()
        problem, bad, outlines, picks = None, (), {}, 0
        stamp_ns = items[0].stamp_ns
        try:
            clicks = [item for item in items if isinstance(item, Message) and _on_mobile(item)]
            if len(clicks) == len(items):
                picks = len(clicks)
                self._late(clicks)
            else:
                outlines = self._present(items, tracked)
        except SurecutError as error:
            problem, bad = " ".join(str(error).split()), unreadable(items)
        cpu_s = time.process_time() - began
        thinned = self._thinning.taken()
        self._out.put(Worked(outlines, stamp_ns, problem, picks, cpu_s, unreadable=bad, thinned=thinned))

    def _present(self, items: list[Item], tracked: Tracked) -> dict[str, tuple[Outline, ...]]:
        self._note(items)
        sensed = self._sensing.look(items, tracked.frame, memorable=tracked.memorable)
        self._remember(sensed.bundle.frame)
        self._hand_on(sensed)
        del self._sensing.sensors.rejected[:-REFUSALS]
        return self._outlines(sensed.bundle.sightings)

    def _hand_on(self, sensed: Sensed) -> None:
        """To the graph; without its frame where the graph is behind."""
        bundle = sensed.bundle
        if bundle.frame is not None:
            frame = self._thinning.offered(bundle.frame, dear=bool(bundle.picks))
            if frame is not None:
                self._onward.put(replace(sensed, bundle=replace(bundle, frame=frame)))
                self._glance(bundle.frame)
                return
            elif sensed.depth is not None or sensed.cameras:
                sensed = Sensed(Bundle(sensed.stamp_ns), sensed.depth, cameras=sensed.cameras)
            else:
                return
        self._onward.put(sensed)

    def _glance(self, frame: StereoFrame) -> None:
        """Looks at the boards now and then while there are no keyframes."""
        recent = self._recent.get(frame.stamp_ns)
        if recent is not None and self._glances.due(frame):
            self._onward.put(self._glances.look(frame, self._sensing.sensors.cameras["m_left"], recent.pair.left))

    def _note(self, items: list[Item]) -> None:
        for item in items:
            if isinstance(item, StereoPair):
                self._pair = item
            elif self._sensing.is_calibration(item):
                self.calibrations[item.topic] = item

    def _remember(self, frame: StereoFrame | None) -> None:
        if frame is None or self._pair is None:
            return
        self._recent[frame.stamp_ns] = Recent(images(self._pair), frame)
        self._newest_ns = frame.stamp_ns
        while self._recent and next(iter(self._recent)) < frame.stamp_ns - self._settings.recent_ns:
            self._recent.popitem(last=False)

    def _late(self, clicks: list[Message]) -> None:
        """Clicks in a frame that has passed: with its pictures, so that the graph may make it a keyframe."""
        stamp_ns = clicks[0].stamp_ns if clicks[0].stamp_ns > 0 else self._newest_ns
        recent = self._recent.get(self._nearest(stamp_ns))
        if recent is None:
            self._onward.put(self._sensing.process(list(clicks)))
            return
        own = [replace(click, stamp_ns=recent.frame.stamp_ns) for click in clicks]
        self._onward.put(LateClick(self._sensing.look_back(own, recent.pair, recent.frame)))

    def _nearest(self, stamp_ns: int) -> int:
        """Stamp of the remembered frame within a millisecond."""
        return min((s for s in self._recent if abs(s - stamp_ns) <= 1_000_000), default=-1)

    def _outlines(self, sightings: tuple[MarkerSighting, ...]) -> dict[str, tuple[Outline, ...]]:
        """Markers in raw pixels, for people."""
        found: dict[str, list[Outline]] = {}
        for s in sightings:
            camera = self._sensing.sensors.cameras[s.camera]
            raw = np.asarray(distort(camera, s.corners_px), float)
            found.setdefault(s.camera, []).append(Outline(f"{s.board}/{s.marker}", raw, True))
        return {camera: tuple(outlines) for camera, outlines in found.items()}


def _on_mobile(message: Message) -> bool:
    return isinstance(message.body, PickBody) and message.body.camera != "b_rgb"
