"""Landmarks out of sight: patches and places of tracks that ended, and finding them again.

A feature that comes back into view continues under its old id, so that the graph sees one landmark instead of two
and the drift in between is closed. What is found is verified by the motion that all finds have to agree on.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..undistort import distort
from .alignment import Alignment, Patches, PatchGrid, align, make_patches
from .atlas import AtlasTracks
from .flow import inside
from .geometry import Float, StereoGeometry, inverse, project, transform
from .images import Float32, Picture, smooth
from .tracks import CROP_SIDE, Int, Tracks
from .warp import bend_offsets, curvatures, linear_warps

Bool = NDArray[np.bool_]
Image = NDArray[np.uint8]

CROP_GRID = PatchGrid(CROP_SIDE // 2)
_COARSE_GRID = PatchGrid(6, 2.0)
_COARSE_SMOOTHING_PX = 1.8
_LARGEST_TURN = np.cos(np.deg2rad(35.0))
_MISSES = 12


def crops(image: Picture, raw_px: Float, grid: PatchGrid) -> Image:
    """Surroundings (n, s, s) of places (n, 2) in a smoothed image."""
    side = round(len(grid.weights) ** 0.5)
    values = grid.sample(image, raw_px) if len(raw_px) else np.zeros((0, side * side))
    return np.clip(np.rint(values), 0, 255).astype(np.uint8).reshape(-1, side, side)


def _mosaic(tiles: Image) -> tuple[Float32, Float]:
    """All crops below each other as one image, and the pixel (n, 2) of each one's centre."""
    n, side = len(tiles), tiles.shape[1]
    centres = np.full((n, 2), (side - 1) / 2.0)
    centres[:, 1] += np.arange(n) * side
    return tiles.reshape(n * side, side).astype(np.float32), centres


@dataclass(frozen=True, slots=True)
class Candidates:
    """Stored landmarks that should be in view."""

    rows: NDArray[np.intp]
    """Shape (n,), in the store."""
    points: Float
    """Shape (n, 3), expected in this left camera."""
    raw_px: Float
    """Shape (n, 2), expected left raw pixels."""


