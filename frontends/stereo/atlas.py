"""What a front end may find its way by in a later run: views with descriptors, and landmarks with their patches."""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields

import numpy as np
from numpy.typing import NDArray

from .images import Float32, Image
from .tracks import CROP_SIDE, Float, Int, Tracks

SETTLED = 2
"""Keyframes that have to see a track before it is remembered: as many as make a landmark of the map."""


@dataclass(frozen=True, slots=True)
class AtlasTracks:
    """n landmarks out of sight, in the chain of the front end that saw them."""

    ids: Int
    """Shape (n,)."""
    points: Float
    """Shape (n, 3)."""
    patch_points: Float
    """Shape (n, 3), in the camera of the reference patch."""
    patch_poses: Float
    """Shape (n, 4, 4), of that camera."""
    slopes: Float
    """Shape (n, 2), see `Tracks`."""
    crops: Image
    """Shape (n, s, s)."""
    views: Int
    """Shape (n,), number of keyframes that saw each."""

    def __len__(self) -> int:
        return len(self.ids)

    def take(self, rows: Sequence[int] | NDArray[np.intp]) -> "AtlasTracks":
        """Copies of some rows."""
        return AtlasTracks(*(getattr(self, name)[np.asarray(rows, np.intp)] for name in _ARRAYS))


_ARRAYS = tuple(f.name for f in fields(AtlasTracks))


@dataclass(frozen=True, slots=True)
class AtlasPlace:
    """A view that can be recognised."""

    chain_T_keyframe: Float
    """Shape (4, 4)."""
    thumbnail: Float32
    ids: Int
    """Shape (n,)."""
    points: Float
    """Shape (n, 3), in its left camera."""
    descriptors: Image
    """Shape (n, 32), ORB."""


@dataclass(frozen=True, slots=True)
class Atlas:
    """Places and landmarks."""

    places: tuple[AtlasPlace, ...] = ()
    tracks: AtlasTracks = field(default_factory=lambda: no_atlas_tracks())

    def __bool__(self) -> bool:
        return bool(self.places) or len(self.tracks) > 0

    def next_id(self) -> int:
        """The first track id that is not used up."""
        ids = [self.tracks.ids, *(place.ids for place in self.places)]
        return max((int(i.max()) + 1 for i in ids if len(i)), default=0)


@dataclass(frozen=True, slots=True)
class View:
    """A keyframe's left image, to be described where nobody waits."""

    chain_T_keyframe: Float
    left: Image
    ids: Int
    raw_px: Float
    """Shape (n, 2)."""
    points: Float
    """Shape (n, 3), in its left camera."""


@dataclass(frozen=True, slots=True)
class Memorable:
    """What one keyframe adds to what can be found again."""

    tracks: AtlasTracks
    view: View | None


def settled_tracks(tracks: Tracks, chain_T_keyframe: Float) -> AtlasTracks:
    """Those that have just been seen often enough to be landmarks; what is kept of them does not change any more."""
    good = (tracks.ages == SETTLED) & np.isfinite(tracks.points).all(axis=1)
    good &= np.isfinite(tracks.patch_points).all(axis=1)
    points = tracks.points[good] @ chain_T_keyframe[:3, :3].T + chain_T_keyframe[:3, 3]
    return AtlasTracks(
        tracks.ids[good],
        points,
        tracks.patch_points[good],
        tracks.patch_poses[good],
        tracks.slopes[good],
        tracks.crops[good],
        tracks.ages[good],
    )


def no_atlas_tracks() -> AtlasTracks:
    """No landmark."""
    none = np.zeros((0, 3))
    crops = np.zeros((0, CROP_SIDE, CROP_SIDE), np.uint8)
    ids = np.zeros(0, np.int64)
    return AtlasTracks(ids, none, none, np.zeros((0, 4, 4)), np.zeros((0, 2)), crops, ids)


def joined(parts: Sequence[AtlasTracks]) -> AtlasTracks:
    """All of several, in their order."""
    if not parts:
        return no_atlas_tracks()
    return AtlasTracks(*(np.concatenate([getattr(part, name) for part in parts]) for name in _ARRAYS))
