"""Who does not keep up gets fewer frames, so that nobody has to wait for it.

A frame that is left out is not lost: its motion becomes a part of the next one's, and its tracks live on in the
keyframes that follow.
"""

from dataclasses import replace
from typing import Any

from ...factors.measurements import StereoFrame
from .settings import StreamSettings


class Thinning:
    """Before the queue of a process.

    Args:
        patient: whoever sends waits: nothing is left out.
    """

    def __init__(self, inbox: Any, settings: StreamSettings, patient: bool) -> None:
        self._inbox = inbox
        self._settings = settings
        self._patient = patient
        self._kept: StereoFrame | None = None
        """The frames left out since the last one that was handed on, as one motion."""
        self._keyframe_ns: int | None = None
        self._left_out = 0

    def offered(self, frame: StereoFrame, dear: bool) -> StereoFrame | None:
        """The frame to hand on, with the motion of those before it that were left out; None: it is one of them.

        Args:
            dear: it has to be handed on, such as one that was clicked in.
        """
        frame = joined(self._kept, frame)
        if self._spared(frame) and not dear:
            self._kept, self._left_out = frame, self._left_out + 1
            return None
        self._kept = None
        if frame.is_keyframe:
            self._keyframe_ns = frame.stamp_ns
        return frame

    def behind(self) -> bool:
        """Does the process keep up so badly that frames are left out?"""
        if self._patient:
            return False
        try:
            return self._inbox.qsize() >= self._settings.thin_from
        except NotImplementedError:  # macOS cannot tell
            return False

    def taken(self) -> int:
        """How many frames have been left out since this was asked last."""
        number, self._left_out = self._left_out, 0
        return number

    def _spared(self, frame: StereoFrame) -> bool:
        if self._keyframe_ns is None or not self.behind():
            return False
        return not frame.is_keyframe or 0 <= frame.stamp_ns - self._keyframe_ns < self._settings.thin_ns


def joined(before: StereoFrame | None, frame: StereoFrame) -> StereoFrame:
    """A frame whose motion counts from before the frames that were left out."""
    if before is None:
        return frame
    return replace(frame, last_T_this=before.last_T_this @ frame.last_T_this, lost=before.lost or frame.lost)
