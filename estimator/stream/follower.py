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
FIRST_TURN_RAD_M, FIRST_SHARE = 0.01, 0.05
"""Standard deviations of a motion before any has been compared with the graph: of the turn, per metre, and of each
component of the way, as a share of its length. Both grow with the way: cameras that are calibrated a little wrong make
errors that do not average out."""
WORTH = 4.0
"""Comparisons that these count as."""
MEMORY = 0.05
"""Least share of the newest comparison in the running figures."""
NEAR_M, NEAR_TURNED_M = 0.03, 0.1
"""The way and the turn of a shorter way are as uncertain as those of one so long."""
TURNING_M = 0.5
"""Way that makes the turn as uncertain as a radian's turning does."""
SCALE_SIGMA = 0.1
"""How far the front end's ways may be too long or too short, as a share: it knows the cameras as they were given, and a
depth that is always too short makes every way too short."""


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


@dataclass(frozen=True, slots=True)
class Went:
    """How far a chain has gone, there and back."""

    way_m: float = 0.0
    turned_rad: float = 0.0

    def on(self, a_T_b: Float) -> "Went":
        """After another motion (4, 4)."""
        cosine = (float(np.trace(a_T_b[:3, :3])) - 1.0) / 2.0
        turned = float(np.arccos(np.clip(cosine, -1.0, 1.0)))
        return Went(self.way_m + float(np.linalg.norm(a_T_b[:3, 3])), self.turned_rad + turned)

    def way_m2(self) -> float:
        """By which the variance of the way grows."""
        return self.way_m**2 + NEAR_M**2

    def turning_m2(self) -> float:
        """By which that of the turn does."""
        return self.way_m**2 + (TURNING_M * self.turned_rad) ** 2 + NEAR_TURNED_M**2


class Ratio:
    """How much longer ways are than the front end says: least squares over what the graph said; old ones fade."""

    def __init__(self) -> None:
        self._information = 1.0 / SCALE_SIGMA**2
        self._weighted = 0.0

    @property
    def excess(self) -> float:
        return self._weighted / self._information

    def applied(self, a_T_b: Float) -> Float:
        """A motion (4, 4) of the front end, as long as the graph would have it."""
        longer = a_T_b.copy()
        longer[:3, 3] *= 1.0 + self.excess
        return longer

    def learn(self, chain_m: Float, graph_m: Float, share_variance: float) -> None:
        """One way (3,) as both saw it.

        Args:
            share_variance: of a way's components, as a share of its length.
        """
        weight = 1.0 / (share_variance * (float(chain_m @ chain_m) + NEAR_M**2))
        first = 1.0 / SCALE_SIGMA**2
        self._information += MEMORY * (first - self._information) + weight * float(chain_m @ chain_m)
        self._weighted += -MEMORY * self._weighted + weight * float(chain_m @ (graph_m - chain_m))


class Follower:
    """Chains the front end's motions. How wrong they are is learned from the graph: each time it places a keyframe,
    what the chain had said since the one before is compared with it."""

    def __init__(self) -> None:
        self._frames: OrderedDict[int, Frame] = OrderedDict()
        self._anchor_ns: int | None = None
        self._anchor = Place(np.eye(4), np.zeros((6, 6)))
        self._since = np.eye(4)
        """From the anchor to the newest frame."""
        self._went: Went | None = None
        """Since the anchor; None at the anchor itself."""
        self._ratio = Ratio()
        self._compared = WORTH
        self._turn_variance = FIRST_TURN_RAD_M**2
        """Of each component of a turn, rad^2/m^2."""
        self._share_variance = FIRST_SHARE**2
        """Of each component of a way, as a share of its length."""
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
        self._since, self._went, self._lost_s, self._at_ns = np.eye(4), None, 0.0, stamp_ns
        newest = stamp_ns
        for stamp, frame in self._frames.items():
            if stamp > stamp_ns:
                self._add(frame)
                newest = stamp
        for old in [stamp for stamp in self._frames if stamp < stamp_ns]:
            del self._frames[old]
        return self._now(newest)

    def _add(self, frame: Frame) -> None:
        step = self._ratio.applied(frame.last_T_this)
        self._since = self._since @ step
        self._went = (self._went or Went()).on(step)
        if frame.lost:
            self._lost_s += max(frame.stamp_ns - self._at_ns, 0) * 1e-9
        self._at_ns = frame.stamp_ns

    def _learn(self, stamp_ns: int, place: Place) -> None:
        """Compares the chain between the last anchor and this keyframe with the graph's motion."""
        if self._anchor_ns is None or stamp_ns <= self._anchor_ns:
            return
        between = [f for stamp, f in self._frames.items() if self._anchor_ns < stamp <= stamp_ns]
        if not between or any(f.lost for f in between):
            return
        chain, went = np.eye(4), Went()
        for frame in between:
            chain, went = chain @ frame.last_T_this, went.on(frame.last_T_this)
        graph = np.linalg.inv(self._anchor.matrix) @ place.matrix
        self._ratio.learn(chain[:3, 3], graph[:3, 3], self._share_variance)
        off = gtsam.Pose3.Logmap(pose3(self._ratio.applied(chain)).between(pose3(graph)))
        self._compared += 1.0
        newest = max(1.0 / self._compared, MEMORY)
        turn = float(off[:3] @ off[:3]) / 3.0 / went.turning_m2()
        share = float(off[3:] @ off[3:]) / 3.0 / went.way_m2()
        self._turn_variance += newest * (turn - self._turn_variance)
        self._share_variance += newest * (share - self._share_variance)

    def _now(self, stamp_ns: int) -> Followed:
        chain, went = self._since, self._went
        if self._early is not None:  # one on from the newest of the chain
            step = self._ratio.applied(self._early.last_T_this)
            stamp_ns, chain, went = self._early.stamp_ns, chain @ step, (went or Went()).on(step)
        since = pose3(chain)
        matrix = self._anchor.matrix @ chain
        own = self._anchor.covariance if self._anchor.covariance is not None else np.zeros((6, 6))
        back = since.inverse().AdjointMap()
        turned, moved = LOST_TURN_RAD_S * self._lost_s, LOST_SPEED_M_S * self._lost_s
        lost = np.array([turned**2] * 3 + [moved**2] * 3)
        followed = np.zeros(6)
        if went is not None:
            followed[:3] = self._turn_variance * went.turning_m2()
            followed[3:] = self._share_variance * went.way_m2()
        covariance = back @ own @ back.T + np.diag(followed + lost)
        behind = sum(stamp > (self._anchor_ns or 0) for stamp in self._frames)
        return Followed(stamp_ns, matrix, covariance, behind)
