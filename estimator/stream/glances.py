"""A look at the boards between keyframes: a knock must not wait until the camera moves.

What is seen then does not enter the graph, for detector errors repeat while a camera stands still. It is only compared
with where the boards should be.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...factors.camera import CameraModel
from ...factors.measurements import MarkerSighting, StereoFrame
from ...factors.rig import Rig
from ...frontends.fiducials.detector import MarkerFrontEnd
from .settings import StreamSettings

RECENT = 5
"""Periods within which a board that was seen should still be in view: one image of three misses small markers."""
SOONER = 4
"""A look that missed it is repeated so many times sooner."""


@dataclass(frozen=True, slots=True)
class Glance:
    """Markers in a frame that is no keyframe."""

    frame: StereoFrame
    sightings: tuple[MarkerSighting, ...]


class Glances:
    """With a detector of its own, so that the keyframes' one goes on as if nothing had been."""

    def __init__(self, rig: Rig, settings: StreamSettings) -> None:
        self._rig = rig
        self._period_ns = settings.glance_period_ns
        self._front_end: MarkerFrontEnd | None = None
        self._last_ns = 0
        """The last time that boards were looked for."""
        self._seen_ns = 0
        """The last time that one was seen in a glance."""

    def due(self, frame: StereoFrame) -> bool:
        """Is it time for one? A keyframe is looked at anyway."""
        if frame.is_keyframe or abs(frame.stamp_ns - self._last_ns) > 10 * self._period_ns:
            self._last_ns = frame.stamp_ns
            return False
        return bool(self._rig.boards) and not frame.lost and frame.stamp_ns - self._last_ns >= self._period_ns

    def look(self, frame: StereoFrame, camera: CameraModel, left: NDArray[np.uint8]) -> Glance:
        """The left picture is enough."""
        self._last_ns = frame.stamp_ns
        if self._front_end is None:
            self._front_end = MarkerFrontEnd(self._rig, camera, "m_left")
        sightings = tuple(self._front_end.process(frame.stamp_ns, left)[0])
        if sightings:
            self._seen_ns = frame.stamp_ns
        elif frame.stamp_ns - self._seen_ns < RECENT * self._period_ns:
            self._last_ns -= self._period_ns - self._period_ns // SOONER
        return Glance(frame, sightings)
