"""A graph that does not keep up gets fewer frames, so that nobody has to wait for it.

A frame that is left out is not lost: its motion becomes a part of the next one's, and its tracks live on in the
keyframes that follow.
"""

from dataclasses import replace
from typing import Any

from ...factors.measurements import StereoFrame
from ..bundle import Bundle
from ..sensing import Sensed
from .settings import StreamSettings


class Thinning:
    """Before the graph's queue.

    Args:
        patient: whoever sends waits: nothing is left out.
    """

    def __init__(self, graph: Any, settings: StreamSettings, patient: bool) -> None:
        self._graph = graph
        self._settings = settings
        self._patient = patient
        self._kept: StereoFrame | None = None
        """The frames left out since the last one that was handed on, as one motion."""
        self._keyframe_ns: int | None = None
        self._left_out = 0

    def put(self, sensed: Sensed) -> None:
        """Hands on what was seen, or leaves out its frame."""
        bundle = sensed.bundle
        frame = bundle.frame
        if frame is None:
            self._graph.put(sensed)
            return
        frame = joined(self._kept, frame)
        if self._spared(frame) and not bundle.picks:
            self._kept, self._left_out = frame, self._left_out + 1
            if sensed.depth is not None or sensed.cameras:
                rest = Bundle(sensed.stamp_ns)
                self._graph.put(Sensed(rest, sensed.depth, cameras=sensed.cameras))
            return
        self._kept = None
        if frame.is_keyframe:
            self._keyframe_ns = frame.stamp_ns
        self._graph.put(replace(sensed, bundle=replace(bundle, frame=frame)))

    def taken(self) -> int:
        """How many frames have been left out since this was asked last."""
        number, self._left_out = self._left_out, 0
        return number

    def _spared(self, frame: StereoFrame) -> bool:
        if self._patient or self._backlog() < self._settings.thin_from or self._keyframe_ns is None:
            return False
        return not frame.is_keyframe or 0 <= frame.stamp_ns - self._keyframe_ns < self._settings.thin_ns

    def _backlog(self) -> int:
        try:
            return self._graph.qsize()
        except NotImplementedError:  # macOS cannot tell
            return 0


def joined(before: StereoFrame | None, frame: StereoFrame) -> StereoFrame:
    """A frame whose motion counts from before the frames that were left out."""
    if before is None:
        return frame
    return replace(frame, last_T_this=before.last_T_this @ frame.last_T_this, lost=before.lost or frame.lost)
