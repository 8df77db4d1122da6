"""Stereo visual odometry in the graph: keyframes, and the landmarks that tie them together."""

from collections.abc import Callable
from dataclasses import dataclass, field

import gtsam
import numpy as np
from numpy.typing import NDArray

from ..factors import keys
from ..factors.geometry import pose3
from ..factors.links import gauge_prior, motion_prior
from ..factors.measurements import Rejection, StereoFrame
from ..factors.noise import gaussian, robust
from ..factors.projection import mobile_projection
from .graph import Record, State, Update
from .spread import spread
from .track_gate import FAMILY, Gate, Newest, TrackGate, residuals

Float = NDArray[np.float64]


POOR_S = 0.1
"""How long before they break tracks may have been wrong."""
VIEWS_PASSED = 3
"""Views of a track without a landmark that are kept beside its newest one."""


@dataclass(frozen=True, slots=True)
class OdometrySettings:
    """How many tracks enter, and what counts as a landmark."""

    tracks_per_keyframe: int = 90
    minimum_disparity_px: float = 1.0
    """Below it a point is too far for a first guess from stereo."""
    gate: Gate = field(default_factory=Gate)
    minimum_shared: int = 12
    """Fewer landmarks shared with the map: a motion prior joins the keyframe to the last one."""
    lost_speed_m_s: float = 0.5
    lost_turn_rad_s: float = 6.0
    """Standard deviation of a hand-held camera's velocity about its last one, while nothing is tracked: it may be its
    turn that no track survives. A wrist turns by 10 rad/s at most."""
    poor_turn_rad_s: float = 1.0
    """The same while the tracks hold, but hardly a landmark is among them."""


@dataclass(frozen=True, slots=True)
class FramePose:
    """A frame's place relative to its keyframe; the trajectory is made of these at the end."""

    stamp_ns: int
    keyframe: int
    """Index of the keyframe."""
    keyframe_T_this: Float
    """Shape (4, 4)."""
    tracks: "SeenTracks | None" = None
    """Of a frame between keyframes; None where nothing was tracked."""


@dataclass(frozen=True, slots=True)
class SeenTracks:
    """Where a frame's left image shows the tracks. Kept for every frame, so it is small."""

    ids: NDArray[np.int64]
    """Shape (n,)."""
    left_px: NDArray[np.float32]
    """Shape (n, 2), ideal pixels."""

    @classmethod
    def of(cls, frame: StereoFrame) -> "SeenTracks | None":
        return None if frame.lost else cls(frame.track_ids, frame.left_px.astype(np.float32))


View = tuple[int, StereoFrame, int]
"""Keyframe index, its frame, and a track's row in it."""


