"""The tracking's process: it does nothing that a pose has to wait for but the pose."""

import time
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...factors.errors import SurecutError
from ...factors.rig import Rig
from ...frontends.stereo.atlas import Atlas
from ...io.messages import CloudBody, DepthBody, ImageBody, Message
from ...io.pairing import StereoPair
from ..items import Item, unreadable
from .memory import MemoryFileError, load
from .serving import FrontEnd, serve
from .settings import StreamSettings
from .wire import Frame, Group, Tracked, Worked

Float = NDArray[np.float64]


def track(
    rig: Rig, settings: StreamSettings, patient: bool, prior: Path | None, inbox: Any, look: Any, out: Any
) -> None:
    """The process. `inbox`, `look` and `out` are queues between processes.

    Args:
        patient: nothing may be left out, however long it takes.
        prior: checkpoint to begin with; a reset forgets it.
    """
    begin = [_atlas(prior)]

    def made(known: Mapping[str, Message]) -> TrackLoop:
        atlas = begin.pop() if begin else None
        return TrackLoop(rig, settings, patient, look, out, known, atlas)

    serve("tracking", 0, made, inbox, look, out)


def _atlas(prior: Path | None) -> Atlas | None:
    """What can be found again of an earlier run. The graph tells what is wrong with its file."""
    try:
        return load(prior).atlas if prior is not None and prior.exists() else None
    except MemoryFileError:
        return None


class TrackLoop(FrontEnd):
    """Follows the mobile camera; hands everything on."""

    def take(self, group: Group) -> None:
        """A pair that cannot be used is told, and the stream goes on."""
        items: list[Item] = group.items
        for item in items:
            if self._sensing.is_calibration(item):
                self.calibrations[item.topic] = item
        taken_ns, began = time.monotonic_ns(), time.process_time()
        frame, problem = None, None
        try:
            frame = self._sensing.follow(items, lambda motion, inliers: self._early(items, motion, inliers, taken_ns))
        except SurecutError as error:
            problem = " ".join(str(error).split())
        cpu_s = time.process_time() - began
        if frame is not None:
            motion = frame.last_T_this, frame.is_keyframe, frame.lost, frame.motion_inliers
            self._out.put(Frame(frame.stamp_ns, *motion, taken_ns, time.monotonic_ns(), cpu_s))
        elif problem is not None:
            self._out.put(Worked({}, 0, problem, 0, cpu_s, unreadable=unreadable(items)))
        if problem is not None:
            items = [item for item in items if not isinstance(item, StereoPair)]  # it is told once
        if items:
            self._hand_on(Tracked(items, frame, self._sensing.memorable(frame)))

    def _early(self, items: list[Item], motion: Float, inliers: int, taken_ns: int) -> None:
        """A keyframe takes many times as long as its motion, on which the pose of the camera waits."""
        stamp_ns = next(item.stamp_ns for item in items if isinstance(item, StereoPair))
        self._out.put(Frame(stamp_ns, motion, False, False, inliers, taken_ns, time.monotonic_ns(), early=True))

    def _hand_on(self, tracked: Tracked) -> None:
        """To the other front ends. Where these are behind, frames and what is only about surfaces are left out: the
        pose of the camera must not wait for them."""
        frame = tracked.frame
        if frame is not None:
            dear = any(not isinstance(item, StereoPair) for item in tracked.items)
            frame = self._thinning.offered(frame, dear)
            if frame is None:
                self._out.put(Worked({}, 0, None, 0, 0.0, thinned=self._thinning.taken()))
                return
        elif self._thinning.behind() and all(_surfaces_only(item) for item in tracked.items):
            self._out.put(Worked({}, 0, None, 0, 0.0, left_out=len(tracked.items)))
            return
        self._onward.put(replace(tracked, frame=frame))


def _surfaces_only(item: Item) -> bool:
    return not isinstance(item, StereoPair) and isinstance(item.body, ImageBody | DepthBody | CloudBody)
