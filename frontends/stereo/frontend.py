"""The stereo front end: one pair in, one `StereoFrame` out."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ...factors.camera import CameraModel
from ...factors.measurements import StereoFrame
from ..undistort import undistort
from . import points
from .atlas import Atlas, Memorable, settled_tracks
from .calibration_error import of_calibration
from .detection import apart, detect
from .expectation import expected_flow
from .finding import FADING, Finding, Found
from .flow import checked_flow, inside
from .geometry import Float, StereoGeometry, exponential, inverse, least_spread, logarithm, median, transform
from .keyframes import keyframe_reason
from .landmarks import LandmarkStore
from .motion import Motion, estimate_motion
from .noise import NoiseModel
from .observer import Keyview, Observer, expected_depth
from .pair import StereoPair, prepare
from .places import PlaceStore, Relocalisation
from .revisit import revisit
from .settings import StereoSettings
from .sighting import Sighting, blind_frame, keyframe_of, nothing_seen, plain_frame
from .tracks import Int, Tracks, no_tracks
from .vertical import VerticalCorrection

Bool = NDArray[np.bool_]
Early = Callable[[Float, int], object]
"""Takes `last_T_this` (4, 4) by the flow alone and its number of inliers, while a keyframe is still in the making."""

_CALM_PX = 1.5
"""Surprise of the flow up to which the next one starts at full resolution: its window reaches twice as far."""


class StereoFrontEnd:
    """Tracks, keyframes and a first-guess motion from stereo pairs in the order of their time.

    Its own *chain* of motions starts at the first pair; it serves to predict where things are, not as an estimate.

    Args:
        left: left camera.
        right: right camera.
        m_left_T_m_right: (4, 4), nominal pose of the right camera in the left one; 2 % and half a pixel off do.
        settings: thresholds.
    """

    def __init__(
        self, left: CameraModel, right: CameraModel, m_left_T_m_right: Float, settings: StereoSettings | None = None
    ) -> None:
        self.settings = settings or StereoSettings()
        self.rig = StereoGeometry(left, right, m_left_T_m_right)
        self.landmarks = LandmarkStore(self.settings.store_landmarks)
        self.finding = Finding(PlaceStore(self.settings.store_keyframes, self.rig), self.settings)
        self._diagonal = float(np.hypot(left.width, left.height))
        self._noise = NoiseModel()
        self._vertical = VerticalCorrection(self.rig)
        self._observer = Observer(self.rig, self._noise, self.settings)
        self._tracks: Tracks = no_tracks(self._observer.grid)
        self._last: StereoPair | None = None
        self._view: Keyview | None = None
        self._keyframe_count = 0
        self._next_id = 0
        self._chain_T_keyframe = np.eye(4)
        self._keyframe_T_last = np.eye(4)
        self._velocity = np.zeros(6)
        self._surprise_px = np.inf
        """By how much the last flow differed from what constant velocity foretold."""
        self._own_from = 0
        """First track id of this run."""
        self.memorable: Memorable | None = None
        """What the last pair added to what can be found again."""

    @property
    def chain_T_keyframe(self) -> Float:
        """Shape (4, 4): the last keyframe's pose in the front end's own chain, corrected where places come back."""
        return self._chain_T_keyframe.copy()

    def recall(self, atlas: Atlas) -> None:
        """Before the first pair: begins with what an earlier run saw, as after a loss of sight.

        Until one of its places is seen, the own chain begins so far from all of them that none is taken to be near.
        """
        if not atlas:
            return
        self.landmarks.recall(atlas.tracks)
        self._next_id = self._own_from = atlas.next_id()
        self._chain_T_keyframe[0, 3] = self.finding.recall(atlas.places)

    def process(
        self,
        stamp_ns: int,
        left: NDArray[np.generic],
        right: NDArray[np.generic],
        wanted: bool = False,
        early: Early | None = None,
    ) -> StereoFrame:
        """Tracks the features into this pair.

        Args:
            stamp_ns: time of the pair, later than that of the pair before.
            left: image (h, w) or (h, w, 3), 8 bit.
            right: the same size.
            wanted: its place matters, so it becomes a keyframe; plain flow drifts, alike for all features.
            early: told of a keyframe's motion before the work on it begins, which takes ten times as long.
        """
        pair = prepare(stamp_ns, left, right)
        self.memorable = None
        if self._last is None:
            self._last = pair
            if self.finding.apart:
                return self._recover(pair, np.eye(4))
            return self._restart(pair, np.eye(4), lost=False)
        guess = self._keyframe_T_last @ self._predicted_motion(stamp_ns)
        self._track(self._last, pair, guess)
        left_px = undistort(self.rig.left, self._tracks.raw_px)[0]
        motion = self._motion_of_flow(left_px, guess)
        if motion is None:
            return self._recover(pair, guess)
        pose = motion.reference_T_this
        if not wanted and self._wants_keyframe(left_px, pose) is None:
            return self._plain_frame(pair, left_px, motion)
        if early is not None:
            early(inverse(self._keyframe_T_last) @ pose, int(motion.inliers.sum()))
        return self._keyframe(pair, pose) or self._recover(pair, pose)

    def relocalise(self, stamp_ns: int, left: NDArray[np.generic], right: NDArray[np.generic]) -> list[Relocalisation]:
        """Remembered keyframes that show the same place as this pair, the best first; changes nothing.

        `process` calls the same search by itself when the tracks break.
        """
        return self.finding.find(prepare(stamp_ns, left, right).left)

    def match_landmarks(self, ids: Int, points_m: Float) -> tuple[Int, Sighting]:
        """Looks for old landmarks in the last keyframe's images, near where an estimate expects them.

        What is found lives on as tracks under the old ids. Finds that do not agree with one common motion are not
        accepted, and fewer than six never are.

        Args:
            ids: (n,), track ids of old; those that live, and those that the store does not know, are skipped.
            points_m: (n, 3), expected places in the last keyframe's left camera.

        Returns:
            ids (k,) and their sighting in the last keyframe.
        """
        if self._view is None:
            return np.zeros(0, dtype=np.int64), nothing_seen()
        places = dict(zip(ids.tolist(), points_m, strict=True))
        rows = self.landmarks.rows_of(np.array(sorted(places), dtype=np.int64))
        expected = np.array([places[i] for i in self.landmarks.ids[rows].tolist()]).reshape(-1, 3)
        self.landmarks.points[rows] = transform(self._chain_T_keyframe, expected)
        tracks, sighting, _ = self._revisit(self._view, rows)
        if self._last is not self._view.pair:
            # The flow goes on from the last image, where these features have not been looked for.
            self.landmarks.add(tracks, self._chain_T_keyframe)
            return tracks.ids, sighting
        self._tracks.extend(tracks)
        return tracks.ids.copy(), sighting

    # -- frame to frame ------------------------------------------------------------------------------------------

    def _predicted_motion(self, stamp_ns: int) -> Float:
        """`last_T_this` at constant velocity, for half a second at most."""
        assert self._last is not None
        return exponential(self._velocity * min((stamp_ns - self._last.stamp_ns) * 1e-9, 0.5))

    def _track(self, last: StereoPair, pair: StereoPair, guess: Float) -> None:
        """Flow from the last left image into this one; what does not come back ends."""
        tracks, settings = self._tracks, self.settings
        expected = expected_flow(tracks, self.rig.left, self._keyframe_T_last, guess)
        found, good = checked_flow(
            last.left_as_bright_as(pair),
            pair.left,
            tracks.raw_px,
            expected,
            settings.flow_window_px,
            settings.pyramid_levels,
            settings.forward_backward_px,
            first_levels=int(self._surprise_px > _CALM_PX),
        )
        surprise = np.abs(found - expected)[good]
        self._surprise_px = median(surprise.max(axis=1)) if len(surprise) else np.inf
        tracks.raw_px = np.where(good[:, None], found, tracks.raw_px)
        self._end(~(good & inside(found, pair.left.shape, 3.0)))

    def _end(self, mask: Bool) -> None:
        """Ends tracks that are out of sight; they may come back."""
        if mask.any():
            self.landmarks.add(self._tracks.take(mask), self._chain_T_keyframe)
            self._tracks.keep(~mask)

    def _motion_of_flow(self, left_px: Float, guess: Float) -> Motion | None:
        """Motion since the last keyframe from left pixels as the flow leaves them."""
        px = np.hstack((left_px, np.full_like(left_px, np.nan)))
        covariance = np.broadcast_to(self._noise.flow_variance * np.eye(4), (len(px), 4, 4))
        motion = self._robust_motion(px, covariance, guess)
        if motion is not None:
            self._noise.learn_flow(motion.chi2[np.isfinite(motion.chi2)])
        return motion

    def _robust_motion(self, px: Float, covariance: Float, guess: Float) -> Motion | None:
        """Motion since the last keyframe; tracks that do not follow it get strikes. None without a sound consensus."""
        tracks = self._tracks
        usable = np.isfinite(tracks.points).all(axis=1) & np.isfinite(px[:, :2]).all(axis=1)
        of_points = tracks.points, tracks.points_covariance, px, covariance
        points, points_covariance, px, covariance = of_points if usable.all() else (a[usable] for a in of_points)
        motion = estimate_motion(
            points,
            points_covariance,
            px,
            covariance,
            (guess, self._keyframe_T_last),
            self.rig,
            self.settings.min_inliers,
            of_calibration(points, px, guess, self.rig, self.settings),
        )
        if motion is None or least_spread(px[motion.inliers, :2]) < self.settings.min_spread * self._diagonal:
            return None
        strikes = np.zeros(len(tracks), dtype=np.int64)
        strikes[usable] = np.where(motion.inliers, 0, 1 + (motion.chi2 > 60.0))
        tracks.strikes = np.where(strikes > 0, tracks.strikes + strikes, 0)
        return motion.of_all(np.asarray(usable))

    def _wants_keyframe(self, left_px: Float, pose: Float) -> str | None:
        flow = left_px - self._tracks.keyframe_px
        flow = flow[np.isfinite(flow).all(axis=1)]
        return keyframe_reason(flow, pose, len(self._tracks), self._keyframe_count, self._diagonal, self.settings)

    def _advance(self, pair: StereoPair, keyframe_T_this: Float) -> Float:
        """Makes this pair the last one; `last_T_this`."""
        assert self._last is not None
        last_T_this = inverse(self._keyframe_T_last) @ keyframe_T_this
        self._velocity = logarithm(last_T_this) / max((pair.stamp_ns - self._last.stamp_ns) * 1e-9, 1e-3)
        self._keyframe_T_last = keyframe_T_this
        self._last = pair
        return last_T_this

    def _plain_frame(self, pair: StereoPair, left_px: Float, motion: Motion) -> StereoFrame:
        tracks, inliers = self._tracks, int(motion.inliers.sum())
        last_T_this = self._advance(pair, motion.reference_T_this)
        frame = plain_frame(pair.stamp_ns, tracks.ids, left_px, self._noise.flow_variance, last_T_this, inliers)
        tracks.keep((tracks.strikes < 3) & np.isfinite(left_px).all(axis=1))
        return frame

    # -- keyframes -----------------------------------------------------------------------------------------------

    def _keyframe(self, pair: StereoPair, pose: Float) -> StereoFrame | None:
        """Aligns all tracks with their reference, repeats the motion with both images, and fills up with new tracks."""
        view = self._observer.view(pair)
        sighting = self._observe(view, pose)
        tracks = self._tracks
        px = np.hstack((sighting.left_px, self._vertical.apply(sighting.left_px, sighting.right_px)))
        motion = self._robust_motion(px, sighting.covariance, pose)
        if motion is None:
            return None
        known = np.isfinite(motion.chi2)
        growth = self._noise.learn_motion(motion.chi2[known], np.isfinite(px[known, 2]))
        agree = (motion.inliers | ~known) & (tracks.strikes < 2)
        tracks.keep(agree)
        sighting = sighting.take(agree).scaled(growth)
        last_T_this = self._advance(pair, motion.reference_T_this)
        points.carry(tracks, motion.reference_T_this)
        self._chain_T_keyframe = self._chain_T_keyframe @ motion.reference_T_this
        self._keyframe_T_last = np.eye(4)
        tracks.keyframe_px = sighting.left_px
        tracks.ages += 1
        points.measure(tracks, sighting, self._chain_T_keyframe, self.rig, self._vertical)
        return self._fill(view, sighting, last_T_this, int(motion.inliers.sum()), lost=False)

    def _observe(self, view: Keyview, pose: Float) -> Sighting:
        """The living tracks in a keyframe's images; those that look different now end."""
        tracks = self._tracks
        sighting, raw_px, seen = self._observer.observe(
            view, tracks, self._chain_T_keyframe @ pose, expected_depth(tracks, pose), tracks.right_offset_px
        )
        tracks.raw_px = np.where(seen[:, None], raw_px, tracks.raw_px)
        self._end(~seen)
        return sighting.take(seen)

    def _fill(self, view: Keyview, sighting: Sighting, last_T_this: Float, inliers: int, lost: bool) -> StereoFrame:
        """Adds landmarks seen again and new corners, and delivers the keyframe."""
        settings, tracks = self.settings, self._tracks
        found, seen, correction = self._seen_again(view)
        self._correct_chain(correction)
        if len(found) == 0:
            found, seen = self._close_loop(view)
        free = apart(tracks.raw_px, found.raw_px, 0.4 * self._spacing)
        tracks.keep(free)
        sighting = sighting.take(free).append(seen)
        tracks.extend(found)
        corners = detect(
            view.pair.left,
            tracks.raw_px,
            settings.max_tracks - len(tracks),
            self._spacing,
            settings.patch_radius_px + 2,
            view.noise,
        )
        new, seen = self._observer.begin(view, corners, self._next_id, self._chain_T_keyframe)
        self._next_id += len(new)
        points.measure(new, seen, self._chain_T_keyframe, self.rig, self._vertical)
        tracks.extend(new)
        return self._deliver(view, sighting.append(seen), last_T_this, inliers, lost)

    @property
    def _spacing(self) -> float:
        """Least distance between features; grows with the image."""
        return self.settings.min_distance_px * self._diagonal / 432.7

    def _revisit(self, view: Keyview, rows: NDArray[np.intp]) -> tuple[Tracks, Sighting, Float]:
        return revisit(
            view, self.landmarks, rows, self._chain_T_keyframe, self._observer, self.rig, self._vertical, self.settings
        )

    def _seen_again(self, view: Keyview) -> tuple[Tracks, Sighting, Float]:
        """Old landmarks where the chain expects them."""
        rows = self.landmarks.in_view(self._chain_T_keyframe, self.rig, self.settings.revisits)
        return self._revisit(view, rows.rows)

    def _close_loop(self, view: Keyview) -> tuple[Tracks, Sighting]:
        """Landmarks of a place from long before, when the chain has drifted so far that it does not find them.

        The place's features agree on one motion, and then its landmarks on another one near it; else the chain stays.
        """
        nothing = no_tracks(self._observer.grid), nothing_seen()
        found = self.finding.look_back(view.pair.left, view.pair.stamp_ns)
        if found is None:
            return nothing
        drifted, self._chain_T_keyframe = self._chain_T_keyframe, found.chain_T_this
        tracks, seen, correction = self._seen_again(view)
        if len(tracks) < self.settings.min_inliers:
            self._chain_T_keyframe = drifted
            return nothing
        self._correct_chain(correction)
        self.finding.verified()
        if found.joins:
            self._join(self._chain_T_keyframe @ inverse(drifted))
        return tracks, seen

    def _correct_chain(self, this_T_corrected: Float) -> None:
        """Takes up the drift that landmarks seen again show; the points of living tracks are relative and stay."""
        self._chain_T_keyframe = self._chain_T_keyframe @ this_T_corrected

    def _deliver(self, view: Keyview, sighting: Sighting, last_T_this: Float, inliers: int, lost: bool) -> StereoFrame:
        tracks = self._tracks
        self._view = view
        self._keyframe_count = len(tracks)
        variance = sighting.left_covariance[:, 1, 1] + sighting.right_covariance[:, 1, 1]
        self._vertical.learn(sighting.left_px, sighting.right_px, variance)
        frame = keyframe_of(view.pair.stamp_ns, tracks.ids, sighting, last_T_this, inliers, lost)
        pose = self._chain_T_keyframe
        added = self.finding.remember(frame, pose, view.pair.left, tracks.raw_px, tracks.points)
        self.memorable = Memorable(settled_tracks(tracks, pose), added)
        return frame

    # -- losing and finding --------------------------------------------------------------------------------------

    def _recover(self, pair: StereoPair, guess: Float) -> StereoFrame:
        """The tracks do not connect: goes on from a remembered place, or from where constant velocity leads to."""
        assert self._last is not None
        last_T_this = inverse(self._keyframe_T_last) @ guess
        self._end(np.ones(len(self._tracks), dtype=bool))
        found = self.finding.lost(pair.left, self._last.stamp_ns)
        if found is not None:
            last_T_this = self._led_to(found, last_T_this)
        self._velocity = FADING * self._velocity
        return self._restart(pair, last_T_this, lost=True)

    def _led_to(self, found: Found, predicted: Float) -> Float:
        """`last_T_this` by a place that was found. Where the own chain joins that of an earlier run, it is the chain
        that has moved, and the camera as it was predicted."""
        chain_T_last = self._chain_T_keyframe @ self._keyframe_T_last
        if not found.joins:
            return inverse(chain_T_last) @ found.chain_T_this
        self._join(found.chain_T_this @ inverse(chain_T_last @ predicted))
        self._chain_T_keyframe = found.chain_T_this @ inverse(self._keyframe_T_last @ predicted)
        return predicted

    def _join(self, new_T_old: Float) -> None:
        """The own chain becomes part of an earlier run's."""
        self.finding.join(new_T_old)
        self.landmarks.move(self._own_from, new_T_old)
        self._tracks.patch_poses = new_T_old @ self._tracks.patch_poses

    def _restart(self, pair: StereoPair, last_T_this: Float, lost: bool) -> StereoFrame:
        """A keyframe of landmarks seen again and new tracks; no keyframe where the view holds nothing to start from."""
        self._chain_T_keyframe = self._chain_T_keyframe @ self._keyframe_T_last @ last_T_this
        self._keyframe_T_last = np.eye(4)
        self._tracks = no_tracks(self._observer.grid)
        self._last = pair
        frame = self._fill(self._observer.view(pair), nothing_seen(), last_T_this, 0, lost)
        if np.isfinite(frame.right_px[:, 0]).sum() >= self.settings.min_inliers:
            return frame
        self._tracks = no_tracks(self._observer.grid)
        return blind_frame(pair.stamp_ns, last_T_this)