class LandmarkStore:
    """A ring of landmarks; the one longest out of sight makes room."""

    def __init__(self, capacity: int) -> None:
        self._capacity = capacity
        self._next = 0
        self.ids: Int = np.zeros(0, dtype=np.int64)
        self.points = np.zeros((0, 3))
        """In the chain's frame."""
        self.patch_points = np.zeros((0, 3))
        self.patch_poses = np.zeros((0, 4, 4))
        self.slopes = np.zeros((0, 2))
        self.ages: Int = np.zeros(0, dtype=np.int64)
        self.misses: Int = np.zeros(0, dtype=np.int64)
        self.tiles: Image = np.zeros((0, CROP_SIDE, CROP_SIDE), dtype=np.uint8)

    def add(self, tracks: Tracks, chain_T_keyframe: Float) -> None:
        """Remembers tracks that were seen in three keyframes and have a point."""
        good = (tracks.ages >= 3) & np.isfinite(tracks.points).all(axis=1)
        good &= np.isfinite(tracks.patch_points).all(axis=1)
        if not good.any():
            return
        rows = self._rows(int(good.sum()))
        self.ids[rows] = tracks.ids[good]
        self.points[rows] = transform(chain_T_keyframe, tracks.points[good])
        self.patch_points[rows] = tracks.patch_points[good]
        self.patch_poses[rows] = tracks.patch_poses[good]
        self.slopes[rows] = tracks.slopes[good]
        self.ages[rows] = tracks.ages[good]
        self.misses[rows] = 0
        self.tiles[rows] = tracks.crops[good]

    def recall(self, tracks: AtlasTracks) -> None:
        """Landmarks of an earlier run."""
        if len(tracks) == 0:
            return
        rows = self._rows(len(tracks))
        for name in ("ids", "points", "patch_points", "patch_poses", "slopes"):
            getattr(self, name)[rows] = getattr(tracks, name)
        self.tiles[rows], self.ages[rows], self.misses[rows] = tracks.crops, tracks.views, 0

    def move(self, first_id: int, new_T_old: Float) -> None:
        """Takes landmarks from an id on to another chain."""
        rows = np.flatnonzero(self.ids >= first_id)
        self.points[rows] = transform(new_T_old, self.points[rows])
        self.patch_poses[rows] = new_T_old @ self.patch_poses[rows]

    def _rows(self, n: int) -> NDArray[np.intp]:
        """Rows to write to: freed ones are overwritten as the ring comes round."""
        grow = min(max(self._next + n, 64), self._capacity)
        if grow > len(self.ids):
            self._grow(min(max(grow, 2 * len(self.ids)), self._capacity))
        rows = (self._next + np.arange(n)) % self._capacity
        self._next = int((self._next + n) % self._capacity)
        return rows

    def _grow(self, size: int) -> None:
        extra = size - len(self.ids)
        self.ids = np.concatenate((self.ids, np.full(extra, -1, dtype=np.int64)))
        for name in ("points", "patch_points", "patch_poses", "slopes", "ages", "misses", "tiles"):
            old = getattr(self, name)
            setattr(self, name, np.concatenate((old, np.zeros((extra, *old.shape[1:]), dtype=old.dtype))))

    def forget(self, rows: NDArray[np.intp]) -> None:
        """Frees rows, for tracks that live again."""
        self.ids[rows] = -1

    def in_view(self, chain_T_this: Float, rig: StereoGeometry, limit: int) -> Candidates:
        """Up to `limit` landmarks expected in the left image from about the direction they were first seen from."""
        here = transform(inverse(chain_T_this), self.points)
        raw = distort(rig.left, project(here, rig.left))
        good = (self.ids >= 0) & inside(raw, (rig.left.height, rig.left.width), 10.0)
        rows = np.flatnonzero(good)
        rows = rows[self._same_face(rows, here[rows], chain_T_this)]
        rows = rows[np.lexsort((-self.ages[rows], self.misses[rows]))][:limit]
        return Candidates(rows, here[rows], raw[rows])

    def _same_face(self, rows: NDArray[np.intp], here: Float, chain_T_this: Float) -> Bool:
        there = self.patch_points[rows]
        turned = self.patch_poses[rows, :3, :3] @ there[:, :, None]
        now = here @ chain_T_this[:3, :3].T
        cosine = (turned[:, :, 0] * now).sum(axis=1)
        cosine /= np.maximum(np.linalg.norm(there, axis=1) * np.linalg.norm(here, axis=1), 1e-9)
        ratio = here[:, 2] / np.maximum(there[:, 2], 1e-9)
        return (cosine > _LARGEST_TURN) & (ratio > 0.5) & (ratio < 2.0)

    def find_left(
        self,
        image: Image,
        smoothed: Picture,
        candidates: Candidates,
        chain_T_this: Float,
        rig: StereoGeometry,
        grid: PatchGrid,
        min_correlation: float,
        variance: float,
    ) -> tuple[Alignment, Patches, Bool]:
        """Where the candidates are in the left image, their fine patches, and which were found.

        A coarse patch, four times the area, brings the start to within a pixel; the fine one decides.
        """
        rows = candidates.rows
        tiles, centres = _mosaic(self.tiles[rows])
        this_T_patch = inverse(chain_T_this) @ self.patch_poses[rows]
        surface = self.patch_points[rows], self.slopes[rows]
        warp = linear_warps(*surface, this_T_patch, rig)[0]
        # Each tile is low-passed by itself: the mosaic's seams lie beyond the coarse patch.
        coarse = make_patches(Picture(_low_pass(tiles)), centres, _COARSE_GRID)
        blurred = Picture(smooth(image, _COARSE_SMOOTHING_PX))
        first = align(blurred, coarse, candidates.raw_px, warp, _COARSE_GRID, 12, 12.0)
        fine = make_patches(Picture(tiles), centres, grid, variance)
        off = bend_offsets(warp, fine.bend, curvatures(*surface, this_T_patch, rig)[0])
        start = np.where((first.correlation > 0.6)[:, None], first.px, np.nan)
        second = align(smoothed, fine, start, warp, grid, 10).moved(-off)
        return second, fine, second.converged & (second.correlation > min_correlation)

    def revive(self, rows: NDArray[np.intp], raw_px: Float, ideal_px: Float, patches: Patches, points: Float) -> Tracks:
        """Tracks of landmarks found again, with points (n, 3) in this camera and a covariance to be measured."""
        n = len(rows)
        return Tracks(
            ids=self.ids[rows].copy(),
            raw_px=raw_px,
            right_offset_px=np.zeros((n, 2)),
            points=points,
            points_covariance=np.full((n, 3, 3), np.nan),
            keyframe_px=ideal_px,
            patches=patches,
            patch_points=self.patch_points[rows].copy(),
            patch_poses=self.patch_poses[rows].copy(),
            slopes=self.slopes[rows].copy(),
            crops=self.tiles[rows].copy(),
            ages=self.ages[rows] + 1,
            strikes=np.zeros(n, dtype=np.int64),
        )

    def missed(self, rows: NDArray[np.intp]) -> None:
        """Counts landmarks that should have been seen; after a dozen times they are forgotten."""
        self.misses[rows] += 1
        self.ids[rows[self.misses[rows] > _MISSES]] = -1

    def rows_of(self, ids: Int) -> NDArray[np.intp]:
        """Rows of ids that are stored; others are left out."""
        order = np.argsort(self.ids, kind="stable")
        place = np.searchsorted(self.ids[order], ids)
        place = np.minimum(place, len(order) - 1) if len(order) else place
        return order[place][self.ids[order[place]] == ids] if len(order) else np.zeros(0, dtype=np.intp)


def _low_pass(tiles: Float32) -> Float32:
    """The mosaic at the coarse stage's smoothness, which the crops have in part already."""
    return np.asarray(smooth(np.clip(np.rint(tiles), 0, 255).astype(np.uint8), _COARSE_SMOOTHING_PX), dtype=np.float32)
