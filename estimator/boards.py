"""Boards in the graph: where a page starts from, its corners, side length and scale, and what contradicts the rig."""

from collections.abc import Callable, Mapping, Sequence

import gtsam
import numpy as np
from numpy.typing import NDArray

from ..factors import keys
from ..factors.board import page_corners, print_scale_prior, side_prior
from ..factors.chance import chi2_isf
from ..factors.measurements import Event, MarkerSighting, Rejection
from ..factors.rig import Rig
from ..frontends.board_pose import board_pose_candidates
from .board_inspection import Inspection
from .board_moves import Joint, displacement, may_be_the_board, new_place, scaled_pose, still_moving
from .board_news import GEOMETRY, SIDE_GATE_SIGMA, BoardNews, rejection, scale_words, side_words
from .board_start import FirstPose, Side
from .corner_factors import CornerFactors
from .graph import Record, State, Update
from .result import CalibrationEstimate
from .sheet import Displaced, Knock, Sheet

Float = NDArray[np.float64]

DISTANCES = "known distances"
FREE_SIDE_REL = 0.5
"""Sigma of a side length whose given value the log contradicts: it says no more than that there is one."""
LOOK_AGAIN_PX = 1.0
"""Common shift of a board against its predicted place from which on the prediction is made exact and tested."""
HELD_VIEWS = 40
"""Views of a board without a pose that are kept."""


