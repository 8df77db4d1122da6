"""The camera between keyframes: the front end's motion on top of the newest keyframe that the graph has placed."""

from collections import OrderedDict
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray

from ...factors.geometry import pose3
from .wire import Frame, Place

Float = NDArray[np.float64]

KEPT = 2000
"""Frames that the graph may be behind."""
LOST_SPEED_M_S, LOST_TURN_RAD_S = 0.5, 1.0
"""Standard deviation of a hand-held camera's velocity about its last one, while nothing is tracked; as in the graph."""
FIRST_STEP = np.array([2e-3] * 3 + [3e-3] * 3) ** 2
"""Variance (rad^2, m^2) of the motion between two keyframes before any has been compared with the graph."""
MEMORY = 0.05
"""Share of the newest comparison in the running variance."""


@dataclass(frozen=True, slots=True)
class Followed:
    """`o_T_m` at a frame."""

    stamp_ns: int
    matrix: Float
    """Shape (4, 4)."""
    covariance: Float
    """Shape (6, 6), rotation first, body frame."""
    behind: int
    """Frames since the graph's keyframe."""


class Follower:
    """Chains the front end's motions. How wrong they are is learned from the graph: each time it places a keyframe,
    what the chain had said since the one before is compared with it."""

    def __init__(self) -> None:
        self._frames: OrderedDict[int, Frame] = OrderedDict()
        self._anchor_ns: int | None = None
        self._anchor = Place(np.eye(4), np.zeros((6, 6)))
        self._since = np.eye(4)
        """From the anchor to the newest frame."""
        self._variance = FIRST_STEP.copy()
        """Of the motion between two keyframes, shape (6,), rotation first."""
        self._steps = 0.0
        """Keyframe intervals since the anchor, the last one in part."""
        self._lost_s = 0.0
        self._at_ns = 0
        """Stamp of the newest frame in the chain."""
        self._early: Frame | None = None
        """The newest frame, while it is still in the making."""

    def anchored(self) -> bool:
        return self._anchor_ns is not None

    def forget(self) -> None:
        """Begins anew."""
        self.__init__()

    def frame(self, frame: Frame) -> Followed | None:
        """A frame's pose; None while the graph has placed no keyframe."""
        self._early = frame if frame.early else None
        if frame.early:
            return None if self._anchor_ns is None else self._now(frame.stamp_ns)
        self._frames[frame.stamp_ns] = frame
        while len(self._frames) > KEPT:
            self._frames.popitem(last=False)
        if self._anchor_ns is None:
            return None
        self._add(frame)
        return self._now(frame.stamp_ns)

    def anchor(self, stamp_ns: int, place: Place) -> Followed | None:
        """The graph has placed a keyframe, or placed it better."""
        if self._anchor_ns is not None and stamp_ns < self._anchor_ns and stamp_ns not in self._frames:
            return None  # one made after the fact, of a frame long gone
        self._learn(stamp_ns, place)
        self._anchor_ns, self._anchor = stamp_ns, place
        self._since, self._steps, self._lost_s, self._at_ns = np.eye(4), 0.0, 0.0, stamp_ns
        newest = stamp_ns
        for stamp, frame in self._frames.items():
            if stamp > stamp_ns:
                self._add(frame)
                newest = stamp
        for old in [stamp for stamp in self._frames if stamp < stamp_ns]:
            del self._frames[old]
        return self._now(newest)

    def _add(self, frame: Frame) -> None:
        self._since = self._since @ frame.last_T_this
        whole = float(np.floor(self._steps))
        self._steps = whole + 1.0 if frame.is_keyframe else whole + 0.5
        if frame.lost:
            self._lost_s += max(frame.stamp_ns - self._at_ns, 0) * 1e-9
        self._at_ns = frame.stamp_ns

    def _learn(self, stamp_ns: int, place: Place) -> None:
        """Compares the chain between the last anchor and this keyframe with the graph's motion."""
        if self._anchor_ns is None or stamp_ns <= self._anchor_ns:
            return
        chain, steps, lost = np.eye(4), 0, False
        for stamp, frame in self._frames.items():
            if self._anchor_ns < stamp <= stamp_ns:
                chain = chain @ frame.last_T_this
                steps += frame.is_keyframe
                lost |= frame.lost
        if not steps or lost:
            return
        graph = pose3(np.linalg.inv(self._anchor.matrix) @ place.matrix)
        off = gtsam.Pose3.Logmap(pose3(chain).between(graph))
        self._variance += MEMORY * (off**2 / steps - self._variance)

    def _now(self, stamp_ns: int) -> Followed:
        chain, steps = self._since, self._steps
        if self._early is not None:  # one on from the newest of the chain
            stamp_ns, chain, steps = self._early.stamp_ns, chain @ self._early.last_T_this, float(np.floor(steps)) + 0.5
        since = pose3(chain)
        matrix = self._anchor.matrix @ chain
        own = self._anchor.covariance if self._anchor.covariance is not None else np.zeros((6, 6))
        back = since.inverse().AdjointMap()
        turned, moved = LOST_TURN_RAD_S * self._lost_s, LOST_SPEED_M_S * self._lost_s
        lost = np.array([turned**2] * 3 + [moved**2] * 3)
        covariance = back @ own @ back.T + np.diag(steps * self._variance + lost)
        behind = sum(stamp > (self._anchor_ns or 0) for stamp in self._frames)
        return Followed(stamp_ns, matrix, covariance, behind)
