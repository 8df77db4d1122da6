"""The joint estimator: measurements in, in the order of their time; an estimate at any moment.

One engine serves offline and streaming. `add` takes all measurements of one stamp and does one iSAM2 update when they
hold something for the graph.
"""

from collections.abc import Collection, Mapping

import gtsam

from ..factors import keys
from ..factors.camera import CameraModel
from ..factors.links import gauge_prior
from ..factors.measurements import (
    CylinderSighting,
    Event,
    MarkerSighting,
    OutlineSighting,
    Pick,
    Rejection,
)
from ..factors.rig import Distance, Rig
from ..frontends.pick_image import CutOut
from .adrift import Adrift
from .album import Album
from .boards import Boards
from .bundle import Bundle
from .calibration_states import opened_calibration
from .depth_pipes import DepthPipes
from .graph import Record, Update
from .known_distances import KnownDistances
from .machine import Machine
from .observability import why_no_base
from .odometry import Odometry, OdometrySettings
from .open_graph import OpenGraph
from .open_views import UNPLACED, OpenViews
from .pipe_parts import SeenFrom
from .pipes import Pipes
from .placement import place, place_again
from .surfaces import Associator, Surfaces, SurfaceSettings

MARKER_KEYFRAMES = 10
"""Keyframes of markers alone that share an update: each stands on known boards already, and every update touches the
corners of all of them."""

WAITING_BUNDLES = 200
"""Frames without a known board that a run without end keeps."""


