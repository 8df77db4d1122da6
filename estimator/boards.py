"""Boards in the graph: where a page starts from, its corners, side length and scale, and what contradicts the rig."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from ..factors import keys
from ..factors.board import DIRECTIONS, marker_rotation, page_corners, page_factor, print_scale_prior, side_prior
from ..factors.geometry import pose3
from ..factors.measurements import Event, MarkerSighting, Rejection
from ..factors.noise import gaussian, robust
from ..factors.projection import machine_projection, mobile_projection
from ..factors.rig import Board, Marker, Rig
from ..frontends.resection import PlanarPose, page_pose_and_side, planar_poses
from .graph import Record, State, Update
from .view_cells import ViewCells

Float = NDArray[np.float64]

FAMILY = "marker corners"
GEOMETRY = "board geometry"
DISTANCES = "known distances"
FREE_SIDE_REL = 0.5
"""Sigma of a side length whose given value the log contradicts: it says no more than that there is one."""
SIDE_GATE_SIGMA = 5.0
VIEWS_TO_DECIDE = 3
"""A first pose that stays ambiguous after so many keyframes takes the better of the two and says so."""


@dataclass(slots=True)
class _Sheet:
    """One board's standing in the graph."""

    index: int
    board: Board
    epoch: int = 0
    known: bool = False
    page_known: bool = False
    slots: dict[int, int] = field(default_factory=dict)
    """Marker id to slot, of the present epoch."""
    held: list[tuple[int, list[MarkerSighting]]] = field(default_factory=list)
    """Keyframe key and sightings, until the first pose is sure."""
    views: dict[str, int] = field(default_factory=dict)
    last_seen_ns: int | None = None

    @property
    def key(self) -> int:
        return keys.board(self.index, self.epoch)


