"""Sub-pixel observations of tracks in a keyframe's two images."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..undistort import distort, undistort
from .alignment import Alignment, Patches, PatchGrid, align, make_patches
from .geometry import Float, StereoGeometry, inverse, project, rays, transform
from .images import Picture
from .landmarks import CROP_GRID, crops
from .matching import search_right
from .noise import NoiseModel
from .pair import StereoPair
from .settings import StereoSettings
from .sighting import Sighting
from .tracks import Int, Tracks, new_tracks
from .warp import bend_offsets, curvatures, linear_warps

Bool = NDArray[np.bool_]

_SLOPE_PARALLAX_PX = 4.0
"""Parallax at which a patch's shear tells as much about its surface as one knows: most are less than 45 degrees off."""
_STEEPEST = 0.02
"""Largest slope, 1/px."""


@dataclass(frozen=True, slots=True)
class Keyview:
    """A keyframe's pair with its smoothed images."""

    pair: StereoPair
    left: Picture
    right: Picture
    noise: float
    """Standard deviation of the pixel noise, grey values."""


class Observer:
    """Aligns patches in left and right images and gives each place its covariance."""

    def __init__(self, rig: StereoGeometry, noise: NoiseModel, settings: StereoSettings) -> None:
        self._rig, self._noise, self._settings = rig, noise, settings
        self.grid = PatchGrid(settings.patch_radius_px, bend_sigma=settings.bend_sigma)

    def view(self, pair: StereoPair) -> Keyview:
        """The pair with its smoothed images."""
        return Keyview(pair, *pair.smooth(self._settings.smoothing_px), pair.noise())

    def mismatch(self, view: Keyview) -> float:
        """Expected variance between a patch and its reference, in squared grey values."""
        return self._noise.mismatch(view.noise)

    def accepts(self, alignment: Alignment) -> Bool:
        """Which patches look like their reference."""
        return alignment.converged & (alignment.correlation > self._settings.min_correlation)

    def observe(
        self, view: Keyview, tracks: Tracks, chain_T_this: Float, depth_m: Float, right_offset_px: Float
    ) -> tuple[Sighting, Float, Bool]:
        """Observations of tracks near their `raw_px`.

        Args:
            view: the keyframe.
            tracks: n tracks.
            chain_T_this: (4, 4), expected pose of the camera in the chain.
            depth_m: (n,), expected depth; NaN gives no right match.
            right_offset_px: (n, 2), expected disagreement of the right match with the nominal rig.

        Returns:
            the sighting, refined left raw pixels (n, 2), and which tracks were seen in the left image (n,).
        """
        this_T_patch = inverse(chain_T_this) @ tracks.patch_poses
        warps = linear_warps(tracks.patch_points, tracks.slopes, this_T_patch, self._rig)
        curved = curvatures(tracks.patch_points, tracks.slopes, this_T_patch, self._rig)
        off = [bend_offsets(*pair) for pair in zip(warps, [tracks.patches.bend] * 2, curved, strict=True)]
        left = align(view.left, tracks.patches, tracks.raw_px + off[0], warps[0], self.grid).moved(-off[0])
        left_px, left_covariance = self._left(left)
        seen = self.accepts(left) & np.isfinite(left_px).all(axis=1)
        self._noise.learn_mismatch(left, tracks.patches, seen)
        start = np.where(seen[:, None], self._expected_right(left_px, depth_m) + right_offset_px, np.nan)
        right = align(view.right, tracks.patches, start + off[1], warps[1], self.grid).moved(-off[1])
        right_px, right_covariance = self._right(right)
        return Sighting(left_px, left_covariance, right_px, right_covariance), left.px, seen

    def complete(self, view: Keyview, tracks: Tracks, chain_T_this: Float, left: Alignment) -> Sighting:
        """Observations of n tracks whose left patches have been aligned already, with their right matches."""
        this_T_patch = inverse(chain_T_this) @ tracks.patch_poses
        warp = linear_warps(tracks.patch_points, tracks.slopes, this_T_patch, self._rig)[1]
        off = bend_offsets(
            warp, tracks.patches.bend, curvatures(tracks.patch_points, tracks.slopes, this_T_patch, self._rig)[1]
        )
        left_px, left_covariance = self._left(left)
        start = self._expected_right(left_px, tracks.points[:, 2])
        right = align(view.right, tracks.patches, start + off, warp, self.grid).moved(-off)
        right_px, right_covariance = self._right(right)
        return Sighting(left_px, left_covariance, right_px, right_covariance)

    def _expected_right(self, left_px: Float, depth_m: Float) -> Float:
        """Right raw pixels (n, 2) at the expected depth on the left ray, which is known well."""
        points = rays(left_px, self._rig.left) * depth_m[:, None]
        return distort(self._rig.right, project(self._rig.right_points(points), self._rig.right))

    def _left(self, left: Alignment) -> tuple[Float, Float]:
        px, covariance = undistort(self._rig.left, left.px, self._noise.aligned(left.covariance))
        assert covariance is not None
        return px, covariance

    def _right(self, right: Alignment) -> tuple[Float, Float]:
        px, covariance = undistort(self._rig.right, right.px, self._noise.aligned(right.covariance))
        px[~self.accepts(right)] = np.nan
        assert covariance is not None
        return px, covariance

    def begin(self, view: Keyview, raw_px: Float, first_id: int, chain_T_this: Float) -> tuple[Tracks, Sighting]:
        """New tracks at those of the corners (n, 2) of the left image that have a right match.

        Without depth a track adds nothing: no motion could be had from it, nor a landmark.
        """
        settings = self._settings
        ideal = undistort(self._rig.left, raw_px)[0]
        start = search_right(
            view.pair.left,
            view.pair.right,
            raw_px,
            ideal,
            self._rig,
            settings.nearest_baselines * self._rig.baseline_m,
            settings.epipolar_gate_px,
            settings.patch_radius_px,
            settings.min_correlation,
        )
        matched = np.isfinite(start).all(axis=1) & np.isfinite(ideal).all(axis=1)
        raw_px, ideal, start = raw_px[matched], ideal[matched], start[matched]
        patches = make_patches(view.left, raw_px, self.grid, self.mismatch(view))
        right = align(view.right, patches, start, np.broadcast_to(np.eye(2), (len(start), 2, 2)), self.grid)
        sighting = self._first_sighting(ideal, raw_px, right, patches)
        good = np.isfinite(sighting.right_px[:, 0])
        ids: Int = np.arange(first_id, first_id + int(good.sum()), dtype=np.int64)
        surroundings = crops(view.left, raw_px[good], CROP_GRID)
        slopes = self._slopes(ideal[good], right.take(good))
        tracks = new_tracks(ids, raw_px[good], ideal[good], patches.take(good), slopes, surroundings, chain_T_this)
        return tracks, sighting.take(good)

    def _slopes(self, ideal: Float, right: Alignment) -> Float:
        """Slopes (n, 2) of surfaces, from how their patches are sheared in the right image.

        There d lies at `far + e (1 + s . d)`, e the parallax of the patch's centre. What noise and prior of the linear
        part leave over counts as a share of e.
        """
        far = project(rays(ideal, self._rig.left) @ self._rig.right_T_left[:3, :3].T, self._rig.right)
        parallax = undistort(self._rig.right, right.px)[0] - far
        square = (parallax**2).sum(axis=1, keepdims=True)
        slopes = (parallax[:, None, :] @ right.bend)[:, 0] / (square + _SLOPE_PARALLAX_PX**2)
        return np.clip(np.nan_to_num(slopes), -_STEEPEST, _STEEPEST)

    def _first_sighting(self, ideal: Float, raw_px: Float, right: Alignment, patches: Patches) -> Sighting:
        right_px, right_covariance = self._right(right)
        own = patches.inverse_hessian * self._noise.reference_variance(right, patches)[:, None, None]
        left_covariance = undistort(self._rig.left, raw_px, self._noise.reference(own))[1]
        assert left_covariance is not None
        return Sighting(ideal, left_covariance, right_px, right_covariance)


def expected_depth(tracks: Tracks, keyframe_T_this: Float) -> Float:
    """Depth (n,) of the tracks' points in this camera."""
    return transform(inverse(keyframe_T_this), tracks.points)[:, 2]
