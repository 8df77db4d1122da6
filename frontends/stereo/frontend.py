"""The stereo front end: one pair in, one `StereoFrame` out."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...factors.camera import CameraModel
from ...factors.measurements import StereoFrame
from ..undistort import distort, undistort
from . import images
from .alignment import Alignment, PatchGrid, align, make_patches
from .detection import detect
from .flow import Image, checked_flow, inside
from .geometry import Float, StereoGeometry, block_diagonal, exponential, inverse, logarithm, project, rays, transform
from .keyframes import keyframe_reason
from .matching import search_right
from .motion import Motion, estimate_motion, point_covariance
from .noise import NoiseModel
from .settings import StereoSettings
from .tracks import Tracks, new_tracks
from .warp import linear_warps, transform_each

Bool = NDArray[np.bool_]


@dataclass(slots=True)
class _Pair:
    """One stereo pair, ready for comparison."""

    stamp_ns: int
    left: Image
    right: Image
    levels: Float
    noise: float


@dataclass(frozen=True, slots=True)
class _Sighting:
    """What a keyframe saw of n tracks, in ideal pixels."""

    left_px: Float
    left_covariance: Float
    right_px: Float
    right_covariance: Float


class StereoFrontEnd:
    """Tracks, keyframes and a first-guess motion from stereo pairs in the order of their time.

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
        self._diagonal = float(np.hypot(left.width, left.height))
        self._distance = self.settings.min_distance_px * self._diagonal / 432.7
        self._grid = PatchGrid(self.settings.patch_radius_px)
        self._noise = NoiseModel()
        self._tracks: Tracks | None = None
        self._last: _Pair | None = None
        self._keyframe_count = 0
        self._next_id = 0
        self._chain_T_keyframe = np.eye(4)
        self._keyframe_T_last = np.eye(4)
        self._velocity = np.zeros(6)

    def process(self, stamp_ns: int, left: NDArray[np.generic], right: NDArray[np.generic]) -> StereoFrame:
        """Tracks the features into this pair.

        Args:
            stamp_ns: time of the pair, later than that of the pair before.
            left: image (h, w) or (h, w, 3).
            right: the same size.
        """
        pair = self._prepare(stamp_ns, left, right)
        if self._tracks is None or self._last is None:
            self._last = pair
            return self._restart(pair, np.eye(4), lost=False)
        guess = self._keyframe_T_last @ self._predicted_motion(pair)
        self._track(pair, guess)
        motion = self._motion_of_flow(guess)
        if motion is None:
            return self._recover(pair, guess)
        pose = motion.reference_T_this
        reason = self._wants_keyframe(pose)
        frame = self._plain_frame(pair, motion) if reason is None else self._keyframe(pair, pose)
        return frame if frame is not None else self._recover(pair, guess)

    # -- one pair ------------------------------------------------------------------------------------------------

    def _prepare(self, stamp_ns: int, left: NDArray[np.generic], right: NDArray[np.generic]) -> _Pair:
        grey = [images.to_grey(image) for image in (left, right)]
        levels = images.quantiles(grey[0])
        noise = images.noise_sigma(grey[0])
        table = images.contrast_table(levels)
        if table is not None:
            gain = (float(table[255]) - float(table[0])) / 255.0
            gain = max(1.0, 200.0 / max(levels[2] - levels[0], 200.0 / 6.0), gain)
            grey = [table[image] for image in grey]
            levels = images.quantiles(grey[0])
            noise *= gain
        return _Pair(stamp_ns, grey[0], grey[1], levels, noise)

    def _predicted_motion(self, pair: _Pair) -> Float:
        """`last_T_this` at constant velocity."""
        assert self._last is not None
        return exponential(self._velocity * min((pair.stamp_ns - self._last.stamp_ns) * 1e-9, 0.5))

    def _track(self, pair: _Pair, guess: Float) -> None:
        """Flow from the last left image into this one; drops what does not come back."""
        assert self._tracks is not None and self._last is not None
        tracks, settings = self._tracks, self.settings
        start = self._flow_guess(guess)
        table = images.brightness_table(self._last.levels, pair.levels)
        source = self._last.left if table is None else table[self._last.left]
        found, good = checked_flow(
            source,
            pair.left,
            tracks.raw_px,
            start,
            settings.flow_window_px,
            settings.pyramid_levels,
            settings.forward_backward_px,
        )
        tracks.raw_px = found
        tracks.keep(good & inside(found, pair.left.shape, 3.0))

    def _flow_guess(self, guess: Float) -> Float:
        """Expected raw pixels: moved points keep their offset, the others move as their neighbours' median."""
        assert self._tracks is not None
        tracks = self._tracks
        before = distort(self.rig.left, project(transform(inverse(self._keyframe_T_last), tracks.points), self.rig.left))
        after = distort(self.rig.left, project(transform(inverse(guess), tracks.points), self.rig.left))
        shift = after - before
        known = np.isfinite(shift).all(axis=1)
        shift[~known] = np.median(shift[known], axis=0) if known.any() else 0.0
        return tracks.raw_px + np.clip(shift, -0.3 * self._diagonal, 0.3 * self._diagonal)

    # -- motion --------------------------------------------------------------------------------------------------

    def _motion_of_flow(self, guess: Float) -> Motion | None:
        """Motion since the last keyframe from left pixels as the flow leaves them; counts strikes, drops outliers."""
        assert self._tracks is not None
        tracks = self._tracks
        left_px = undistort(self.rig.left, tracks.raw_px)[0]
        px = np.hstack((left_px, np.full_like(left_px, np.nan)))
        covariance = np.broadcast_to(self._noise.flow_variance * np.eye(4), (len(tracks), 4, 4))
        return self._robust_motion(px, covariance, guess)

    def _robust_motion(self, px: Float, covariance: Float, guess: Float) -> Motion | None:
        assert self._tracks is not None
        tracks = self._tracks
        usable = np.isfinite(tracks.points).all(axis=1) & np.isfinite(px[:, :2]).all(axis=1)
        motion = estimate_motion(
            tracks.points[usable],
            tracks.points_covariance[usable],
            px[usable],
            covariance[usable],
            guess,
            self.rig,
            self.settings.min_inliers,
        )
        if motion is None or not self._well_spread(px[usable][motion.inliers, :2]):
            return None
        strikes = np.zeros(len(tracks), dtype=np.int64)
        strikes[usable] = np.where(motion.inliers, 0, 1 + (motion.chi2 > 60.0))
        tracks.strikes = np.where(strikes > 0, tracks.strikes + strikes, 0)
        inliers = np.zeros(len(tracks), dtype=bool)
        inliers[usable] = motion.inliers
        chi2 = np.full(len(tracks), np.nan)
        chi2[usable] = motion.chi2
        return Motion(motion.reference_T_this, inliers, chi2)

    def _well_spread(self, px: Float) -> bool:
        spread = np.sqrt(max(float(np.linalg.eigvalsh(np.cov(px.T))[0]), 0.0))
        return spread > self.settings.min_spread * self._diagonal

    def _wants_keyframe(self, pose: Float) -> str | None:
        assert self._tracks is not None
        here = undistort(self.rig.left, self._tracks.raw_px)[0]
        flow = here - self._tracks.keyframe_px
        return keyframe_reason(
            flow[np.isfinite(flow).all(axis=1)],
            pose,
            len(self._tracks),
            self._keyframe_count,
            self._diagonal,
            self.settings,
        )

    def _advance(self, pair: _Pair, keyframe_T_this: Float) -> Float:
        """Makes this pair the last one; `last_T_this`."""
        assert self._last is not None
        last_T_this = inverse(self._keyframe_T_last) @ keyframe_T_this
        seconds = max((pair.stamp_ns - self._last.stamp_ns) * 1e-9, 1e-3)
        self._velocity = logarithm(last_T_this) / seconds
        self._keyframe_T_last = keyframe_T_this
        self._last = pair
        return last_T_this

    def _plain_frame(self, pair: _Pair, motion: Motion) -> StereoFrame:
        assert self._tracks is not None
        tracks = self._tracks
        left_px = undistort(self.rig.left, tracks.raw_px)[0]
        n = len(tracks)
        frame = StereoFrame(
            stamp_ns=pair.stamp_ns,
            is_keyframe=False,
            track_ids=tracks.ids.copy(),
            left_px=left_px,
            left_covariance_px2=np.tile(self._noise.flow_variance * np.eye(2), (n, 1, 1)),
            right_px=np.full((n, 2), np.nan),
            right_covariance_px2=np.tile(np.eye(2), (n, 1, 1)),
            last_T_this=self._advance(pair, motion.reference_T_this),
            motion_inliers=int(motion.inliers.sum()),
        )
        tracks.keep((tracks.strikes < 3) & np.isfinite(left_px).all(axis=1))
        return frame

    # -- keyframes -----------------------------------------------------------------------------------------------

    def _keyframe(self, pair: _Pair, pose: Float) -> StereoFrame | None:
        """Aligns all tracks with their reference, repeats the motion in both images, and fills up with new tracks."""
        assert self._tracks is not None
        smooth = self._smoothed(pair)
        self._align_left(smooth[0], pose)
        sighting = self._align_right(smooth, pose)
        px = np.hstack((sighting.left_px, sighting.right_px))
        covariance = block_diagonal(sighting.left_covariance, sighting.right_covariance)
        motion = self._robust_motion(px, covariance, pose)
        if motion is None:
            return None
        pose = motion.reference_T_this
        self._noise.learn_motion(motion.chi2[np.isfinite(motion.chi2)])
        agree = (motion.inliers | ~np.isfinite(motion.chi2)) & (self._tracks.strikes < 2)
        self._tracks.keep(agree)
        kept = _Sighting(*(getattr(sighting, name)[agree] for name in _Sighting.__dataclass_fields__))
        self._move_points(kept, pose)
        last_T_this = self._advance(pair, pose)
        self._chain_T_keyframe = self._chain_T_keyframe @ pose
        self._keyframe_T_last = np.eye(4)
        return self._fill(pair, smooth, kept, last_T_this, int(motion.inliers.sum()), lost=False)

    def _smoothed(self, pair: _Pair) -> tuple[images.Float32, images.Float32]:
        sigma = self.settings.smoothing_px
        return images.smooth(pair.left, sigma), images.smooth(pair.right, sigma)

    def _warps(self, pose: Float) -> tuple[Float, Float]:
        """Stretch of the reference patches in left and right at `keyframe_T_this`."""
        assert self._tracks is not None
        this_T_chain = inverse(self._chain_T_keyframe @ pose)
        return linear_warps(self._tracks.patch_points, this_T_chain @ self._tracks.patch_poses, self.rig)

    def _align_left(self, image: images.Float32, pose: Float) -> None:
        """Puts the tracks where their reference patch fits and drops those that do not look like it any more."""
        assert self._tracks is not None
        tracks = self._tracks
        self._left = align(image, tracks.patches, tracks.raw_px, self._warps(pose)[0], self._grid)
        good = self._left.converged & (self._left.correlation > self.settings.min_correlation)
        tracks.raw_px = self._left.px
        tracks.keep(good)
        self._left = _take(self._left, good)

    def _align_right(self, smooth: tuple[images.Float32, images.Float32], pose: Float) -> _Sighting:
        """Right matches of the tracks from the same reference patches."""
        assert self._tracks is not None
        tracks = self._tracks
        left_px, left_covariance = undistort(self.rig.left, tracks.raw_px, self._noise.aligned(self._left.covariance))
        here = transform(inverse(pose), tracks.points)
        # The left ray is known better than the predicted one: keep the predicted depth on it.
        start = self._right_guess(left_px, here[:, 2]) + tracks.right_offset_px
        right = align(smooth[1], tracks.patches, start, self._warps(pose)[1], self._grid)
        found = right.converged & (right.correlation > self.settings.min_correlation)
        right_px, right_covariance = undistort(self.rig.right, right.px, self._noise.aligned(right.covariance))
        right_px[~found] = np.nan
        assert left_covariance is not None and right_covariance is not None
        return _Sighting(left_px, left_covariance, right_px, right_covariance)

    def _right_guess(self, left_px: Float, depth: Float) -> Float:
        points = rays(left_px, self.rig.left) * depth[:, None]
        return distort(self.rig.right, project(self.rig.right_points(points), self.rig.right))

    def _move_points(self, sighting: _Sighting, pose: Float) -> None:
        """Takes the points to the new keyframe's camera and fuses them with its own stereo measurement."""
        assert self._tracks is not None
        tracks = self._tracks
        rotation = pose[:3, :3]
        tracks.points = transform(inverse(pose), tracks.points)
        tracks.points_covariance = rotation.T @ tracks.points_covariance @ rotation * 1.1
        tracks.keyframe_px = sighting.left_px
        tracks.ages += 1
        self._measure_points(tracks, sighting)

    def _measure_points(self, tracks: Tracks, sighting: _Sighting) -> None:
        """Fuses the points with what this keyframe's two images say about them."""
        measured = self.rig.triangulate(sighting.left_px, sighting.right_px)
        seen = np.isfinite(measured).all(axis=1)
        covariance = np.full((len(tracks), 3, 3), np.nan)
        covariance[seen] = point_covariance(
            measured[seen], block_diagonal(sighting.left_covariance, sighting.right_covariance)[seen], self.rig
        )
        fresh = seen & ~np.isfinite(tracks.points).all(axis=1)
        tracks.points[fresh], tracks.points_covariance[fresh] = measured[fresh], covariance[fresh]
        both = seen & ~fresh
        old, new = np.linalg.inv(tracks.points_covariance[both]), np.linalg.inv(covariance[both])
        joint = np.linalg.inv(old + new)
        weighted = np.einsum("nij,nj->ni", old, tracks.points[both]) + np.einsum("nij,nj->ni", new, measured[both])
        tracks.points[both] = np.einsum("nij,nj->ni", joint, weighted)
        tracks.points_covariance[both] = joint
        offset = sighting.right_px - project(self.rig.right_points(tracks.points), self.rig.right)
        tracks.right_offset_px = np.where(np.isfinite(offset), offset, 0.0)
        unset = ~np.isfinite(tracks.patch_points).all(axis=1) & np.isfinite(tracks.points).all(axis=1)
        patch_T_this = np.einsum("nij,njk->nik", _inverse_each(tracks.patch_poses[unset]), self._chain_poses(unset))
        tracks.patch_points[unset] = transform_each(patch_T_this, tracks.points[unset])

    def _chain_poses(self, mask: Bool) -> Float:
        return np.broadcast_to(self._chain_T_keyframe, (int(mask.sum()), 4, 4))

    def _fill(
        self,
        pair: _Pair,
        smooth: tuple[images.Float32, images.Float32],
        sighting: _Sighting,
        last_T_this: Float,
        inliers: int,
        lost: bool,
    ) -> StereoFrame:
        """Adds new tracks and delivers the keyframe."""
        assert self._tracks is not None
        tracks, settings = self._tracks, self.settings
        raw = detect(
            pair.left,
            tracks.raw_px,
            settings.max_tracks - len(tracks),
            self._distance,
            settings.patch_radius_px + 2,
            pair.noise,
        )
        new, seen = self._begin(pair, smooth, raw)
        tracks.extend(new)
        both = _Sighting(
            *(
                np.concatenate((getattr(sighting, name), getattr(seen, name)))
                for name in _Sighting.__dataclass_fields__
            )
        )
        self._keyframe_count = len(tracks)
        return StereoFrame(
            stamp_ns=pair.stamp_ns,
            is_keyframe=True,
            track_ids=tracks.ids.copy(),
            left_px=both.left_px,
            left_covariance_px2=both.left_covariance,
            right_px=both.right_px,
            right_covariance_px2=both.right_covariance,
            last_T_this=last_T_this,
            motion_inliers=inliers,
            lost=lost,
        )

    def _begin(
        self, pair: _Pair, smooth: tuple[images.Float32, images.Float32], raw: Float
    ) -> tuple[Tracks, _Sighting]:
        """New tracks at corners `raw` (n, 2) with their right matches."""
        settings = self.settings
        ideal = undistort(self.rig.left, raw)[0]
        valid = np.isfinite(ideal).all(axis=1)
        raw, ideal = raw[valid], ideal[valid]
        patches = make_patches(smooth[0], raw, self._grid)
        ids = np.arange(self._next_id, self._next_id + len(raw), dtype=np.int64)
        self._next_id += len(raw)
        tracks = new_tracks(ids, raw, ideal, patches, self._chain_T_keyframe)
        start = search_right(
            pair.left,
            pair.right,
            raw,
            ideal,
            self.rig,
            settings.nearest_baselines * self.rig.baseline_m,
            settings.epipolar_gate_px,
            settings.patch_radius_px,
            settings.min_correlation,
        )
        identity = np.broadcast_to(np.eye(2), (len(raw), 2, 2))
        right = align(smooth[1], patches, start, identity, self._grid)
        right_px, right_covariance = undistort(self.rig.right, right.px, self._noise.aligned(right.covariance))
        right_px[~(right.converged & (right.correlation > settings.min_correlation))] = np.nan
        own = patches.inverse_hessian * self._noise.residual_variance(right, patches)[:, None, None]
        left_covariance = undistort(self.rig.left, raw, self._noise.aligned(own))[1]
        assert left_covariance is not None and right_covariance is not None
        sighting = _Sighting(ideal, left_covariance, right_px, right_covariance)
        self._measure_points(tracks, sighting)
        return tracks, sighting

    # -- losing and finding --------------------------------------------------------------------------------------

    def _restart(self, pair: _Pair, last_T_this: Float, lost: bool) -> StereoFrame:
        """A keyframe with new tracks only."""
        self._chain_T_keyframe = self._chain_T_keyframe @ self._keyframe_T_last @ last_T_this
        self._keyframe_T_last = np.eye(4)
        none = np.zeros((0, 2))
        smooth = self._smoothed(pair)
        empty = make_patches(smooth[0], none, self._grid)
        self._tracks = new_tracks(np.zeros(0, dtype=np.int64), none, none, empty, self._chain_T_keyframe)
        nothing = _Sighting(none, np.zeros((0, 2, 2)), none, np.zeros((0, 2, 2)))
        self._last = pair
        return self._fill(pair, smooth, nothing, last_T_this, 0, lost)

    def _recover(self, pair: _Pair, guess: Float) -> StereoFrame:
        """The tracks do not connect: starts again where a constant velocity leads to."""
        last_T_this = inverse(self._keyframe_T_last) @ guess
        self._velocity = self._velocity * 0.5
        return self._restart(pair, last_T_this, lost=True)


def _take(alignment: Alignment, mask: Bool) -> Alignment:
    return Alignment(
        alignment.px[mask], alignment.correlation[mask], alignment.covariance[mask], alignment.converged[mask]
    )


def _inverse_each(poses: Float) -> Float:
    """Inverses of poses (n, 4, 4)."""
    out = np.zeros_like(poses)
    rotation = poses[:, :3, :3].transpose(0, 2, 1)
    out[:, :3, :3] = rotation
    out[:, :3, 3] = -np.einsum("nij,nj->ni", rotation, poses[:, :3, 3])
    out[:, 3, 3] = 1.0
    return out