class Boards:
    """All boards of the rig."""

    def __init__(self, rig: Rig, state: State) -> None:
        self._rig = rig
        self._state = state
        self.sheets = {board.id: Sheet(i, board) for i, board in enumerate(rig.boards)}
        self._markers = {(b.id, m.id): m for b in rig.boards for m in b.markers}
        self._first = FirstPose(rig, state)
        self.inspection = Inspection(rig, state, self._first.pinhole)
        self.news = BoardNews(rig)
        self.corners = CornerFactors(rig, state, self.news)
        self.apart: Callable[[int, int], bool] = lambda key, other: False
        """Is it unknown where two poses are against each other?"""
        self.insets: list[CalibrationEstimate] = []
        """After the run: how far the corners lie inside the true ones, by camera and board."""

    # What others ask ------------------------------------------------------------------------------------------

    @property
    def events(self) -> list[Event]:
        """What contradicts the rig, as far as it is known."""
        return [*self.news.events, *self.inspection.events.values()]

    @property
    def rejected(self) -> list[Rejection]:
        return [*self.news.refused, *self.inspection.rejected]

    def begin_slots(self, first: int) -> None:
        """New markers get slots from here on: those before are taken."""
        self._next_slot = first

    def lists_of_rejections(self) -> list[list[Rejection]]:
        return [self.news.refused, self.inspection.rejected]

    def on_machine(self) -> list[int]:
        """Keys of the poses of boards that move with the machine."""
        return [s.key for s in self.sheets.values() if s.board.attached_to == "b"]

    def known(self, board: str) -> bool:
        """Has the board a pose in the graph?"""
        return self.sheets[board].known

    def any_known(self) -> bool:
        return any(sheet.known for sheet in self.sheets.values())

    def key(self, board: str) -> int:
        return self.sheets[board].key

    def index(self, board: str) -> int:
        return self.sheets[board].index

    def last_seen_ns(self) -> int | None:
        """Stamp of the newest accepted sighting of any board."""
        return max((s.last_seen_ns for s in self.sheets.values() if s.last_seen_ns is not None), default=None)

    def slot_of(self, board: str, marker: int) -> int | None:
        """The corner slot of a printed marker, None before it was seen."""
        sheet = self.sheets[board]
        return sheet.slots.get(sheet.place(marker))

    def known_corners(self, sightings: Sequence[MarkerSighting]) -> tuple[Float, Float]:
        """Corners of {o} that are known and seen: points (n, 3) and pixels (n, 2)."""
        seen = self.usable(sightings)
        if not seen:
            return np.zeros((0, 3)), np.zeros((0, 2))
        points = [self._predicted(self.sheets[s.board], s.marker)[s.good] for s in seen]
        return np.concatenate(points), np.concatenate([s.corners_px[s.good] for s in seen])

    def usable(self, sightings: Sequence[MarkerSighting]) -> list[MarkerSighting]:
        """Sightings of known boards, under the ids whose places they have, without loose markers."""
        known = [(sheet, seen) for sheet, seen in self._by_sheet(sightings) if sheet.known]
        return [s for sheet, seen in known for s in self.inspection.in_place(sheet, seen)]

    def o_T_camera(self, seen: Sequence[MarkerSighting]) -> list[gtsam.Pose3]:
        """Both poses of a camera from what it sees of one known board (the first of `usable` sightings)."""
        sheet = self.sheets[seen[0].board]
        mine = [s for s in seen if s.board == seen[0].board]
        side, scale = self._state.vector(sheet.page)
        camera, common = self._first.pinhole(seen[0].camera), self._rig.noise.marker_common_px
        found = board_pose_candidates(mine, sheet.board, camera, float(side / scale), common)
        o_T_f = self._state.pose(sheet.key)
        return [o_T_f.compose(scaled_pose(c.camera_T_f, float(scale)).inverse()) for c in found]

    def gate(self) -> float:
        """Chi-square that six degrees of freedom exceed by chance with the gate's probability."""
        return chi2_isf(self._rig.gates.gate_probability, 6)

    def can_start(self, sightings: Sequence[MarkerSighting]) -> bool:
        """Would a board get its first pose from these sightings of one frame alone?

        Not from an image whose ids may be exchanged, until another one has said the same: hence the inspection.
        """
        for sheet, raw in self._by_sheet(sightings):
            seen = self.inspection.trusted(sheet, raw)
            enough = min(2, len(sheet.board.markers))
            for camera in {s.camera for s in seen}:
                mine = [s for s in seen if s.camera == camera]
                if len({s.marker for s in mine}) >= enough and np.isinf(self._first.margin(sheet, mine)):
                    return True
        return False

    def margin(self, seen: Sequence[MarkerSighting]) -> float:
        """Chi-square by which an image rules out the second pose of its best board; infinite where it does."""
        return max((self._first.margin(sheet, mine) for sheet, mine in self._by_sheet(seen)), default=-1.0)

    def _by_sheet(self, sightings: Sequence[MarkerSighting]) -> list[tuple[Sheet, list[MarkerSighting]]]:
        found = []
        for name, sheet in self.sheets.items():
            seen = [s for s in sightings if s.board == name and (name, s.marker) in self._markers]
            if seen:
                found.append((sheet, seen))
        return found

    # A keyframe -----------------------------------------------------------------------------------------------

    def displaced(self, camera_poses: Mapping[str, gtsam.Pose3], sightings: Sequence[MarkerSighting]) -> bool:
        """Is a known board off its predicted place? The cameras should then be placed as well as can be."""
        return any(
            self._off(sheet, camera_poses, self.inspection.in_place(sheet, seen))
            for sheet, seen in self._by_sheet(sightings)
            if sheet.known
        )

    def _off(self, sheet: Sheet, camera_poses: Mapping[str, gtsam.Pose3], seen: list[MarkerSighting]) -> bool:
        if sheet.displaced:
            return True
        shifts = [np.linalg.norm(np.median(shift, axis=0)) for _, shift in self._shifts(sheet, camera_poses, seen)]
        return bool(max(shifts, default=0.0) > LOOK_AGAIN_PX)

    def add(
        self,
        keyframe: int,
        camera_poses: Mapping[str, gtsam.Pose3],
        sightings: Sequence[MarkerSighting],
        force: bool = False,
        joint: Joint | None = None,
    ) -> Update:
        """Sightings at a keyframe.

        Args:
            keyframe: key of the pose that the cameras hang on (`o_T_m` or `o_T_b`).
            camera_poses: `o_T_c` of each camera as believed now.
            force: a board starts even from a view that allows two poses.
            joint: joint covariances of the running solver, where something other than boards places the cameras: a
                board may then be found displaced.
        """
        update = Update()
        for sheet, seen in self._by_sheet(sightings):
            if sheet.first_seen_ns is None:
                sheet.first_seen_ns = seen[0].stamp_ns
            good = self.inspection.trusted(sheet, seen)
            if not good:
                continue
            if not sheet.known:
                self._hold(sheet, keyframe, good)
                self._start(sheet, camera_poses, good, update, force)
            elif joint is None or not self._elsewhere(sheet, keyframe, camera_poses, good, joint, update):
                self._observe(sheet, keyframe, camera_poses, good, update)
        return update

    # First pose -----------------------------------------------------------------------------------------------

    def _hold(self, sheet: Sheet, keyframe: int, seen: list[MarkerSighting]) -> None:
        sheet.held.append((keyframe, seen))
        if len(sheet.held) > HELD_VIEWS:
            _, dropped = sheet.held.pop(1)
            self.news.refuse(sheet, dropped, "board not placed for long, views held", len(sheet.held), HELD_VIEWS)

    def _start(
        self,
        sheet: Sheet,
        camera_poses: Mapping[str, gtsam.Pose3],
        seen: list[MarkerSighting],
        update: Update,
        force: bool,
    ) -> None:
        """Gives the board its first pose when one is sure; adds its variables and priors, and what was held back."""
        start = self._first.find(sheet, camera_poses, seen, force)
        if start is None:
            return
        if not start.sure:
            text = f"board {sheet.board.id} starts from a view that allows two poses; took the better one"
            self.news.say(seen[0].stamp_ns, "ambiguous_start", sheet.board.id, text, "info")
        update.guess(sheet.key, start.o_T_f)
        self._open_page(sheet, start.side, seen[0].stamp_ns, update)
        sheet.known = True
        held, sheet.held = sheet.held, []
        for key, earlier in held:
            if self.apart(key, held[-1][0]):
                self.news.refuse(sheet, earlier, "lost before the board was placed, views", 1.0, 2.0)
                continue
            usable = [s for s in earlier if s.marker not in sheet.loose]
            self._observe(sheet, key, None, usable, update)

    def _open_page(self, sheet: Sheet, side: Side, stamp_ns: int, update: Update) -> None:
        """Side length and scale as states; a given side that the image contradicts does not enter."""
        if sheet.page_known:
            return
        board, mean, sigma = sheet.board, sheet.board.side_m, sheet.board.side_sigma_m
        update.guess(sheet.page, np.array([side.length_m, 1.0]))
        if side.sigma_m is not None:
            off = abs(side.length_m - mean) / float(np.hypot(side.sigma_m, sigma))
            if off > SIDE_GATE_SIGMA:
                self.news.say_side(sheet, stamp_ns, side.length_m, side.sigma_m)
                self.news.reject_side(sheet, stamp_ns, off)
                mean, sigma = side.length_m, FREE_SIDE_REL * side.length_m
        what = side_words(board.id)
        update.add(side_prior(sheet.page, mean, sigma), Record(GEOMETRY, what, stamp_ns, what, rejectable=False))
        what = scale_words(board.id)
        factor = print_scale_prior(sheet.page, board.print_scale_sigma)
        update.add(factor, Record(DISTANCES, what, stamp_ns, what, rejectable=False))
        sheet.page_known = True

    # A new place ----------------------------------------------------------------------------------------------

    def seen_off(
        self,
        keyframe: int,
        camera_poses: Mapping[str, gtsam.Pose3],
        sightings: Sequence[MarkerSighting],
        joint: Joint,
    ) -> dict[str, float]:
        """Known boards that a view contradicts, by how far (m) they seem to have moved; nothing is changed.

        Args:
            keyframe: key of the pose with whose uncertainty the cameras stand.
        """
        found: dict[str, float] = {}
        for sheet, seen in self._by_sheet(sightings):
            good = self.inspection.in_place(sheet, seen) if sheet.known else []
            if not good or not self._off(sheet, camera_poses, good):
                continue
            state, rig, pinhole = self._state, self._rig, self._first.pinhole
            view = displacement(sheet, keyframe, camera_poses, good, state, rig, pinhole, joint)
            if view is not None and view.o_T_f is not None:
                shift = view.o_T_f.translation() - state.pose(sheet.key).translation()
                found[sheet.board.id] = float(np.linalg.norm(shift))
        return found

    def _elsewhere(
        self,
        sheet: Sheet,
        keyframe: int,
        camera_poses: Mapping[str, gtsam.Pose3],
        seen: list[MarkerSighting],
        joint: Joint,
        update: Update,
    ) -> bool:
        """A board that is not where it was: its views wait until they agree on a new place."""
        view = None
        if self._off(sheet, camera_poses, seen):
            state, rig, pinhole = self._state, self._rig, self._first.pinhole
            view = displacement(sheet, keyframe, camera_poses, seen, state, rig, pinhole, joint)
        if view is None:
            self._forget(sheet, sheet.displaced)
            return False
        if view.o_T_f is None and not sheet.displaced:
            return False
        sheet.displaced.append(view)
        self._forget(sheet, still_moving(sheet.displaced))
        place = new_place(sheet.displaced) if may_be_the_board(sheet, keyframe) else None
        if place is not None:
            self._reopen(sheet, place, update)
        return True

    def _forget(self, sheet: Sheet, views: Sequence[Displaced]) -> None:
        for view in views:
            self.news.refuse(sheet, view.seen, "board not in its place, views that agree", 1.0, 3.0)
        sheet.displaced = [v for v in sheet.displaced if not any(v is gone for gone in views)]

    def _reopen(self, sheet: Sheet, place: gtsam.Pose3, update: Update) -> None:
        """The board goes on with a pose and corners of its own; what was tied to the old ones stays with them."""
        views, sheet.displaced = sheet.displaced, []
        sheet.knocks.append(Knock(sheet.last_seen_ns or views[0].stamp_ns, views[0].stamp_ns, sheet.epoch + 1))
        old = self._state.pose(sheet.key)
        sheet.epoch += 1
        sheet.slots = {}
        update.guess(sheet.key, place)
        delta = gtsam.Pose3.Logmap(old.between(place))
        self.news.say_knock(sheet, sheet.knocks[-1], delta, None)
        for view in views:
            self._observe(sheet, view.keyframe, None, view.seen, update)

    def carried(self) -> list[tuple[int, int]]:
        """The machine has been moved: boards on it go on with new poses and corners; (old, new) keys of the poses."""
        pairs = []
        for sheet in self.sheets.values():
            if sheet.board.attached_to == "b" and sheet.known:
                self._forget(sheet, sheet.displaced)
                old = sheet.key
                sheet.epoch += 1
                sheet.slots = {}
                pairs.append((old, sheet.key))
        return pairs

    # Corners --------------------------------------------------------------------------------------------------

    def _observe(
        self,
        sheet: Sheet,
        keyframe: int,
        camera_poses: Mapping[str, gtsam.Pose3] | None,
        seen: list[MarkerSighting],
        update: Update,
    ) -> None:
        accepted = seen if camera_poses is None else self._gated(sheet, camera_poses, seen)
        for sighting in accepted:
            if self.corners.add(sheet, keyframe, sighting, update):
                sheet.last_seen_ns = max(sheet.last_seen_ns or 0, sighting.stamp_ns)

    def _predicted(self, sheet: Sheet, marker: int) -> Float:
        """Corners of a marker in {o}, shape (4, 3), from the board's pose and page."""
        side, scale = self._state.vector(sheet.page)
        page = page_corners(self._markers[sheet.board.id, marker], side, scale)
        return np.array([self._state.pose(sheet.key).transformFrom(corner) for corner in page])

    def _pixels(self, camera: str, o_T_c: gtsam.Pose3, points: Float) -> Float:
        c_p = (points - o_T_c.translation()) @ o_T_c.rotation().matrix()
        K = self._state.intrinsics(keys.intrinsics(camera)).K()
        return (c_p @ K.T)[:, :2] / c_p[:, 2:]

    def _shifts(
        self, sheet: Sheet, camera_poses: Mapping[str, gtsam.Pose3], seen: list[MarkerSighting]
    ) -> list[tuple[list[MarkerSighting], Float]]:
        """By camera: its sightings, and by how much each marker's middle is off its predicted place, (n, 2) px."""
        found = []
        for camera in sorted({s.camera for s in seen}):
            mine = [s for s in seen if s.camera == camera]
            expected = [self._pixels(camera, camera_poses[camera], self._predicted(sheet, s.marker)) for s in mine]
            shifts = [(s.corners_px - e)[s.good].mean(0) for s, e in zip(mine, expected, strict=True)]
            found.append((mine, np.array(shifts)))
        return found

    def _gated(
        self, sheet: Sheet, camera_poses: Mapping[str, gtsam.Pose3], seen: list[MarkerSighting]
    ) -> list[MarkerSighting]:
        """Refuses markers that sit elsewhere than the rest of what the same image shows of the board."""
        good = []
        for mine, shifts in self._shifts(sheet, camera_poses, seen):
            common = np.median(shifts, axis=0)
            for s, shift in zip(mine, shifts, strict=True):
                size = s.diagonal_px / np.sqrt(2)
                limit = max(0.25 * size, 6 * float(np.sqrt(np.trace(s.covariance_px2.mean(0)))))
                off = float(np.linalg.norm(shift - common)) if len(mine) > 2 else float(np.linalg.norm(shift)) / 3
                if off < limit:
                    good.append(s)
                else:
                    self.news.refuse(sheet, [s], "off its place by px", off, limit)
        return good

    def held_back(self) -> list[Rejection]:
        """Sightings of boards that never got a pose, or not the one that these show."""
        found = []
        for sheet in self.sheets.values():
            for _, seen in sheet.held:
                found += [rejection(sheet, s, "board never placed: views", len(sheet.held), 1.0) for s in seen]
            for view in sheet.displaced:
                reason = "board not in its place, views that agree"
                found += [rejection(sheet, s, reason, len(sheet.displaced), 3.0) for s in view.seen]
        return found
