"""The living tracks: parallel arrays, one row per track."""

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from .alignment import Patches, PatchGrid, no_patches

Float = NDArray[np.float64]
Int = NDArray[np.int64]
Bool = NDArray[np.bool_]
Image = NDArray[np.uint8]

CROP_SIDE = 41
"""Side of the surroundings kept of each reference patch: enough for a coarse patch and its low-pass."""


@dataclass(slots=True)
class Tracks:
    """n tracks. Raw pixels are pixels of the images, before undistortion."""

    ids: Int
    """Shape (n,)."""
    raw_px: Float
    """Shape (n, 2), in the last left image."""
    right_offset_px: Float
    """Shape (n, 2): right match at the last keyframe less the projection of `points`; zero without a match."""
    points: Float
    """Shape (n, 3), in the last keyframe's left camera; NaN where no right match was ever found."""
    points_covariance: Float
    """Shape (n, 3, 3)."""
    keyframe_px: Float
    """Shape (n, 2), ideal left pixels at the last keyframe."""
    patches: Patches
    patch_points: Float
    """Shape (n, 3): the point in the camera that saw the reference patch."""
    patch_poses: Float
    """Shape (n, 4, 4): that camera in the front end's own chain of motions."""
    slopes: Float
    """Shape (n, 2): of the surface there, relative change of the inverse depth per pixel of the reference patch."""
    crops: Image
    """Shape (n, s, s): the surroundings of the reference patch in its smoothed image, for a later return."""
    ages: Int
    """Shape (n,), number of keyframes that saw the track."""
    strikes: Int
    """Shape (n,), number of frames in a row in which the track did not follow the motion."""

    def __len__(self) -> int:
        return len(self.ids)

    def take(self, index: NDArray[np.intp] | Bool) -> "Tracks":
        """Copies of the tracks at the given indices or of the given mask."""
        return Tracks(patches=self.patches.take(index), **{name: getattr(self, name)[index] for name in _ARRAYS})

    def keep(self, mask: Bool) -> None:
        """Drops the tracks outside `mask`."""
        if mask.all():
            return
        for name in _ARRAYS:
            setattr(self, name, getattr(self, name)[mask])
        self.patches = self.patches.take(mask)

    def extend(self, other: "Tracks") -> None:
        """Appends other tracks."""
        for name in _ARRAYS:
            setattr(self, name, np.concatenate((getattr(self, name), getattr(other, name))))
        self.patches = self.patches.append(other.patches)


_ARRAYS = tuple(field.name for field in fields(Tracks) if field.name != "patches")


def new_tracks(
    ids: Int, raw_px: Float, ideal_px: Float, patches: Patches, slopes: Float, crops: Image, pose: Float
) -> Tracks:
    """Tracks that begin at a keyframe with the given pose in the chain; without points yet."""
    n = len(ids)
    return Tracks(
        ids=ids,
        raw_px=raw_px,
        right_offset_px=np.zeros((n, 2)),
        points=np.full((n, 3), np.nan),
        points_covariance=np.full((n, 3, 3), np.nan),
        keyframe_px=ideal_px,
        patches=patches,
        patch_points=np.full((n, 3), np.nan),
        patch_poses=np.broadcast_to(pose, (n, 4, 4)).copy(),
        slopes=slopes,
        crops=crops,
        ages=np.ones(n, dtype=np.int64),
        strikes=np.zeros(n, dtype=np.int64),
    )


def no_tracks(grid: PatchGrid) -> Tracks:
    """No track at all, for patches of the given grid."""
    none = np.zeros((0, 2))
    ids = np.zeros(0, dtype=np.int64)
    crops = np.zeros((0, CROP_SIDE, CROP_SIDE), np.uint8)
    return new_tracks(ids, none, none, no_patches(grid), none, crops, np.eye(4))
