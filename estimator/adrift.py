"""Keyframes after the tracks broke: they hang on a motion prior until something of before is seen again."""

from collections.abc import Callable, Iterable

import gtsam
import numpy as np
from numpy.typing import NDArray

from ..factors import keys
from ..factors.measurements import Event, MarkerSighting, StereoFrame
from .boards import Boards
from .graph import Update
from .odometry import Odometry
from .open_graph import OpenGraph
from .placement import place, place_by_landmarks
from .strand import Strand

Float = NDArray[np.float64]
Part = Callable[[int], bool]
"""Is a variable in a part of the map?"""

REACH = 5.0
"""Sigmas of the motion prior beyond which a camera has not gone."""
SHORT_S = 0.2
"""A gap in which the camera cannot have gone far: its landmarks lie near enough to where they are taken to be."""

MOST_TOLD = 100
"""Lost parts of the way that a run without end remembers to tell."""


class Adrift:
    """The parts of the map of which only the shape is known: *strands*, each begun by a loss of sight.

    Their guess may be a metre and a radian off: nothing may be compared with them that is found by being near, such as
    surfaces, and what is known of a thing elsewhere must not be brought together with what they show of it. As soon as
    a known board or enough landmarks of elsewhere are seen, all of a strand is moved there. Only the newest strand
    grows; those before it wait for the camera to come back to them.
    """

    def __init__(self, graph: OpenGraph, odometry: Odometry, boards: Boards) -> None:
        self._graph, self._odometry, self._boards = graph, odometry, boards
        self._open: Strand | None = None
        self._loose: list[Strand] = []
        self._past: list[Event] = []
        """Of strands that have left the graph."""
        self._fresh = False
        """Does the frame that becomes a keyframe hang together with nothing?"""
        self._expected = gtsam.Pose3()
        self._left_at = np.zeros(3)
        """Where sight was lost that has not been found since."""
        self._reach_m = 0.0
        """How far from there the newest strand may begin."""
        self.found = 0
        """How many times a strand has been moved to where it belongs."""

    def __bool__(self) -> bool:
        """Is it unknown where the newest keyframes are?"""
        return self._open is not None

    @property
    def strands(self) -> list[Strand]:
        return self._loose if self._open is None else [*self._loose, self._open]

    def holds(self, key: int) -> bool:
        """Is it unknown where a variable is, against the first of all keyframes?"""
        return any(key in strand.own for strand in self.strands)

    def apart(self, key: int, other: int) -> bool:
        """Is it unknown where two variables are against each other?"""
        return any((key in strand.own) != (other in strand.own) for strand in self.strands)

    def foreign(self, key: int, keyframe: int | None = None) -> bool:
        """Is it unknown where a variable is, against a keyframe, or the frame that becomes one (None)?"""
        if keyframe is not None:
            return self.apart(key, keyframe)
        return self._fresh or not (self._is_ground(key) if self._open is None else key in self._open.own)

    def _is_ground(self, key: int) -> bool:
        return not self.holds(key)

    # A keyframe -----------------------------------------------------------------------------------------------

    def meet(self, frame: StereoFrame, sightings: list[MarkerSighting]) -> gtsam.Pose3 | None:
        """Looks for parts of the map other than its own in a frame that becomes a keyframe, and brings them together.

        Returns:
            `o_T_m` where the tracks have just broken and the frame shows where it is, else None: its motion says it.
        """
        gap_s = self._odometry.gap_of(frame)
        broken = gap_s > SHORT_S
        self._fresh = False
        if not broken and not self.strands:
            return None
        self._expected = self._odometry.expected()
        placed = None
        if broken or self._open is not None:
            found = self._seen_of(self._is_ground, frame, sightings)
            if found is not None and self._within_reach(found, gap_s):
                self._land(found, broken)
                placed = found
        if placed is None:
            placed = self._meet_strands(frame, sightings, broken)
        self._fresh = broken and placed is None
        return placed if broken else None

    def _land(self, found: gtsam.Pose3, broken: bool) -> None:
        """The camera is where it was before."""
        if broken:
            self._put_aside()
        elif self._open is not None:
            self._graph.flush()
            self._carry(self._open, found.compose(self._odometry.expected().inverse()))
            self._open = None
        self._reach_m = 0.0
        self.found += 1

    def _meet_strands(self, frame: StereoFrame, sightings: list[MarkerSighting], broken: bool) -> gtsam.Pose3 | None:
        """The same with parts that have been lost themselves, the newest first."""
        for strand in reversed(self._loose[:]):
            found = self._seen_of(strand.own.__contains__, frame, sightings)
            if found is None:
                continue
            self._loose.remove(strand)
            self.found += 1
            if broken:
                self._put_aside()
                self._open = strand
                return found
            self._graph.flush()
            expected = self._odometry.expected()
            if self._open is None:
                self._carry(strand, expected.compose(found.inverse()))
            else:
                self._carry(self._open, found.compose(expected.inverse()))
                self._open.join(strand)
        return None

    def enter(self, new: Update, frame: StereoFrame) -> None:
        """The frame has become a keyframe: `new` brings it and its landmarks."""
        key = keys.keyframe(self._odometry.last_keyframe)
        if self._fresh:
            self._fresh = False
            if not self._reach_m:
                self._left_at = self._expected.translation()
            self._put_aside()
            gap_s = self._odometry.gap_s
            self._reach_m += REACH * self._odometry.lost_speed_m_s * gap_s
            self._open = Strand(set(), key, key, frame.stamp_ns - round(1e9 * gap_s), frame.stamp_ns)
        if self._open is not None:
            self._open.last, self._open.last_ns = key, frame.stamp_ns
            self._open.own.update(new.values.keys())

    def include(self, new: Iterable[int], like: int) -> None:
        """New variables are where another one is."""
        for strand in self.strands:
            if like in strand.own:
                strand.own.update(new)

    def forget(self, gone: Iterable[int]) -> None:
        """These have left the graph: a strand of which nothing is left is past."""
        for strand in self.strands:
            strand.own.difference_update(gone)
        self._past = [*self._past, *(_told(strand) for strand in self._loose if not strand.own)][-MOST_TOLD:]
        self._loose = [strand for strand in self._loose if strand.own]

    # Strands --------------------------------------------------------------------------------------------------

    def _put_aside(self) -> None:
        """The newest strand ends where the tracks broke again."""
        if self._open is not None:
            self._reach_m += self._length_m(self._open)
            self._loose.append(self._open)
        self._open = None

    def _length_m(self, strand: Strand) -> float:
        """From its first keyframe to its last."""
        state = self._graph.state
        if not (state.has(strand.first) and state.has(strand.last)):
            return 0.0
        return float(np.linalg.norm(state.pose(strand.first).between(state.pose(strand.last)).translation()))

    def _within_reach(self, found: gtsam.Pose3, gap_s: float) -> bool:
        """Can the camera have got there since it was lost? How it turned in between is unknown."""
        left_at, reach_m = self._left_at, self._reach_m + REACH * self._odometry.lost_speed_m_s * gap_s
        if self._open is None:
            left_at = self._expected.translation()
        elif self._graph.state.has(self._open.first):
            reach_m += float(self._graph.state.pose(self._open.first).range(self._expected.translation()))
        return float(np.linalg.norm(found.translation() - left_at)) < reach_m

    def _carry(self, strand: Strand, correction: gtsam.Pose3) -> None:
        """All of a strand, moved in {o}; the solver begins anew from there, with what is seen now."""
        self._graph.relocate(strand.moved(self._graph.solver.values(), correction), strand.own, correction)

    # What a frame shows ---------------------------------------------------------------------------------------

    def _seen_of(self, part: Part, frame: StereoFrame, sightings: list[MarkerSighting]) -> gtsam.Pose3 | None:
        """`o_T_m` as a part of the map has it; landmarks first: a board may have been knocked meanwhile."""
        return self._by_landmarks(part, frame) or self._by_boards(part, sightings)

    def _by_boards(self, part: Part, sightings: list[MarkerSighting]) -> gtsam.Pose3 | None:
        known = [s for s in sightings if (sheet := self._boards.sheets[s.board]).known and part(sheet.key)]
        return place(self._boards, self._graph.state, known, (gtsam.Pose3(), 1 << 62)) if known else None

    def _by_landmarks(self, part: Part, frame: StereoFrame) -> gtsam.Pose3 | None:
        """From landmarks that the front end has found again."""
        wanted = {track for track in frame.track_ids.tolist() if part(keys.landmark(track))}
        return place_by_landmarks(self._graph.state, frame, wanted)

    # What a user has to know ----------------------------------------------------------------------------------

    def told(self) -> list[Event]:
        """Parts of the way that were never found to lie anywhere."""
        return [*self._past, *(_told(strand) for strand in self.strands)]


def _told(strand: Strand) -> Event:
    seconds = (strand.last_ns - strand.lost_ns) * 1e-9
    text = (
        f"the mobile camera lost sight, and for {seconds:.1f} s saw nothing that it had seen before or saw later: its "
        "way there hangs on a motion prior alone, and clicks there do not count; go on from places that have been seen "
        "or show it a board"
    )
    return Event(strand.lost_ns, "sight_lost", text, "warning", {"seconds": seconds})