class Engine:
    """Graph, iSAM2 and the sensors' book-keeping of one run."""

    def __init__(
        self, rig: Rig, cameras: Mapping[str, CameraModel], associate: Associator, advises: bool = True,
        together: int = 1,
    ) -> None:  # fmt: skip
        """
        Args:
            associate: lays landmarks on surfaces.
            advises: the result tells what to measure next; campaigns do without.
            together: keyframes that share an update of the solver. Calibration ties all of them together, so that each
                update costs a good part of a batch solution; where nobody waits for the answer, some can share it.
        """
        self.rig = rig
        self.advises = advises
        self._together = together
        self.cameras = dict(cameras)
        self.graph = OpenGraph()
        self.state, self.solver = self.graph.state, self.graph.solver
        sigma = rig.gates.robust_sigma
        self.odometry = Odometry(self.state, OdometrySettings(), sigma)
        self.odometry.gate.joint_covariance = self.graph.joint_covariance
        self.boards = Boards(rig, self.state)
        self.pipes = Pipes(rig, self.state)
        self.depth_pipes = DepthPipes(rig, self.state, self.pipes)
        self.adrift = Adrift(self.graph, self.odometry, self.boards)
        self.odometry.foreign, self.boards.apart = self.adrift.foreign, self.adrift.apart
        self.surfaces = Surfaces(self.state, SurfaceSettings(), sigma, associate)
        self.surfaces.loose = self.adrift.holds
        self.distances = KnownDistances(rig, self.state, self.boards)
        self.events: list[Event] = []
        self.machine = Machine(rig, self.graph, self.boards, self.surfaces, self.odometry, self.events)
        self.stations = self.machine.stations
        self.rejected: list[Rejection] = []
        self.picks: list[Pick] = []
        """All clicks, also those that were refused."""
        self.pick_images: dict[tuple[str, int, str], CutOut] = {}
        """What was clicked, by camera, stamp and point id, where there is an image."""
        self.keyframe_at: dict[int, int] = {}
        """Stamp to keyframe index."""
        self.waiting: list[Bundle] = []
        """Frames that saw no known board, where there are no tracks."""
        self._forced = False
        self.open_views = OpenViews()
        """Clicks and outlines in a camera that has no place at their stamp so far."""
        self._unsolved = 0
        """Keyframes since the last update."""
        self.astray = False
        """The map is from an earlier run, and the camera has not found itself in it."""
        self.end_ns = 0
        self.album = Album()

    # The loop -------------------------------------------------------------------------------------------------

    def add(self, bundle: Bundle) -> bool:
        """Takes one stamp's measurements; True when the estimate has changed."""
        self.end_ns = max(self.end_ns, bundle.stamp_ns)
        if bundle.moved is not None:
            before = self.base
            self.machine.move(bundle.moved)
            self.adrift.include([self.base, *self.boards.on_machine()], before)
        self.graph.take(opened_calibration(self.state, self.rig, self.cameras, bundle))
        if bundle.frame is not None:
            self.odometry.follow(bundle.frame)
        if self._wants_keyframe(bundle):
            self._insert_keyframe(bundle)
        if self.machine.see_boards(self._comparable([s for s in bundle.sightings if s.camera == "b_rgb"], self.base)):
            self._retry_picks()
        if bundle.cloud is not None:
            self.surfaces.see(bundle.cloud)
        if not self._waits(bundle):
            self._picks_of(bundle)
        for outline in bundle.outlines:
            self.add_outline(outline)
        for cylinder in bundle.cylinders:
            self.add_cylinder(cylinder.pipe_id, self.base, cylinder)
        urgent = bundle.picks or bundle.outlines or bundle.cloud is not None
        most = MARKER_KEYFRAMES if bundle.frame is None else self._together
        return self.flush() if urgent or self._unsolved >= most else False

    def flush(self) -> bool:
        """One iSAM2 update with what has gathered."""
        self._unsolved = 0
        return self.graph.flush()

    # Keyframes ------------------------------------------------------------------------------------------------

    def _wants_keyframe(self, bundle: Bundle) -> bool:
        mobile = _mobile(bundle)
        if bundle.frame is None:
            return bool(mobile)
        first = not self.odometry.keyframe_stamps
        picked = any(p.stamp_ns == bundle.stamp_ns and p.camera != "b_rgb" for p in bundle.picks)
        return first or bundle.frame.is_keyframe or picked

    def _insert_keyframe(self, bundle: Bundle) -> None:
        if bundle.frame is not None:
            found = self.adrift.found
            frame, mobile = bundle.frame, _mobile(bundle)
            if self.astray:
                placed = place_again(self.boards, self.state, mobile, frame, self.odometry.observations)
            else:
                placed = self.adrift.meet(frame, mobile)
            if self.astray and placed is None:
                return
            self.astray = False
            index = self.odometry.last_keyframe + 1
            update, rejected = self.odometry.insert(bundle.frame, placed)
            self.rejected += rejected
            self.graph.take(update)
            self.adrift.enter(update, bundle.frame)
        else:
            placed = self._place_by_markers(bundle)
            if placed is None:
                return
            index, found = placed, self.adrift.found
        self.keyframe_at[bundle.stamp_ns] = index
        self._see_boards(keys.keyframe(index), bundle)
        if self.machine.enter_by_mount(bundle.stamp_ns):
            self.adrift.include([self.base], self.boards.key(self.rig.mount.board) if self.rig.mount else -1)
            self._retry_picks()
        self.graph.take(self.distances.close(bundle.stamp_ns))
        self._unsolved += 1
        if bundle.frame is not None:
            if self.adrift or self._unsolved >= self._together or self.adrift.found > found:
                self.flush()
            if self.adrift.found > found:
                self._retry_picks()
            if not self.adrift:
                self.machine.lay_landmarks(index)

    def promote(self, bundle: Bundle) -> bool:
        """Makes a frame of the recent past a keyframe, because somebody clicked in it; False where that is too late."""
        if bundle.frame is None or bundle.stamp_ns in self.keyframe_at:
            return bundle.stamp_ns in self.keyframe_at
        found = self.odometry.insert_late(bundle.frame)
        if found is None:
            return False
        self.rejected += found[1]
        self.graph.take(found[0])
        self.adrift.include(found[0].values.keys(), found[2])
        index = self.odometry.last_keyframe
        self.keyframe_at[bundle.stamp_ns] = index
        self._see_boards(keys.keyframe(index), bundle)
        self.flush()
        return True

    def _see_boards(self, key: int, bundle: Bundle) -> None:
        mobile = self._comparable(_mobile(bundle), key)
        if not mobile:
            return
        joint = None
        if bundle.frame is not None and self.boards.displaced(self._camera_poses(key), mobile):
            self.flush()
            joint = self.solver.joint_covariance
        update = self.boards.add(key, self._camera_poses(key), mobile, self._forced, joint)
        self.graph.take(update)
        self.adrift.include(update.values.keys(), key)

    def _comparable(self, sightings: list[MarkerSighting], key: int) -> list[MarkerSighting]:
        """Without boards of which it is unknown where they are against a pose: nothing may be concluded from them."""
        if not self.adrift.strands:
            return sightings
        apart = {name for name, s in self.boards.sheets.items() if s.known and self.adrift.apart(s.key, key)}
        for name in apart:
            seen = [s for s in sightings if s.board == name]
            self.boards.news.refuse(self.boards.sheets[name], seen, UNPLACED, 0.0, 1.0)
        return [s for s in sightings if s.board not in apart]

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
            self.waiting.append(bundle)
            return None
        pose = found
        update = Update()
        key = keys.keyframe(index)
        update.guess(key, pose)
        if index == 0:
            update.add(gauge_prior(key), Record("gauge", "gauge", bundle.stamp_ns, "origin {o}", rejectable=False))
        self.odometry.place(bundle.stamp_ns, index)
        self.graph.take(update)
        return index

    def _nearest(self, stamp_ns: int) -> tuple[gtsam.Pose3, int]:
        """The keyframe nearest in time: its pose, and how far it is, ns."""
        if not self.keyframe_at:
            return gtsam.Pose3(), 1 << 62
        nearest = min(self.keyframe_at, key=lambda stamp: abs(stamp - stamp_ns))
        return self.state.pose(keys.keyframe(self.keyframe_at[nearest])), abs(nearest - stamp_ns)

    def revisit(self) -> None:
        """Frames that saw no known board get another chance, as long as that makes more boards known."""
        if self.waiting and not self.boards.any_known():
            self._start_from_best()
        while self.waiting:
            before = len(self.waiting)
            waiting, self.waiting = self.waiting, []
            for bundle in waiting:
                self._insert_keyframe(bundle)
                if not self._waits(bundle):
                    self._picks_of(bundle)
                if self._unsolved >= MARKER_KEYFRAMES:
                    self.flush()
            if len(self.waiting) == before:
                break
        self.machine.see_boards(())
        self._retry_picks()
        self.flush()

    def _start_from_best(self) -> None:
        """No frame is free of doubt: the one with the least begins."""
        best = max(self.waiting, key=lambda b: self.boards.margin(_mobile(b)))
        self.waiting.remove(best)
        self._forced = True
        self._insert_keyframe(best)
        self._forced = False
        self._picks_of(best)
        self.flush()

    def _waits(self, bundle: Bundle) -> bool:
        return bool(self.waiting) and self.waiting[-1] is bundle

    @property
    def base(self) -> int:
        """Key of `o_T_b` of the present station."""
        return self.machine.base

    # Picks and pipes ------------------------------------------------------------------------------------------

    def seen_from(self, camera: str, stamp_ns: int) -> SeenFrom | None:
        """The pose that a camera's pixels at a stamp hang on, None when there is no keyframe."""
        if camera == "b_rgb":
            base = self.stations.at(stamp_ns)
            if base is None or not self.state.has(base):
                return None
            return SeenFrom(base, self.state.pose(base).compose(self.state.pose(keys.extrinsics("b_rgb"))))
        index = self.keyframe_at.get(stamp_ns)
        if index is None or self.loose(keys.keyframe(index)):
            return None
        return SeenFrom(keys.keyframe(index), self._camera_poses(keys.keyframe(index))[camera])

    def loose(self, key: int) -> bool:
        """Is a variable in a part of the map of which it is unknown where it is against {b}?"""
        return self.adrift.holds(key) and self.adrift.apart(key, self.base)

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
            self.open_views.picks.append((pick, depth_m))
        else:
            self._hang(self.pipes.pick(pick, where, depth_m), where)

    def _hang(self, update: Update, where: SeenFrom) -> None:
        self.graph.take(update)
        self.adrift.include(update.values.keys(), where.key)

    def _retry_picks(self) -> None:
        """Picks and outlines whose camera had no place yet."""
        waiting, self.open_views = self.open_views, OpenViews()
        for pick, depth_m in waiting.picks:
            self._pick(pick, depth_m)
        for outline in waiting.outlines:
            self.add_outline(outline)

    def add_outline(self, outline: OutlineSighting) -> None:
        """Edges of a pipe in a keyframe's image; enters with the next update."""
        where = self.seen_from(outline.camera, outline.stamp_ns)
        if where is not None:
            self._hang(self.pipes.outline(outline, where), where)
        elif outline.stamp_ns in self.keyframe_at:
            self.open_views.outlines.append(outline)

    def add_cylinder(self, pipe: str, base: int, found: CylinderSighting | Rejection) -> None:
        """A pipe in the Kinect's cloud of a station, or why it was not found; enters with the next update."""
        self.flush()
        self.graph.take(self.depth_pipes.add(found, pipe, base, self.solver))

    def lost_picks(self) -> list[Pick]:
        """Picks in cameras that have no place at their stamp."""
        return [*(p for p, _ in self.open_views.picks), *(p for b in self.waiting for p in b.picks)]

    def why_no_base(self) -> str:
        """The missing link between {o} and {b}, in words."""
        mount = self.rig.mount
        return why_no_base(mount, mount is not None and self.boards.known(mount.board))

    # A run without end ----------------------------------------------------------------------------------------

    def resume(self, memory: Update, keyframes: int, mounted: bool, distances_open: list[Distance]) -> None:
        """Goes on from what an earlier run knew, in the same {o}; the camera has to find itself again.

        Args:
            memory: the variables that live on, and one factor with all that is known about them.
            keyframes: how many the earlier run made; new ones count on from there.
        """
        self.state.values = self.solver.update(memory)
        self.odometry.keyframe_stamps = [0] * max(keyframes, 1)
        self.machine.mounted = mounted
        self.distances.open = distances_open
        self.astray = True

    def held_keyframes(self) -> set[int]:
        """Keys of keyframes on which measurements hang that have not entered the graph."""
        held = {key for sheet in self.boards.sheets.values() for key, _ in sheet.held}
        held |= {view.keyframe for sheet in self.boards.sheets.values() for view in sheet.displaced}
        held |= {keys.keyframe(self.keyframe_at[at]) for at in self.open_views.stamps() if at in self.keyframe_at}
        return held | self.pipes.held_keyframes()

    def forget(self, gone: Collection[int]) -> None:
        """Variables that have left the graph: nothing may hang on them any more."""
        left = {keys.index(k) for k in gone if keys.kind(k) == "x"}
        landmarks = {keys.index(k) for k in gone if keys.kind(k) == "l"}
        self.keyframe_at = {stamp: i for stamp, i in self.keyframe_at.items() if i not in left}
        self.odometry.forget(left, landmarks)
        self.adrift.forget(gone)
        self.surfaces.forget(landmarks)
        self.pipes.forget({k for k in gone if keys.kind(k) == "x"})
        self.waiting = self.waiting[-WAITING_BUNDLES:]
        self.open_views.shorten()

    def everything_told(self) -> list[Event]:
        return [*self.events, *self.boards.events, *self.adrift.told()]


def _mobile(bundle: Bundle) -> list[MarkerSighting]:
    """What the mobile cameras saw of boards."""
    return [s for s in bundle.sightings if s.camera != "b_rgb"]