class Odometry:
    """Turns stereo frames into keyframes and landmarks."""

    def __init__(self, state: State, settings: OdometrySettings, robust_sigma: float) -> None:
        self._state = state
        self._settings = settings
        self._robust_sigma = robust_sigma
        self._waiting: dict[int, View] = {}
        self._passed: dict[int, list[View]] = {}
        """Views of waiting tracks before the one that waits, the newest first: they did not agree with the next one."""
        self.keyframe_stamps: list[int] = []
        self.frames: list[FramePose] = []
        self.seen_in: dict[int, int] = {}
        """The last keyframe that saw a landmark."""
        self.observations: dict[int, int] = {}
        """Number of keyframes in which each landmark was seen."""
        self._keyframe_T_last = np.eye(4)
        self._since_keyframe_lost = False
        self._held_ns = 0
        """The last frame that the tracks held."""
        self.gap_s = 0.0
        """Time that the newest keyframe's motion prior alone bridges to those before; zero where landmarks do."""
        self._reference = -1
        """Keyframe that the front end's motion counts from: the newest but for those made after the fact."""
        self.gate = TrackGate(state, settings.gate)
        self.foreign: Callable[[int, int | None], bool] = lambda key, keyframe: False
        """Is it unknown where a landmark is, against a keyframe, or the frame that becomes one (None)?"""

    @property
    def last_keyframe(self) -> int:
        """Index of the newest keyframe, -1 before the first."""
        return len(self.keyframe_stamps) - 1

    def keyframes_in(self, values: gtsam.Values) -> dict[int, int]:
        """Index and stamp (ns) of the keyframes that an estimate holds; others have left the graph."""
        return {i: at for i, at in enumerate(self.keyframe_stamps) if values.exists(keys.keyframe(i))}

    @property
    def lost_speed_m_s(self) -> float:
        """Standard deviation of the velocity while nothing is tracked."""
        return self._settings.lost_speed_m_s

    def expected(self) -> gtsam.Pose3:
        """Where the frame just followed stands, by its motion since the last keyframe."""
        return self._guess_pose(len(self.keyframe_stamps))

    def gap_of(self, frame: StereoFrame) -> float:
        """Seconds that no track bridges, between the last keyframe and the frame just followed."""
        if self._reference < 0 or not self._since_keyframe_lost:
            return 0.0
        # Up to the loss the front end has followed the motion; a frame or two more may have been poor already.
        since = frame.stamp_ns - self.keyframe_stamps[self._reference]
        return abs(min(since * 1e-9, (frame.stamp_ns - self._held_ns) * 1e-9 + POOR_S))

    def follow(self, frame: StereoFrame) -> None:
        """Moves the camera by the front end's estimate; every frame passes here once, in order."""
        if not frame.lost:
            self._held_ns = frame.stamp_ns
        if self._reference >= 0:
            self._keyframe_T_last = self._keyframe_T_last @ frame.last_T_this
            self._since_keyframe_lost |= frame.lost
            tracks = SeenTracks.of(frame)
            self.frames.append(FramePose(frame.stamp_ns, self._reference, self._keyframe_T_last, tracks))

    def insert(self, frame: StereoFrame, placed: gtsam.Pose3 | None = None) -> tuple[Update, list[Rejection]]:
        """Makes the frame just followed a keyframe.

        Args:
            placed: where it stands, if that is known by other means than its motion since the last keyframe.
        """
        update = Update()
        index = len(self.keyframe_stamps)
        pose = self._guess_pose(index) if placed is None else placed
        key = keys.keyframe(index)
        update.guess(key, pose)
        rejected: list[Rejection] = []
        self.gap_s = 0.0
        known, new = self._split(frame, None)
        if index == 0:
            update.add(gauge_prior(key), Record("gauge", "gauge", frame.stamp_ns, "origin {o}", rejectable=False))
        else:
            known, rejected = self.gate.gated(frame, known, pose, self._newest())
            connected = self._reference >= 0 and self._state.has(keys.keyframe(self._reference))
            few = len(known) < self._settings.minimum_shared
            if connected and (self._since_keyframe_lost or few):
                self._bridge(update, index, frame, few)
        for row in spread(frame.left_px, known, self._settings.tracks_per_keyframe):
            self._observe(update, frame, row, index)
        self._create(update, frame, new, index, pose)
        if len(known) < self._settings.minimum_shared:
            self._create_from_before(update, frame, index, pose)
        self.keyframe_stamps.append(frame.stamp_ns)
        self._reference = index
        self._keyframe_T_last = np.eye(4)
        self._since_keyframe_lost = False
        if self.frames and self.frames[-1].stamp_ns == frame.stamp_ns:
            self.frames.pop()
        self.frames.append(FramePose(frame.stamp_ns, index, np.eye(4)))
        return update, rejected

    def forget(self, keyframes: set[int], landmarks: set[int]) -> None:
        """These have left the graph."""
        self._waiting = {t: w for t, w in self._waiting.items() if w[0] not in keyframes}
        self._passed = {t: [v for v in w if v[0] not in keyframes] for t, w in self._passed.items()}
        self.observations = {t: n for t, n in self.observations.items() if t not in landmarks}
        self.seen_in = {t: k for t, k in self.seen_in.items() if t not in landmarks}
        self.frames = [f for f in self.frames if f.keyframe not in keyframes]

    def place(self, stamp_ns: int, index: int) -> None:
        """A keyframe that markers alone have placed."""
        self.keyframe_stamps.append(stamp_ns)
        self.frames.append(FramePose(stamp_ns, index, np.eye(4)))
        self._reference = index

    def insert_late(self, frame: StereoFrame) -> tuple[Update, list[Rejection], int] | None:
        """Makes a frame of the past a keyframe, and tells the key of its neighbour; None where its place is not known
        any more.

        Its tracks tie it to the map like any other keyframe's, but it makes no new landmarks: those that it saw first
        are in the map already, or have been found too poor.
        """
        past = next((f for f in reversed(self.frames) if f.stamp_ns == frame.stamp_ns), None)
        if past is None or not self._state.has(keys.keyframe(past.keyframe)):
            return None
        index = len(self.keyframe_stamps)
        pose = self._state.pose(keys.keyframe(past.keyframe)).compose(pose3(past.keyframe_T_this))
        update = Update()
        update.guess(keys.keyframe(index), pose)
        known, _ = self._split(frame, keys.keyframe(past.keyframe))
        known, rejected = self.gate.gated(frame, known, pose, self._newest())
        if len(known) < self._settings.minimum_shared:
            return None
        for row in spread(frame.left_px, known, self._settings.tracks_per_keyframe):
            self._observe(update, frame, row, index)
        self.keyframe_stamps.append(frame.stamp_ns)
        return update, rejected, keys.keyframe(past.keyframe)

    def _newest(self) -> Newest:
        return Newest(self._reference, self.seen_in, self._since_keyframe_lost)

    def _guess_pose(self, index: int) -> gtsam.Pose3:
        if index == 0:
            return gtsam.Pose3()
        previous = self._state.pose(keys.keyframe(self._reference))
        return previous.compose(pose3(self._keyframe_T_last))

    def _split(self, frame: StereoFrame, keyframe: int | None) -> tuple[list[int], list[int]]:
        """Rows of tracks that are landmarks already, and rows that may become ones."""
        known, new = [], []
        for row, track in enumerate(frame.track_ids):
            key = keys.landmark(int(track))
            if self._state.has(key):
                if not self.foreign(key, keyframe):
                    known.append(row)
            elif np.isfinite(frame.right_px[row, 0]):
                new.append(row)
        return known, new

    def _bridge(self, update: Update, index: int, frame: StereoFrame, few: bool) -> None:
        """Joins a keyframe that the map does not hold by a motion prior."""
        earlier = keys.keyframe(self._reference)
        seconds = (frame.stamp_ns - self.keyframe_stamps[self._reference]) * 1e-9
        if self._since_keyframe_lost:
            seconds = self.gap_of(frame)
            self.gap_s = seconds if few else 0.0
        settings = self._settings
        turn_rad_s = settings.lost_turn_rad_s if self._since_keyframe_lost else settings.poor_turn_rad_s
        motion, later = pose3(self._keyframe_T_last), keys.keyframe(index)
        factor = motion_prior(earlier, later, motion, abs(seconds), settings.lost_speed_m_s, turn_rad_s)
        what = f"motion over {seconds:.2f} s without enough shared landmarks"
        update.add(factor, Record(FAMILY, "motion prior", frame.stamp_ns, what, rejectable=False))

    def _observe(self, update: Update, frame: StereoFrame, row: int, index: int) -> None:
        """Adds one track's pixels, left and (where found) right."""
        track = int(frame.track_ids[row])
        pose, point = keys.keyframe(index), keys.landmark(track)
        views = [("m_left", frame.left_px[row], frame.left_covariance_px2[row])]
        if np.isfinite(frame.right_px[row, 0]):
            views.append(("m_right", frame.right_px[row], frame.right_covariance_px2[row]))
        for camera, px, covariance in views:
            model = robust(gaussian(covariance), self._robust_sigma)
            record = Record(FAMILY, f"tracks {camera}", frame.stamp_ns, f"track {track} in {camera}", camera=camera)
            update.add(mobile_projection(camera, px, model, pose, point), record)
        self.observations[track] = self.observations.get(track, 0) + 1
        self.seen_in[track] = max(index, self.seen_in.get(track, index))

    def _create(self, update: Update, frame: StereoFrame, rows: list[int], index: int, pose: gtsam.Pose3) -> None:
        """New landmarks from tracks seen in an earlier keyframe too; others wait for their second one."""
        room = self._settings.tracks_per_keyframe
        ready = [r for r in rows if int(frame.track_ids[r]) in self._waiting]
        ready = spread(frame.left_px, ready, room)
        points = self._triangulate(frame, ready)
        agree = self._agreeing(frame, ready, points, pose)
        for r, c_p in zip(ready, points, strict=True):
            if c_p is None or r not in agree:
                continue
            track = int(frame.track_ids[r])
            self._waiting.pop(track)
            self._passed.pop(track, None)
            update.guess(keys.landmark(track), pose.transformFrom(c_p))
            for earlier_index, earlier_frame, earlier_row in reversed(agree[r]):
                self._observe(update, earlier_frame, earlier_row, earlier_index)
            self._observe(update, frame, r, index)
        for r in rows:
            track = int(frame.track_ids[r])
            if not update.values.exists(keys.landmark(track)):
                if track in self._waiting:
                    self._passed[track] = [self._waiting[track], *self._passed.get(track, [])][:VIEWS_PASSED]
                self._waiting[track] = (index, frame, r)
        alive = {int(t) for t in frame.track_ids}
        self._waiting = {t: w for t, w in self._waiting.items() if t in alive or index - w[0] < 3}
        self._passed = {t: views for t, views in self._passed.items() if t in self._waiting}

    def _create_from_before(self, update: Update, frame: StereoFrame, index: int, pose: gtsam.Pose3) -> None:
        """Landmarks from tracks that only the left image shows now: the keyframe that they wait in has seen both.

        A click makes a keyframe of any frame. Where no landmark holds it yet, these do.
        """
        rows = [
            r
            for r, track in enumerate(frame.track_ids.tolist())
            if track in self._waiting and not np.isfinite(frame.right_px[r, 0]) and self._waiting[track][0] < index
        ]
        made: list[tuple[int, Float]] = []
        for r in rows:
            first_index, first, first_row = self._waiting[int(frame.track_ids[r])]
            c_p = self._triangulate(first, [first_row])[0]
            if c_p is not None:
                made.append((r, self._state.pose(keys.keyframe(first_index)).transformFrom(c_p)))
        if not made:
            return
        rows = [r for r, _ in made]
        residual, front = residuals(self._state, frame, rows, np.array([o_p for _, o_p in made]), pose)
        distance = np.linalg.norm(residual - np.median(residual, axis=0), axis=1)
        limit = max(self._settings.gate.sigma * 1.4826 * float(np.median(distance)), self._settings.gate.px)
        good = [i for i in range(len(rows)) if front[i] and distance[i] < limit]
        chosen = set(spread(frame.left_px, [rows[i] for i in good], self._settings.tracks_per_keyframe))
        for r, o_p in made:
            if r in chosen:
                track = int(frame.track_ids[r])
                first_index, first, first_row = self._waiting.pop(track)
                self._passed.pop(track, None)
                update.guess(keys.landmark(track), o_p)
                self._observe(update, first, first_row, first_index)
                self._observe(update, frame, r, index)

    def _agreeing(
        self, frame: StereoFrame, rows: list[int], points: list[Float | None], pose: gtsam.Pose3
    ) -> dict[int, list[View]]:
        """Rows whose point, triangulated now, is also where an earlier keyframe saw it, left and right; and its views.

        A landmark that starts from a wrong match can lie behind a camera, where its factors say nothing at all. What
        does not agree waits for another view. The median shift is taken out: it is the guess of the pose that is off.
        """
        kept = [(r, pose.transformFrom(c_p)) for r, c_p in zip(rows, points, strict=True) if c_p is not None]
        if not kept:
            return {}
        newest = [self._waiting[int(frame.track_ids[r])] for r, _ in kept]
        off = np.array([self._earlier_residual(view, o_p) for view, (_, o_p) in zip(newest, kept, strict=True)])
        shift = np.nanmedian(off, axis=0)
        distance = np.linalg.norm((off - shift).reshape(-1, 2, 2), axis=2).max(axis=1)
        spread = 1.4826 * float(np.nanmedian(distance))
        sigma = np.array([np.sqrt(np.trace(frame.left_covariance_px2[r]) / 2) for r, _ in kept])
        limit = np.maximum(self._settings.gate.sigma * np.hypot(sigma, spread), self._settings.gate.px)
        found: dict[int, list[View]] = {}
        for (r, o_p), view, d, most in zip(kept, newest, distance, limit, strict=True):
            views = [view] if d < most else []
            for passed in self._passed.get(int(frame.track_ids[r]), []):
                off_px = (self._earlier_residual(passed, o_p) - shift).reshape(2, 2)
                views += [passed] if np.linalg.norm(off_px, axis=1).max() < most else []
            if views:
                found[r] = views
        return found

    def _earlier_residual(self, view: View, o_p: Float) -> Float:
        """Pixels of a keyframe less those of a point, left then right, shape (4,); NaN behind a camera."""
        index, earlier, earlier_row = view
        o_T_left = self._state.pose(keys.keyframe(index))
        o_T_right = o_T_left.compose(self._state.pose(keys.extrinsics("m_right")))
        residual = np.full(4, np.nan)
        for i, (camera, o_T_c, seen) in enumerate(
            (("m_left", o_T_left, earlier.left_px), ("m_right", o_T_right, earlier.right_px))
        ):
            c_p = o_T_c.transformTo(o_p)
            if c_p[2] > 0.05:
                px = self._state.intrinsics(keys.intrinsics(camera)).K() @ c_p
                residual[2 * i : 2 * i + 2] = seen[earlier_row] - px[:2] / px[2]
        return residual

    def _triangulate(self, frame: StereoFrame, rows: list[int]) -> list[Float | None]:
        """Points in the left camera by the current calibration (linear, two rays), None where too far or behind."""
        if not rows:
            return []
        K_left = self._state.intrinsics(keys.intrinsics("m_left")).K()
        K_right = self._state.intrinsics(keys.intrinsics("m_right")).K()
        l_T_r = self._state.pose(keys.extrinsics("m_right"))
        a = _rays(frame.left_px[rows], K_left)
        b = _rays(frame.right_px[rows], K_right) @ l_T_r.rotation().matrix().T
        t = l_T_r.translation()
        # a * s - b * u = t, least squares in closed form
        aa, bb, ab = (a * a).sum(1), (b * b).sum(1), (a * b).sum(1)
        at, bt = a @ t, b @ t
        det = aa * bb - ab * ab
        with np.errstate(divide="ignore", invalid="ignore"):
            s = (bb * at - ab * bt) / det
        disparity = np.linalg.norm(t) * K_left[0, 0] / np.where(s > 0, s, np.inf)
        good = np.isfinite(s) & (s > 0.05) & (disparity > self._settings.minimum_disparity_px)
        return [a[i] * s[i] if good[i] else None for i in range(len(rows))]


def _rays(px: Float, K: Float) -> Float:
    """Directions with z = 1, shape (n, 3)."""
    return np.stack([(px[:, 0] - K[0, 2]) / K[0, 0], (px[:, 1] - K[1, 2]) / K[1, 1], np.ones(len(px))], axis=1)
