"""Keyframes after the tracks broke: they hang on a motion prior until something of before is seen again."""

import gtsam
import numpy as np
from numpy.typing import NDArray

from ..factors import keys
from ..factors.geometry import pose3
from ..factors.measurements import MarkerSighting, StereoFrame
from ..frontends.resection import camera_pose
from .boards import Boards
from .odometry import Odometry
from .open_graph import OpenGraph
from .placement import place

Float = NDArray[np.float64]

ANCHOR_PX = 2.0
"""Largest median reprojection error of landmarks of before."""
ANCHOR_LANDMARKS = 12
REACH = 5.0
"""Sigmas of the motion prior beyond which a camera has not gone."""
SHORT_S = 0.2
"""A gap in which the camera cannot have gone far: its landmarks lie near enough to where they are taken to be."""
MOVING = "xlpuvqf"
"""Kinds of variables that are carried along; the machine stands where it stood."""


class Adrift:
    """The newest part of the map, of which only the shape is known.

    Its guess may be a metre and a radian off: nothing may be compared with it that is found by being near, such as
    surfaces. As soon as a known board or enough landmarks of before are seen, all of it is moved there.
    """

    def __init__(self, graph: OpenGraph, odometry: Odometry, boards: Boards) -> None:
        self._graph, self._odometry, self._boards = graph, odometry, boards
        self._before: frozenset[int] | None = None
        self._gap_s = 0.0

    def __bool__(self) -> bool:
        """Is it unknown where the newest keyframes are?"""
        return self._before is not None

    def begin(self, before: frozenset[int], gap_s: float) -> None:
        """A keyframe hangs on a motion prior alone; what was in the graph before it is given."""
        if gap_s > SHORT_S:
            self._before, self._gap_s = (before if self._before is None else self._before), self._gap_s + gap_s

    def anchor(self, frame: StereoFrame, sightings: list[MarkerSighting]) -> bool:
        """Looks for what was known before in a frame that becomes a keyframe; True when that has moved the map."""
        if self._before is None:
            return False
        expected = self._odometry.expected()
        found = self._by_boards(sightings) or self._by_landmarks(frame)
        if found is None or not self._within_reach(expected, found):
            return False
        self._graph.flush()
        self._move(found.compose(self._odometry.expected().inverse()))
        self._before, self._gap_s = None, 0.0
        return True

    def _by_boards(self, sightings: list[MarkerSighting]) -> gtsam.Pose3 | None:
        """`o_T_m` from boards that were known before."""
        assert self._before is not None
        known = [s for s in sightings if self._boards.sheets[s.board].key in self._before]
        return place(self._boards, self._graph.state, known, (gtsam.Pose3(), 1 << 62)) if known else None

    def _by_landmarks(self, frame: StereoFrame) -> gtsam.Pose3 | None:
        """`o_T_m` from landmarks of before that the front end has found again."""
        assert self._before is not None
        state, old = self._graph.state, []
        for row, track in enumerate(frame.track_ids.tolist()):
            key = keys.landmark(track)
            if key in self._before and state.has(key):
                old.append((row, state.point(key)))
        if len(old) < ANCHOR_LANDMARKS:
            return None
        px = frame.left_px[[row for row, _ in old]]
        K = state.intrinsics(keys.intrinsics("m_left")).K()
        found = camera_pose(np.array([point for _, point in old]), px, K)
        return None if found is None or found[1] > ANCHOR_PX else pose3(found[0])

    def _within_reach(self, expected: gtsam.Pose3, found: gtsam.Pose3) -> bool:
        """Can the camera have got there?"""
        gone_m = float(np.linalg.norm(expected.between(found).translation()))
        return gone_m < REACH * self._odometry.lost_speed_m_s * self._gap_s

    def _move(self, correction: gtsam.Pose3) -> None:
        """All variables of since then, moved in {o}; the solver begins anew from there, with what is seen now."""
        assert self._before is not None
        values = gtsam.Values(self._graph.solver.values())
        for key in values.keys():
            if key in self._before or keys.kind(key) not in MOVING:
                continue
            if keys.kind(key) in "xf":
                values.update(key, correction.compose(values.atPose3(key)))
            else:
                values.update(key, correction.transformFrom(values.atPoint3(key)))
        self._graph.relocate(values)