class Boards:
    """All boards of the rig."""

    def __init__(self, rig: Rig, state: State) -> None:
        self._rig = rig
        self._state = state
        self._sheets = {board.id: _Sheet(i, board) for i, board in enumerate(rig.boards)}
        self._markers = {(b.id, m.id): m for b in rig.boards for m in b.markers}
        self._next_slot = 0
        self._cells: dict[tuple[str, str], ViewCells] = {}
        self.events: list[Event] = []
        self.rejected: list[Rejection] = []

    def known(self, board: str) -> bool:
        """Has the board a pose in the graph?"""
        return self._sheets[board].known

    def any_known(self) -> bool:
        return any(sheet.known for sheet in self._sheets.values())

    def key(self, board: str) -> int:
        return self._sheets[board].key

    def index(self, board: str) -> int:
        return self._sheets[board].index

    def last_seen_ns(self) -> int | None:
        """Stamp of the newest accepted sighting of any board."""
        return max((s.last_seen_ns for s in self._sheets.values() if s.last_seen_ns is not None), default=None)

    def known_corners(self, sightings: Sequence[MarkerSighting]) -> tuple[Float, Float]:
        """Corners of {o} that are known and seen: points (n, 3) and pixels (n, 2)."""
        points, px = [], []
        for sighting in sightings:
            sheet = self._sheets[sighting.board]
            if sheet.known:
                points.append(self._predicted(sheet, sighting.marker))
                px.append(sighting.corners_px)
        if not points:
            return np.zeros((0, 3)), np.zeros((0, 2))
        return np.concatenate(points), np.concatenate(px)

    def o_T_camera(self, seen: Sequence[MarkerSighting]) -> list[gtsam.Pose3]:
        """Both poses of a camera from what it sees of one known board (the first sighting's)."""
        sheet = self._sheets[seen[0].board]
        mine = [s for s in seen if s.board == seen[0].board]
        K = self._state.intrinsics(keys.intrinsics(seen[0].camera)).K()
        side = float(self._state.vector(keys.page(sheet.index))[0])
        o_T_f = self._state.pose(sheet.key)
        return [
            o_T_f.compose(pose3(p.camera_T_plane).inverse())
            for p in self._candidates(sheet.board, mine, K, (side, None))
        ]

    def _predicted(self, sheet: _Sheet, marker: int) -> Float:
        """Corners of a marker in {o}, shape (4, 3), from the board's pose and page."""
        side, scale = self._state.vector(keys.page(sheet.index))
        page = page_corners(self._markers[sheet.board.id, marker], side, scale)
        return np.array([self._state.pose(sheet.key).transformFrom(corner) for corner in page])

    def add(
        self,
        keyframe: int,
        camera_poses: dict[str, gtsam.Pose3],
        sightings: Sequence[MarkerSighting],
        force: bool = False,
    ) -> Update:
        """Sightings at a keyframe.

        Args:
            keyframe: key of the pose that the cameras hang on (`o_T_m` or `o_T_b`).
            camera_poses: `o_T_c` of each camera as believed now.
            force: a board starts even from a view that allows two poses.
        """
        update = Update()
        for name, sheet in self._sheets.items():
            seen = [s for s in sightings if s.board == name and (name, s.marker) in self._markers]
            if not seen:
                continue
            if not sheet.known:
                sheet.held.append((keyframe, seen))
                if not self._start(sheet, camera_poses, seen, update, force):
                    continue
                held, sheet.held = sheet.held, []
                for key, earlier in held:
                    self._observe(sheet, key, None, earlier, update)
            else:
                self._observe(sheet, keyframe, camera_poses, seen, update)
        return update

    # First pose -----------------------------------------------------------------------------------------------

    def can_start(self, sightings: Sequence[MarkerSighting]) -> bool:
        """Would a board get its first pose from these sightings of one frame alone?"""
        by_view: dict[tuple[str, str], list[MarkerSighting]] = {}
        for s in sightings:
            by_view.setdefault((s.board, s.camera), []).append(s)
        return any(self.margin(seen) > self.gate() for seen in by_view.values())

    def margin(self, seen: list[MarkerSighting]) -> float:
        """Chi-square by which the second pose of a board in one image is worse than the first; infinite for one."""
        sheet = self._sheets[seen[0].board]
        K = self._state.intrinsics(keys.intrinsics(seen[0].camera)).K()
        side = self._side(sheet, seen, K)
        poses = self._candidates(sheet.board, seen, K, side)
        here = {seen[0].camera: gtsam.Pose3()}
        scores = sorted(self._score(sheet.board, here, seen, pose3(p.camera_T_plane), side) for p in poses)
        if not scores:
            return -1.0
        return scores[1] - scores[0] if len(scores) > 1 else float("inf")

    def gate(self) -> float:
        """Chi-square that six degrees of freedom exceed by chance with the gate's probability."""
        return float(chi2.ppf(1 - self._rig.gates.gate_probability, 6))

    def _start(
        self,
        sheet: _Sheet,
        camera_poses: dict[str, gtsam.Pose3],
        seen: list[MarkerSighting],
        update: Update,
        force: bool = False,
    ) -> bool:
        """Gives the board its first pose when one is sure; adds its variables and priors."""
        camera = max(camera_poses, key=lambda c: sum(s.camera == c for s in seen))
        mine = [s for s in seen if s.camera == camera]
        K = self._state.intrinsics(keys.intrinsics(camera)).K()
        side = self._side(sheet, mine, K)
        candidates = self._candidates(sheet.board, mine, K, side)
        poses = [camera_poses[camera].compose(pose3(p.camera_T_plane)) for p in candidates]
        if not poses:
            return False
        scores = [self._score_of_held(sheet, pose, side) for pose in poses]
        order = np.argsort(scores)
        if len(poses) > 1 and scores[order[1]] - scores[order[0]] < self.gate():
            if len(sheet.held) < VIEWS_TO_DECIDE and not force:
                return False
            text = f"board {sheet.board.id} starts from a view that allows two poses; took the better one"
            self._say(seen[0].stamp_ns, "ambiguous_start", text, "info")
        update.guess(sheet.key, poses[int(order[0])])
        self._open_page(sheet, side, seen[0].stamp_ns, update)
        sheet.known = True
        return True

    def _score_of_held(self, sheet: _Sheet, o_T_f: gtsam.Pose3, side: tuple[float, float | None]) -> float:
        """Chi-square of a pose over all views that were held back."""
        total = 0.0
        for key, seen in sheet.held:
            poses = {s.camera: self._camera_pose(key, s.camera) for s in seen}
            total += self._score(sheet.board, poses, seen, o_T_f, side)
        return total

    def _camera_pose(self, key: int, camera: str) -> gtsam.Pose3:
        pose = self._state.pose(key)
        return pose if camera == "m_left" else pose.compose(self._state.pose(keys.extrinsics(camera)))

    def _side(self, sheet: _Sheet, seen: list[MarkerSighting], K: Float) -> tuple[float, float | None]:
        """Side length to start with, and the sigma with which the image itself knows it (None: not at all)."""
        markers = [self._markers[sheet.board.id, s.marker] for s in seen]
        centres = np.array([[*m.centre_m, 0.0] for m in markers])
        halves = np.array([0.5 * DIRECTIONS @ marker_rotation(m).T for m in markers])
        px = np.array([s.corners_px for s in seen])
        sigma = np.array([np.sqrt(np.trace(s.covariance_px2, axis1=1, axis2=2) / 2) for s in seen])
        implied = page_pose_and_side(centres, halves, px, sigma, K, sheet.board.side_m)
        if implied is None:
            return sheet.board.side_m, None
        return implied

    @staticmethod
    def _candidates(
        board: Board, seen: list[MarkerSighting], K: Float, side: tuple[float, float | None]
    ) -> list[PlanarPose]:
        lookup = {m.id: m for m in board.markers}
        plane = np.concatenate([page_corners(lookup[s.marker], side[0]) for s in seen])
        return planar_poses(plane, np.concatenate([s.corners_px for s in seen]), K)

    def _score(
        self,
        board: Board,
        camera_poses: dict[str, gtsam.Pose3],
        seen: list[MarkerSighting],
        o_T_f: gtsam.Pose3,
        side: tuple[float, float | None],
    ) -> float:
        """Chi-square of a pose over all cameras that see the board now."""
        total = 0.0
        for s in seen:
            o_p = [o_T_f.transformFrom(c) for c in page_corners(self._markers[board.id, s.marker], side[0])]
            residual = s.corners_px - self._pixels(s.camera, camera_poses[s.camera], np.array(o_p))
            total += float(np.einsum("ni,nij,nj->", residual, np.linalg.inv(s.covariance_px2), residual))
        return total

    def _pixels(self, camera: str, o_T_c: gtsam.Pose3, points: Float) -> Float:
        c_p = (points - o_T_c.translation()) @ o_T_c.rotation().matrix()
        K = self._state.intrinsics(keys.intrinsics(camera)).K()
        return (c_p @ K.T)[:, :2] / c_p[:, 2:]

    def _open_page(self, sheet: _Sheet, side: tuple[float, float | None], stamp_ns: int, update: Update) -> None:
        """Side length and scale as states; a given side that the image contradicts does not enter."""
        if sheet.page_known:
            return
        board, page = sheet.board, keys.page(sheet.index)
        update.guess(page, np.array([side[0], 1.0]))
        sigma = board.side_sigma_m
        if side[1] is not None:
            off = abs(side[0] - board.side_m) / np.hypot(side[1], board.side_sigma_m)
            if off > SIDE_GATE_SIGMA:
                sigma = FREE_SIDE_REL * side[0]
                text = (
                    f"board {board.id}: the rig says side {1e3 * board.side_m:.1f} mm, the log says "
                    f"{1e3 * side[0]:.1f} +/- {1e3 * side[1]:.1f} mm; used the log's"
                )
                self._say(
                    stamp_ns,
                    "side_length_wrong",
                    text,
                    "warning",
                    given_m=board.side_m,
                    seen_m=side[0],
                    sigma_m=side[1],
                )
                self.rejected.append(
                    Rejection(stamp_ns, GEOMETRY, f"side of board {board.id}", "off by sigmas", off, SIDE_GATE_SIGMA)
                )
        mean = board.side_m if sigma == board.side_sigma_m else side[0]
        what = f"side of board {board.id}"
        update.add(side_prior(page, board, mean, sigma), Record(GEOMETRY, what, stamp_ns, what, rejectable=False))
        what = f"print scale of board {board.id}"
        update.add(print_scale_prior(page, board), Record(DISTANCES, what, stamp_ns, what, rejectable=False))
        sheet.page_known = True

    # Corners --------------------------------------------------------------------------------------------------

    def _observe(
        self,
        sheet: _Sheet,
        keyframe: int,
        camera_poses: dict[str, gtsam.Pose3] | None,
        seen: list[MarkerSighting],
        update: Update,
    ) -> None:
        accepted = seen if camera_poses is None else self._gated(sheet, camera_poses, seen)
        for sighting in accepted:
            slot = self._slot(sheet, sighting, update)
            covariance = self._with_common_part(sheet, keyframe, sighting, update)
            for i in range(4):
                model = robust(gaussian(covariance[i]), self._rig.gates.robust_sigma)
                point = keys.corner(slot, i)
                if sighting.camera == "b_rgb":
                    factor = machine_projection(sighting.corners_px[i], model, keyframe, point)
                else:
                    factor = mobile_projection(sighting.camera, sighting.corners_px[i], model, keyframe, point)
                what = f"marker {sighting.marker} corner {i} in {sighting.camera}"
                update.add(
                    factor,
                    Record(
                        FAMILY,
                        f"corners {sighting.camera} {sheet.board.id}",
                        sighting.stamp_ns,
                        what,
                        camera=sighting.camera,
                    ),
                )
            sheet.last_seen_ns = max(sheet.last_seen_ns or 0, sighting.stamp_ns)

    def _gated(
        self, sheet: _Sheet, camera_poses: dict[str, gtsam.Pose3], seen: list[MarkerSighting]
    ) -> list[MarkerSighting]:
        """Refuses markers that sit elsewhere than the rest of what the same image shows of the board."""
        good = []
        for camera in {s.camera for s in seen}:
            mine = [s for s in seen if s.camera == camera]
            shifts = np.array(
                [
                    (s.corners_px - self._pixels(camera, camera_poses[camera], self._predicted(sheet, s.marker))).mean(
                        0
                    )
                    for s in mine
                ]
            )
            common = np.median(shifts, axis=0)
            for s, shift in zip(mine, shifts, strict=True):
                size = float(np.linalg.norm(s.corners_px[0] - s.corners_px[2])) / np.sqrt(2)
                limit = max(0.25 * size, 6 * float(np.sqrt(np.trace(s.covariance_px2.mean(0)))))
                off = float(np.linalg.norm(shift - common)) if len(mine) > 2 else float(np.linalg.norm(shift)) / 3
                if off < limit:
                    good.append(s)
                else:
                    what = f"marker {s.marker} of board {sheet.board.id} in {camera}"
                    self.rejected.append(Rejection(s.stamp_ns, FAMILY, what, "off its place by px", off, limit))
        return good

    def _slot(self, sheet: _Sheet, sighting: MarkerSighting, update: Update) -> int:
        """The marker's corner variables, made on its first sighting."""
        if sighting.marker in sheet.slots:
            return sheet.slots[sighting.marker]
        slot = sheet.slots[sighting.marker] = self._next_slot
        self._next_slot += 1
        marker: Marker = self._markers[sheet.board.id, sighting.marker]
        in_update = update.values.exists(sheet.key)
        o_T_f = update.values.atPose3(sheet.key) if in_update else self._state.pose(sheet.key)
        page = keys.page(sheet.index)
        side, scale = update.values.atVector(page) if update.values.exists(page) else self._state.vector(page)
        for i, corner in enumerate(page_corners(marker, side, scale)):
            update.guess(keys.corner(slot, i), o_T_f.transformFrom(corner))
        what = f"marker {sighting.marker} lies on page {sheet.board.id}"
        factor = page_factor(sheet.board, marker, sheet.key, page, slot, self._detection_error_m(sighting, side))
        update.add(factor, Record(GEOMETRY, f"page {sheet.board.id}", sighting.stamp_ns, what, rejectable=False))
        return slot

    def _detection_error_m(self, sighting: MarkerSighting, side_m: float) -> float:
        """A corner's lasting detection error on the page, from its size in this first view."""
        diagonal = float(np.linalg.norm(sighting.corners_px[0] - sighting.corners_px[2]))
        return self._rig.noise.marker_common_px * side_m * float(np.sqrt(2.0)) / max(diagonal, 1.0)

    def _with_common_part(self, sheet: _Sheet, keyframe: int, sighting: MarkerSighting, update: Update) -> Float:
        """Adds the part of a corner's error that views from the same place share.

        Views are counted per cell of viewing position; the n-th view of a cell gets n times the common variance, so
        that standing still gives no more than one view's worth of it.
        """
        cells = self._cells.setdefault((sheet.board.id, sighting.camera), ViewCells())
        if cells.last != keyframe:
            held = update.values.exists(keyframe)
            pose = update.values.atPose3(keyframe) if held else self._state.pose(keyframe)
            board = update.values.atPose3(sheet.key) if update.values.exists(sheet.key) else self._state.pose(sheet.key)
            cells.count(keyframe, board.between(pose).matrix())
        return sighting.covariance_px2 + np.eye(2) * self._rig.noise.marker_common_px**2 * cells.views

    def slot_of(self, board: str, marker: int) -> int | None:
        """The corner slot of a marker, None before it was seen."""
        return self._sheets[board].slots.get(marker)

    def held_back(self) -> list[Rejection]:
        """Sightings of boards that never got a pose."""
        return [
            Rejection(
                s.stamp_ns,
                FAMILY,
                f"marker {s.marker} of board {sheet.board.id} in {s.camera}",
                "board never placed: views",
                float(len(sheet.held)),
                float(VIEWS_TO_DECIDE),
            )
            for sheet in self._sheets.values()
            for _, seen in sheet.held
            for s in seen
        ]

    def _say(self, stamp_ns: int, kind: str, text: str, severity: str, **values: float) -> None:
        self.events.append(Event(stamp_ns, kind, text, severity, values))  # type: ignore[arg-type]
