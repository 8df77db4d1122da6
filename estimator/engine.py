"""The joint estimator: measurements in, in the order of their time; an estimate at any moment.

One engine serves offline and streaming. `add` takes all measurements of one stamp and does one iSAM2 update when they
hold something for the graph.
"""

from collections.abc import Collection, Mapping

import gtsam
import numpy as np
from numpy.typing import NDArray

from ..factors import keys
from ..factors.board import distance_factor
from ..factors.camera import CameraModel
from ..factors.geometry import pose3
from ..factors.links import gauge_prior, mount_factor, mount_pose, weak_pose_prior
from ..factors.measurements import (
    BaseMove,
    CylinderSighting,
    Event,
    MarkerSighting,
    OutlineSighting,
    Pick,
    Rejection,
    StereoFrame,
)
from ..factors.noise import sigmas
from ..factors.rig import Distance, Rig
from ..frontends.pick_image import CutOut
from ..frontends.resection import camera_pose
from .boards import DISTANCES, Boards
from .bundle import Bundle
from .calibration_states import opened_calibration
from .depth_pipes import DepthPipes
from .graph import Record, State, Update
from .incremental import Incremental
from .marker_points import MarkerPoint, parse_point
from .observability import why_no_base
from .odometry import FAMILY as ODOMETRY
from .odometry import Odometry, OdometrySettings
from .pipes import Pipes, SeenFrom
from .placement import place
from .stations import Stations, move_event
from .surfaces import Associator, Surfaces, SurfaceSettings

Float = NDArray[np.float64]

MARKER_KEYFRAMES = 10
"""Keyframes of markers alone that share an update: each stands on known boards already, and every update touches the
corners of all of them."""

COLOUR_VIEWS = 60
"""Colour images of boards that wait for the machine's place: the last minute."""
COLOUR_GATE_PX = 5.0
"""Median error with which a board in the colour image may place the machine first."""

WAITING_BUNDLES = 200
"""Frames without a known board that a run without end keeps."""
WAITING_PICKS = 100


