"""The machine in the graph: where {b} gets its place from, and what hangs on it."""

from collections.abc import Sequence

import gtsam
import numpy as np
from numpy.typing import NDArray

from ..factors import keys
from ..factors.geometry import pose3
from ..factors.links import mount_factor, mount_pose
from ..factors.measurements import BaseMove, Event, MarkerSighting
from ..factors.noise import gaussian
from ..factors.rig import Rig
from ..frontends.resection import camera_pose
from .boards import Boards
from .graph import Record, Update
from .odometry import Odometry
from .open_graph import OpenGraph
from .stations import Stations, move_event
from .surfaces import Surfaces

COLOUR_VIEWS = 60
"""Colour images of boards that wait for the machine's place: the last minute."""
LAY_ROUNDS = 3
"""Landmarks are laid anew after each solution: the first place of {b} is not good enough for all of them."""
COLOUR_GATE_PX = 5.0
"""Median error with which a board in the colour image may place the machine first."""


class Machine:
    """{b} enters through its mount, through a colour image of a board, or through surfaces; landmarks lie on what its
    depth camera sees."""

    def __init__(
        self, rig: Rig, graph: OpenGraph, boards: Boards, surfaces: Surfaces, odometry: Odometry, events: list[Event]
    ) -> None:
        self._mount = rig.mount
        self._graph = graph
        self._state = graph.state
        self._boards = boards
        self._surfaces = surfaces
        self._odometry = odometry
        self._events = events
        self.stations = Stations(graph.state)
        self.mounted = False
        """Is the taped mount in the graph?"""
        self._colour: list[Sequence[MarkerSighting]] = []
        """What the machine's colour camera saw of boards while it had no place."""

    @property
    def base(self) -> int:
        """Key of `o_T_b` of the present station."""
        return self.stations.base

    @property
    def placed(self) -> bool:
        """Is {b} in the graph?"""
        return self._state.has(self.base)

    def enter_by_mount(self, stamp_ns: int) -> bool:
        """{b} enters through the mount when its board is known; True when it did just now."""
        mount, base = self._mount, self.base
        if mount is None or self.mounted or not self._boards.known(mount.board):
            return False
        self.mounted = True
        board = self._boards.key(mount.board)
        update = Update()
        if not self._state.has(base):
            update.guess(base, self._state.pose(board).compose(mount_pose(mount)))
        what = f"f_T_b of board {mount.board}"
        update.add(mount_factor(mount, board, base), Record("mount", "mount", stamp_ns, what, rejectable=False))
        self._graph.take(update)
        return True

    def enter_by_surfaces(
        self, o_T_b: gtsam.Pose3, by_colour: tuple[gtsam.Pose3, NDArray[np.float64]], stamp_ns: int, what: str
    ) -> None:
        """{b} by surfaces that both cameras see.

        Landmarks on them hold it. What few of them leave loose, such as a turn about the normal of a wall, the colours
        hold: noise alone would carry {b} so far that nothing lies on a surface any more.

        Args:
            o_T_b: where the surfaces put it.
            by_colour: `o_T_b` and its covariance, of other measurements than those of surfaces.
        """
        update = Update()
        update.guess(self.base, o_T_b)
        record = Record(
            "colour view", "place of {b} by colour", stamp_ns, "{b} by features in colour", rejectable=False
        )
        pose, covariance = by_colour
        update.add(gtsam.PriorFactorPose3(self.base, pose, gaussian(covariance)), record)
        self._graph.take(update)
        for _ in range(LAY_ROUNDS):
            self.lay_all_landmarks()
            self._graph.flush()
        self._events.append(Event(stamp_ns, "base_by_cloud", f"{{b}} was placed without a board: {what}", "info"))

    def lay_all_landmarks(self) -> None:
        """Those that lay on no surface may do so now that {b} is known better."""
        self._surfaces.retry()
        by_keyframe: dict[int, dict[int, int]] = {}
        for track, index in self._odometry.seen_in.items():
            by_keyframe.setdefault(index, {})[track] = self._odometry.observations[track]
        for index, observations in by_keyframe.items():
            if not self._state.has(keys.keyframe(index)):
                continue  # it has left the graph
            pose = self._state.pose(keys.keyframe(index))
            self._graph.take(self._surfaces.lay(self.base, pose, observations))

    def move(self, move: BaseMove) -> None:
        """The machine stands elsewhere now: a new {b}, and the landmarks are laid on what it sees from there."""
        self._graph.flush()
        self._colour = []
        self._graph.take(self.stations.move(move, self._boards))
        self.mounted = self.mounted and self.placed
        self._surfaces.restart()
        self._events.append(move_event(move))
        self._graph.flush()

    def see_boards(self, sightings: Sequence[MarkerSighting]) -> bool:
        """Boards in the machine's colour images tie {b} to them directly, and may give it its first place.

        Returns:
            True when what has been seen so far has entered the graph.
        """
        if sightings:
            self._colour = [*self._colour, sightings][-COLOUR_VIEWS:]
        if not self._colour or not (self.placed or self._enter_by_view()):
            return False
        waiting, self._colour = self._colour, []
        for seen in waiting:
            poses, joint = self._colour_poses(), None
            if self._boards.displaced(poses, seen):
                self._graph.flush()
                poses, joint = self._colour_poses(), self._graph.solver.joint_covariance
            self._graph.take(self._boards.add(self.base, poses, seen, False, joint))
        return True

    def lay_landmarks(self, keyframe: int) -> None:
        """The landmarks of a keyframe are laid on the surfaces that the depth camera sees."""
        if self.placed and self._state.has(keys.DEPTH):
            camera = self._state.pose(keys.keyframe(keyframe))
            self._graph.take(self._surfaces.lay(self.base, camera, self._odometry.observations))

    def _colour_poses(self) -> dict[str, gtsam.Pose3]:
        return {"b_rgb": self._state.pose(self.base).compose(self._state.pose(keys.extrinsics("b_rgb")))}

    def _enter_by_view(self) -> bool:
        """{b} from a colour image of a board that the mobile camera has placed; the corners then hold it."""
        for seen in reversed(self._colour):
            points, px = self._boards.known_corners(seen)
            found = camera_pose(points, px, self._state.intrinsics(keys.intrinsics("b_rgb")).K())
            if found is None or found[1] > COLOUR_GATE_PX:
                continue
            update = Update()
            b_T_rgb = self._state.pose(keys.extrinsics("b_rgb"))
            update.guess(self.base, pose3(found[0]).compose(b_T_rgb.inverse()))
            self._graph.take(update)
            return True
        return False
