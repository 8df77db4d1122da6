"""Places and landmarks of an earlier run in its checkpoint: arrays as base64, each checked as it is read."""

import base64
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...frontends.stereo.atlas import Atlas, AtlasPlace, AtlasTracks
from ...frontends.stereo.places import THUMBNAIL
from ...frontends.stereo.tracks import CROP_SIDE

MOST_ROWS, MOST_PLACES = 10_000, 1000
LARGEST_ID = 1 << 48
LARGEST_M = 1e7


def to_data(atlas: Atlas) -> dict[str, Any]:
    """As JSON has it."""
    t = atlas.tracks
    tracks = {
        "ids": packed(t.ids, "<i8"), "points": packed(t.points, "<f8"), "patch_points": packed(t.patch_points, "<f8"),
        "patch_poses": packed(t.patch_poses, "<f8"), "slopes": packed(t.slopes, "<f8"), "crops": packed(t.crops, "<u1"),
        "views": packed(t.views, "<i8"),
    }  # fmt: skip
    places = [
        {
            "pose": packed(p.chain_T_keyframe, "<f8"), "thumbnail": packed(p.thumbnail, "<f4"),
            "ids": packed(p.ids, "<i8"), "points": packed(p.points, "<f8"), "descriptors": packed(p.descriptors, "<u1"),
        }
        for p in atlas.places
    ]  # fmt: skip
    return {"tracks": tracks, "places": places}


def from_data(data: Mapping[str, Any]) -> Atlas:
    """
    Raises:
        ValueError, KeyError, TypeError: it is none.
    """
    given = data["tracks"]
    ids = _ids(given["ids"])
    n = len(ids)
    tracks = AtlasTracks(
        ids=ids,
        points=_metres(given["points"], (n, 3)),
        patch_points=_ahead(_metres(given["patch_points"], (n, 3))),
        patch_poses=_poses(given["patch_poses"], n),
        slopes=_floats(given["slopes"], (n, 2)),
        crops=unpacked(given["crops"], "<u1", (n, CROP_SIDE, CROP_SIDE)),
        views=np.clip(unpacked(given["views"], "<i8", (n,)), 0, 1 << 30),
    )
    if len(data["places"]) > MOST_PLACES:
        raise ValueError(f"more than {MOST_PLACES} places")
    return Atlas(tuple(_place(place) for place in data["places"]), tracks)


def _place(data: Mapping[str, Any]) -> AtlasPlace:
    ids = _ids(data["ids"])
    thumbnail = unpacked(data["thumbnail"], "<f4", THUMBNAIL[::-1])
    if not np.isfinite(thumbnail).all():
        raise ValueError("numbers that are not finite")
    return AtlasPlace(
        _poses(data["pose"], 1)[0],
        thumbnail,
        ids,
        _ahead(_metres(data["points"], (len(ids), 3))),
        unpacked(data["descriptors"], "<u1", (len(ids), 32)),
    )


def _ids(text: str) -> NDArray[np.int64]:
    ids = unpacked(text, "<i8", (-1,))
    if len(ids) > MOST_ROWS or len(np.unique(ids)) < len(ids) or ((ids < 0) | (ids > LARGEST_ID)).any():
        raise ValueError("track ids that cannot be")
    return ids


def _floats(text: str, shape: tuple[int, ...]) -> NDArray[np.float64]:
    found = unpacked(text, "<f8", shape)
    if not np.isfinite(found).all():
        raise ValueError("numbers that are not finite")
    return found


def _metres(text: str, shape: tuple[int, ...]) -> NDArray[np.float64]:
    found = _floats(text, shape)
    if (np.abs(found) > LARGEST_M).any():
        raise ValueError("places that cannot be")
    return found


def _ahead(points: NDArray[np.float64]) -> NDArray[np.float64]:
    if (points[:, 2] <= 0).any():
        raise ValueError("points behind the camera that saw them")
    return points


def _poses(text: str, n: int) -> NDArray[np.float64]:
    poses = _metres(text, (n, 4, 4))
    rotations = poses[:, :3, :3]
    off = np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)).max(initial=0.0)
    if off > 1e-3 or (np.linalg.det(rotations) < 0).any() or (poses[:, 3] != (0, 0, 0, 1)).any():
        raise ValueError("matrices that are no poses")
    return poses


def packed(array: NDArray[Any], kind: str) -> str:
    """An array's numbers as text."""
    return base64.b64encode(np.ascontiguousarray(array, kind).tobytes()).decode()


def unpacked(text: str, kind: str, shape: tuple[int, ...]) -> NDArray[Any]:
    """An array of its own from text.

    Raises:
        ValueError: it is no such array.
    """
    found = np.frombuffer(base64.b64decode(text, validate=True), kind).reshape(shape)
    return found.astype(found.dtype.newbyteorder("="))