class Engine:
    """Graph, iSAM2 and the sensors' book-keeping of one run."""

    def __init__(
        self, rig: Rig, cameras: Mapping[str, CameraModel], associate: Associator, advises: bool = True
    ) -> None:
        self.rig = rig
        self.advises = advises
        """The result tells what to measure next; campaigns do without."""
        self.cameras = dict(cameras)
        self.state = State()
        self.solver = Incremental()
        sigma = rig.gates.robust_sigma
        self.odometry = Odometry(self.state, OdometrySettings(), sigma)
        self.odometry.joint_covariance = self.solver.joint_covariance
        self.boards = Boards(rig, self.state)
        self.stations = Stations(self.state)
        self.pipes = Pipes(rig, self.state)
        self.depth_pipes = DepthPipes(rig, self.state, self.pipes)
        self.surfaces = Surfaces(self.state, SurfaceSettings(), sigma, associate)
        self.events: list[Event] = []
        self.rejected: list[Rejection] = []
        self.picks: list[Pick] = []
        """All clicks, also those that were refused."""
        self.pick_images: dict[tuple[str, int, str], CutOut] = {}
        """What was clicked, by camera, stamp and point id, where there is an image."""
        self.keyframe_at: dict[int, int] = {}
        """Stamp to keyframe index."""
        self._recent: dict[int, tuple[StereoFrame, int, Float]] = {}
        self._distances_open = list(rig.distances)
        self._waiting: list[Bundle] = []
        self._forced = False
        self._colour: list[list[MarkerSighting]] = []
        """What the machine's colour camera saw of boards while it had no place."""
        self._mounted = False
        self._pending = Update()
        self.open_picks: list[tuple[Pick, tuple[float, float] | None]] = []
        """Clicks in a camera that has no place at their stamp so far, with the depth under them."""
        self._unsolved = 0
        """Keyframes since the last update."""
        self.astray = False
        """The map is from an earlier run, and the camera has not found itself in it."""
        self.end_ns = 0

    @property
    def base(self) -> int:
        """Key of `o_T_b` of the present station."""
        return self.stations.base

    # The loop -------------------------------------------------------------------------------------------------

    def add(self, bundle: Bundle) -> bool:
        """Takes one stamp's measurements; True when the estimate has changed."""
        self.end_ns = max(self.end_ns, bundle.stamp_ns)
        if bundle.moved is not None:
            self._move_base(bundle.moved)
        self._take(opened_calibration(self.state, self.rig, self.cameras, bundle))
        if bundle.frame is not None:
            self._follow(bundle.frame)
        if self._wants_keyframe(bundle):
            self._insert_keyframe(bundle)
        machine = [s for s in bundle.sightings if s.camera == "b_rgb"]
        if machine:
            self._colour = [*self._colour, machine][-COLOUR_VIEWS:]
        self._see_from_machine()
        if bundle.cloud is not None:
            self.surfaces.see(bundle.cloud)
        if not self._waits(bundle):
            self._picks_of(bundle)
        for outline in bundle.outlines:
            self.add_outline(outline)
        for cylinder in bundle.cylinders:
            self.add_cylinder(cylinder.pipe_id, self.base, cylinder)
        urgent = bundle.frame is not None or bundle.picks or bundle.outlines or bundle.cloud is not None
        return self.flush() if urgent or self._unsolved >= MARKER_KEYFRAMES else False

    def flush(self) -> bool:
        """One iSAM2 update with what has gathered."""
        if self._pending.empty():
            return False
        self._unsolved = 0
        update, self._pending = self._pending, Update()
        self.state.values = self.solver.update(update)
        return True

    def _take(self, update: Update) -> None:
        """New factors wait for the next update; their guesses count from now on."""
        if update.empty():
            return
        self.state.values.insert(update.values)
        self._pending.extend(update)

    # Keyframes ------------------------------------------------------------------------------------------------

    def _follow(self, frame: StereoFrame) -> None:
        self.odometry.follow(frame)

    def _wants_keyframe(self, bundle: Bundle) -> bool:
        mobile = _mobile(bundle)
        if bundle.frame is None:
            return bool(mobile)
        first = not self.odometry.keyframe_stamps
        picked = any(p.stamp_ns == bundle.stamp_ns and p.camera != "b_rgb" for p in bundle.picks)
        return first or bundle.frame.is_keyframe or picked

    def _insert_keyframe(self, bundle: Bundle) -> None:
        if bundle.frame is not None:
            placed = self._relocalised(bundle) if self.astray else None
            if self.astray and placed is None:
                return
            self.astray = False
            index = self.odometry.last_keyframe + 1
            update, rejected = self.odometry.insert(bundle.frame, placed)
            self.rejected += rejected
            self._take(update)
        else:
            placed = self._place_by_markers(bundle)
            if placed is None:
                return
            index = placed
        self.keyframe_at[bundle.stamp_ns] = index
        self._see_boards(keys.keyframe(index), bundle)
        self._open_base(bundle.stamp_ns)
        self._close_distances(bundle.stamp_ns)
        self._unsolved += 1
        if bundle.frame is not None:
            self.flush()
            self._lay_landmarks(index)

    def _relocalised(self, bundle: Bundle) -> gtsam.Pose3 | None:
        """Where the camera stands in the map of an earlier run, by the boards that it sees."""
        if not _mobile(bundle):
            return None
        return place(self.boards, self.state, bundle.sightings, (gtsam.Pose3(), 1 << 62))

    def promote(self, bundle: Bundle) -> bool:
        """Makes a frame of the recent past a keyframe, because somebody clicked in it; False where that is too late."""
        if bundle.frame is None or bundle.stamp_ns in self.keyframe_at:
            return bundle.stamp_ns in self.keyframe_at
        found = self.odometry.insert_late(bundle.frame)
        if found is None:
            return False
        self.rejected += found[1]
        self._take(found[0])
        index = self.odometry.last_keyframe
        self.keyframe_at[bundle.stamp_ns] = index
        self._see_boards(keys.keyframe(index), bundle)
        self.flush()
        return True

    def _see_boards(self, key: int, bundle: Bundle) -> None:
        mobile = _mobile(bundle)
        if not mobile:
            return
        joint = None
        if bundle.frame is not None and self.boards.displaced(self._camera_poses(key), mobile):
            self.flush()
            joint = self.solver.joint_covariance
        self._take(self.boards.add(key, self._camera_poses(key), mobile, self._forced, joint))

    def _camera_poses(self, key: int) -> dict[str, gtsam.Pose3]:
        o_T_m = self.state.pose(key)
        poses = {"m_left": o_T_m}
        if self.state.has(keys.extrinsics("m_right")):
            poses["m_right"] = o_T_m.compose(self.state.pose(keys.extrinsics("m_right")))
        return poses

    def _place_by_markers(self, bundle: Bundle) -> int | None:
        """A keyframe without tracks stands where the known boards put it; else it waits for one of them."""
        index = len(self.odometry.keyframe_stamps)
        if index == 0:
            found = gtsam.Pose3() if self._forced or self.boards.can_start(_mobile(bundle)) else None
        else:
            found = place(self.boards, self.state, bundle.sightings, self._nearest(bundle.stamp_ns))
        if found is None:
            self._waiting.append(bundle)
            return None
        pose = found
        update = Update()
        key = keys.keyframe(index)
        update.guess(key, pose)
        if index == 0:
            update.add(gauge_prior(key), Record("gauge", "gauge", bundle.stamp_ns, "origin {o}", rejectable=False))
        self.odometry.place(bundle.stamp_ns, index)
        self._take(update)
        return index

    def _nearest(self, stamp_ns: int) -> tuple[gtsam.Pose3, int]:
        """The keyframe nearest in time: its pose, and how far it is, ns."""
        if not self.keyframe_at:
            return gtsam.Pose3(), 1 << 62
        nearest = min(self.keyframe_at, key=lambda stamp: abs(stamp - stamp_ns))
        return self.state.pose(keys.keyframe(self.keyframe_at[nearest])), abs(nearest - stamp_ns)

    def revisit(self) -> None:
        """Frames that saw no known board get another chance, as long as that makes more boards known."""
        if self._waiting and not self.boards.any_known():
            self._start_from_best()
        while self._waiting:
            before = len(self._waiting)
            waiting, self._waiting = self._waiting, []
            for bundle in waiting:
                self._insert_keyframe(bundle)
                if not self._waits(bundle):
                    self._picks_of(bundle)
                if self._unsolved >= MARKER_KEYFRAMES:
                    self.flush()
            if len(self._waiting) == before:
                break
        self._see_from_machine()
        self._retry_picks()
        self.flush()

    def _start_from_best(self) -> None:
        """No frame is free of doubt: the one with the least begins."""
        best = max(self._waiting, key=lambda b: self.boards.margin(_mobile(b)))
        self._waiting.remove(best)
        self._forced = True
        self._insert_keyframe(best)
        self._forced = False
        self._picks_of(best)
        self.flush()

    def _waits(self, bundle: Bundle) -> bool:
        return bool(self._waiting) and self._waiting[-1] is bundle

    # The machine ----------------------------------------------------------------------------------------------

    def _open_base(self, stamp_ns: int) -> None:
        """{b} enters through the mount when its board is known."""
        mount = self.rig.mount
        base = self.base
        if mount is None or self._mounted or not self.boards.known(mount.board):
            return
        self._mounted = True
        board = self.boards.key(mount.board)
        update = Update()
        if not self.state.has(base):
            update.guess(base, self.state.pose(board).compose(mount_pose(mount)))
        what = f"f_T_b of board {mount.board}"
        update.add(mount_factor(mount, board, base), Record("mount", "mount", stamp_ns, what, rejectable=False))
        self._take(update)
        self._retry_picks()

    def place_base(self, o_T_b: gtsam.Pose3, stamp_ns: int, what: str) -> None:
        """{b} by surfaces that both cameras see: landmarks on them hold it, and leave loose what they do not fix."""
        update = Update()
        update.guess(self.base, o_T_b)
        record = Record("gauge", "start of {b}", stamp_ns, "weak prior of {b}", rejectable=False)
        update.add(weak_pose_prior(self.base, o_T_b, 3.0, 3.0), record)
        self._take(update)
        by_keyframe: dict[int, dict[int, int]] = {}
        for track, index in self.odometry.seen_in.items():
            by_keyframe.setdefault(index, {})[track] = self.odometry.observations[track]
        for index, observations in by_keyframe.items():
            if not self.state.has(keys.keyframe(index)):
                continue  # it has left the graph
            pose = self.state.pose(keys.keyframe(index))
            self._take(self.surfaces.lay(self.base, pose, observations))
        self.events.append(Event(stamp_ns, "base_by_cloud", f"{{b}} was placed without a board: {what}", "info"))
        self.flush()

    def _move_base(self, move: BaseMove) -> None:
        """The machine stands elsewhere now: a new {b}, and the landmarks are laid on what it sees from there."""
        self.flush()
        self._colour = []
        self._take(self.stations.move(move, self.boards))
        self._mounted = self._mounted and self.state.has(self.base)
        self.surfaces.restart()
        self.events.append(move_event(move))
        self.flush()

    def _see_from_machine(self) -> None:
        """Boards in the machine's colour images tie {b} to them directly, and may give it its first place."""
        base, extrinsics = self.base, keys.extrinsics("b_rgb")
        if not self._colour or not (self.state.has(base) or self._base_by_view()):
            return
        waiting, self._colour = self._colour, []
        for seen in waiting:
            poses = {"b_rgb": self.state.pose(base).compose(self.state.pose(extrinsics))}
            joint = None
            if self.boards.displaced(poses, seen):
                self.flush()
                poses = {"b_rgb": self.state.pose(base).compose(self.state.pose(extrinsics))}
                joint = self.solver.joint_covariance
            self._take(self.boards.add(base, poses, seen, False, joint))
        self._retry_picks()

    def _base_by_view(self) -> bool:
        """{b} from a colour image of a board that the mobile camera has placed; the corners then hold it."""
        for seen in reversed(self._colour):
            points, px = self.boards.known_corners(seen)
            found = camera_pose(points, px, self.state.intrinsics(keys.intrinsics("b_rgb")).K())
            if found is None or found[1] > COLOUR_GATE_PX:
                continue
            update = Update()
            b_T_rgb = self.state.pose(keys.extrinsics("b_rgb"))
            update.guess(self.base, pose3(found[0]).compose(b_T_rgb.inverse()))
            self._take(update)
            return True
        return False

    def _close_distances(self, stamp_ns: int) -> None:
        """Known distances enter when both of their points are in the graph."""
        still = []
        for distance in self._distances_open:
            a, b = (self.point_keys(parse_point(text, self.rig)) for text in (distance.point_a, distance.point_b))
            if a is None or b is None:
                still.append(distance)
                continue
            update = Update()
            factor = distance_factor(a, b, distance.distance_m, sigmas([distance.sigma_m]))
            what = distance_name(distance)
            update.add(factor, Record(DISTANCES, what, stamp_ns, what, rejectable=False))
            self._take(update)
        self._distances_open = still

    def point_keys(self, point: MarkerPoint) -> list[int] | None:
        """Keys of the corners whose mean a marker point is, None while it has not been seen."""
        slot = self.boards.slot_of(point.board, point.marker)
        if slot is None or not self.state.has(keys.corner(slot, 0)):
            return None
        corners = range(4) if point.corner is None else [point.corner]
        return [keys.corner(slot, i) for i in corners]

    def _lay_landmarks(self, index: int) -> None:
        if self.state.has(self.base) and self.state.has(keys.DEPTH):
            camera = self.state.pose(keys.keyframe(index))
            self._take(self.surfaces.lay(self.base, camera, self.odometry.observations))

    # Picks and pipes ------------------------------------------------------------------------------------------

    def seen_from(self, camera: str, stamp_ns: int) -> SeenFrom | None:
        """The pose that a camera's pixels at a stamp hang on, None when there is no keyframe."""
        if camera == "b_rgb":
            base = self.stations.at(stamp_ns)
            if base is None or not self.state.has(base):
                return None
            return SeenFrom(base, self.state.pose(base).compose(self.state.pose(keys.extrinsics("b_rgb"))))
        index = self.keyframe_at.get(stamp_ns)
        if index is None:
            return None
        return SeenFrom(keys.keyframe(index), self._camera_poses(keys.keyframe(index))[camera])

    def take_picks(self, bundle: Bundle) -> None:
        """Clicks in a keyframe that is in the graph already."""
        self._picks_of(bundle)
        self.flush()

    def _picks_of(self, bundle: Bundle) -> None:
        for pick in bundle.picks:
            self._pick(pick, bundle.depths_m.get(pick.point_id))

    def _pick(self, pick: Pick, depth_m: tuple[float, float] | None) -> None:
        self.picks.append(pick)
        where = self.seen_from(pick.camera, pick.stamp_ns)
        if where is None:
            self.open_picks.append((pick, depth_m))
        else:
            self._take(self.pipes.pick(pick, where, depth_m))

    def _retry_picks(self) -> None:
        """Picks whose camera had no place yet."""
        waiting, self.open_picks = self.open_picks, []
        for pick, depth_m in waiting:
            self._pick(pick, depth_m)

    def add_outline(self, outline: OutlineSighting) -> None:
        """Edges of a pipe in a keyframe's image; enters with the next update."""
        where = self.seen_from(outline.camera, outline.stamp_ns)
        if where is not None:
            self._take(self.pipes.outline(outline, where))

    def add_cylinder(self, pipe: str, base: int, found: CylinderSighting | Rejection) -> None:
        """A pipe in the Kinect's cloud of a station, or why it was not found; enters with the next update."""
        self.flush()
        self._take(self.depth_pipes.add(found, pipe, base, self.solver))

    def lost_picks(self) -> list[Pick]:
        """Picks in cameras that have no place at their stamp."""
        return [*(p for p, _ in self.open_picks), *(p for b in self._waiting for p in b.picks)]

    def why_no_base(self) -> str:
        """The missing link between {o} and {b}, in words."""
        mount = self.rig.mount
        return why_no_base(mount, mount is not None and self.boards.known(mount.board))

    def everything_rejected(self) -> list[Rejection]:
        """All measurements that did not enter, with reasons."""
        waiting = [
            Rejection(
                b.stamp_ns,
                "marker corners",
                f"{len(b.sightings)} markers of a frame",
                "no known board; boards",
                0.0,
                1.0,
            )
            for b in self._waiting
        ]
        waiting += [
            Rejection(
                p.stamp_ns, "picks", f"pick {p.point_id} in {p.camera}", "no frame of its stamp, frames", 0.0, 1.0
            )
            for p in self.lost_picks()
        ]
        given_up = [
            Rejection(self.end_ns, ODOMETRY, keys.words(key), "undetermined where its matches put it; views", 0.0, 1.0)
            for key in self.solver.dropped
        ]
        return [
            *self.rejected,
            *given_up,
            *self.boards.rejected,
            *self.boards.held_back(),
            *self.pipes.rejected,
            *self.pipes.held_back(),
            *self.depth_pipes.refused.values(),
            *self.surfaces.refused.values(),
            *waiting,
        ]

    # A run without end ----------------------------------------------------------------------------------------

    def unsolved(self) -> bool:
        """Are there factors that have not been through the solver?"""
        return not self._pending.empty()

    @property
    def mounted(self) -> bool:
        """Is the taped mount in the graph?"""
        return self._mounted

    @property
    def distances_open(self) -> list[Distance]:
        """Known distances that have not entered, because a point of them has not been seen."""
        return list(self._distances_open)

    def resume(self, memory: Update, keyframes: int, mounted: bool, distances_open: list[Distance]) -> None:
        """Goes on from what an earlier run knew, in the same {o}; the camera has to find itself again.

        Args:
            memory: the variables that live on, and one factor with all that is known about them.
            keyframes: how many the earlier run made; new ones count on from there.
        """
        self.state.values = self.solver.update(memory)
        self.odometry.keyframe_stamps = [0] * max(keyframes, 1)
        self._mounted = mounted
        self._distances_open = distances_open
        self.astray = True

    def held_keyframes(self) -> set[int]:
        """Keys of keyframes on which measurements hang that have not entered the graph."""
        held = {key for sheet in self.boards.sheets.values() for key, _ in sheet.held}
        held |= {view.keyframe for sheet in self.boards.sheets.values() for view in sheet.displaced}
        return held | self.pipes.held_keyframes()

    def forget(self, gone: Collection[int]) -> None:
        """Variables that have left the graph: nothing may hang on them any more."""
        left = {keys.index(k) for k in gone if keys.kind(k) == "x"}
        landmarks = {keys.index(k) for k in gone if keys.kind(k) == "l"}
        self.keyframe_at = {stamp: i for stamp, i in self.keyframe_at.items() if i not in left}
        self.odometry.forget(left, landmarks)
        self.surfaces.forget(landmarks)
        self.pipes.forget({k for k in gone if keys.kind(k) == "x"})
        self._waiting = self._waiting[-WAITING_BUNDLES:]
        self.open_picks = self.open_picks[-WAITING_PICKS:]

    def lists_of_rejections(self) -> list[list[Rejection]]:
        """Where refusals gather; whoever runs for hours shortens them."""
        return [self.rejected, *self.boards.lists_of_rejections(), self.pipes.rejected]

    def everything_told(self) -> list[Event]:
        return [*self.events, *self.boards.events]


def distance_name(distance: Distance) -> str:
    """How the factor of a known distance is called in its record."""
    return f"distance {distance.point_a} to {distance.point_b}"


def _mobile(bundle: Bundle) -> list[MarkerSighting]:
    """What the mobile cameras saw of boards."""
    return [s for s in bundle.sightings if s.camera != "b_rgb"]
