"""Finding the way back after total loss: keyframes that are remembered by a thumbnail and ORB features.

The thumbnail (Klein and Murray, Improving the agility of keyframe-based SLAM, 2008) picks a few keyframes, ORB
matches with P3P consensus decide. Descriptors are computed when somebody is lost, not before.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from ..undistort import undistort
from .atlas import AtlasPlace, View
from .detection import detect
from .geometry import Float, StereoGeometry
from .images import Float32, Image
from .motion import estimate_motion
from .tracks import Int

_TRIED = 8
_CERTAIN = 2
"""So many times the inliers that are needed end the search."""
_CORNERS = 400
_SPACING_PX = 5.0
"""Between corners at 360x240."""
_RIM_PX = 18
_RIVALS = 4
_SAME_PX = 4.0
"""Features nearer to each other are one."""
_CLEAR = 0.8
"""Of the distance to the next best descriptor (Lowe 2004)."""
ALIKE = 0.8
"""Correlation of thumbnails from which on a place is worth a look while nobody is lost."""
THUMBNAIL = (40, 30)
"""Width and height."""
BEFORE_ALL_NS = -(1 << 61)
"""Places of an earlier run have stamps before this one."""


@dataclass(frozen=True, slots=True)
class Relocalisation:
    """A keyframe that shows the same place as the present pair."""

    stamp_ns: int
    """Of the keyframe."""
    keyframe_T_this: Float
    """Shape (4, 4), pose of this left camera in the keyframe's."""
    inliers: int
    track_ids: Int
    """Shape (n,), tracks of the keyframe that were found again."""
    left_px: Float
    """Shape (n, 2), where, to about a pixel: ideal left pixels for a start of a finer search."""


@dataclass(slots=True)
class Place:
    """A remembered keyframe."""

    stamp_ns: int
    chain_T_keyframe: Float
    left: Image
    thumbnail: Float32
    ids: Int
    raw_px: Float
    points: Float
    descriptors: Image | None = field(default=None)
    described: NDArray[np.intp] | None = field(default=None)


class PlaceStore:
    """Remembered keyframes, thinned to one per region of views."""

    def __init__(self, capacity: int, rig: StereoGeometry) -> None:
        self._capacity = capacity
        self._rig = rig
        self._places: list[Place] = []
        self._orb = _orb()

    def __len__(self) -> int:
        return len(self._places)

    def chain_pose(self, stamp_ns: int) -> Float:
        """`chain_T_keyframe` of the place with that stamp."""
        return next(place.chain_T_keyframe for place in self._places if place.stamp_ns == stamp_ns)

    def recall(self, places: Sequence[AtlasPlace]) -> None:
        """Views of an earlier run, older than any of this one."""
        for k, seen in enumerate(places):
            nowhere, every = np.full((len(seen.ids), 2), np.nan), np.arange(len(seen.ids), dtype=np.intp)
            stamp_ns, left = BEFORE_ALL_NS - len(places) + k, np.zeros((0, 0), np.uint8)
            place = Place(stamp_ns, seen.chain_T_keyframe, left, seen.thumbnail, seen.ids, nowhere, seen.points)
            place.descriptors, place.described = seen.descriptors, every
            self._places.append(place)

    def move(self, new_T_old: Float) -> None:
        """Takes the places of this run to another chain."""
        for place in self._places:
            if place.stamp_ns >= BEFORE_ALL_NS:
                place.chain_T_keyframe = new_T_old @ place.chain_T_keyframe

    def add(self, stamp_ns: int, pose: Float, left: Image, ids: Int, raw_px: Float, points: Float) -> View | None:
        """Remembers a keyframe unless a better one with about the same view is there; what was remembered."""
        known = np.isfinite(points).all(axis=1)
        if known.sum() < 25:
            return None
        view = View(pose.copy(), left, ids[known], raw_px[known], points[known])
        place = Place(stamp_ns, pose.copy(), left, _thumbnail(left), ids[known], raw_px[known], points[known])
        near = self._same_view(pose, 0.1 * float(np.median(points[known, 2])))
        if near is not None:
            if len(self._places[near].ids) >= 0.7 * len(place.ids):
                return None
            self._places[near] = place
            return view
        self._places.append(place)
        if len(self._places) > self._capacity:
            del self._places[min(range(len(self._places) - 1), key=lambda index: len(self._places[index].ids))]
        return view

    def _same_view(self, pose: Float, distance_m: float) -> int | None:
        """The first place within a distance and nine degrees of a pose."""
        if not self._places:
            return None
        poses = np.array([place.chain_T_keyframe for place in self._places])
        apart = np.linalg.norm(poses[:, :3, 3] - pose[:3, 3], axis=1)
        cosine = (np.einsum("nij,ij->n", poses[:, :3, :3], pose[:3, :3]) - 1.0) / 2.0
        near = np.flatnonzero((apart < distance_m) & (cosine > np.cos(0.15)))
        return int(near[0]) if len(near) else None

    def find(self, left: Image, min_inliers: int, before_ns: int | None = None) -> list[Relocalisation]:
        """Places, or those of before, that the left image shows, the one with most inliers first."""
        places = [place for place in self._places if before_ns is None or place.stamp_ns < before_ns]
        if not places:
            return []
        picture = _thumbnail(left).ravel()
        likeness = np.array([float(place.thumbnail.ravel() @ picture) for place in places])
        raw, descriptors = self._features(left)
        found = []
        for index in np.argsort(-likeness, kind="stable")[:_TRIED]:
            match = self._verify(places[int(index)], raw, descriptors, min_inliers)
            if match is not None:
                found.append(match)
            if match is not None and match.inliers >= _CERTAIN * min_inliers:
                break
        return sorted(found, key=lambda match: -match.inliers)

    def look_back(self, left: Image, before_ns: int, min_inliers: int, alike: float = ALIKE) -> Relocalisation | None:
        """The one place of before that looks most like the left image, if it does and the features agree.

        Cheap where nothing looks alike: only thumbnails are compared then.
        """
        old = [place for place in self._places if place.stamp_ns < before_ns]
        if not old:
            return None
        picture = _thumbnail(left).ravel()
        likeness = np.array([float(place.thumbnail.ravel() @ picture) for place in old])
        best = int(np.argmax(likeness))
        if likeness[best] < alike:
            return None
        return self._verify(old[best], *self._features(left), min_inliers)

    def _features(self, left: Image) -> tuple[Float, Image]:
        """Raw pixels (n, 2) and descriptors (n, 32) of corners like those of the tracks, and of ORB's own for views
        from nearer or farther."""
        spacing = _SPACING_PX * float(np.hypot(*left.shape)) / 432.7
        corners = detect(left, np.zeros((0, 2)), _CORNERS, spacing, _RIM_PX, 1.0)
        own, rows = _described(self._orb, left, corners)
        keypoints, descriptors = self._orb.detectAndCompute(left, None)
        if descriptors is None or len(keypoints) == 0:
            return corners[rows], own
        raw = np.array([point.pt for point in keypoints], dtype=np.float64)
        return np.concatenate((corners[rows], raw)), np.concatenate((own, np.asarray(descriptors, np.uint8)))

    def _describe(self, place: Place) -> tuple[Image, NDArray[np.intp]]:
        """Descriptors at the place's landmarks; those too near the rim have none."""
        if place.descriptors is None or place.described is None:
            place.descriptors, place.described = _described(self._orb, place.left, place.raw_px)
        return place.descriptors, place.described

    def _verify(self, place: Place, raw: Float, descriptors: Image, min_inliers: int) -> Relocalisation | None:
        theirs, described = self._describe(place)
        if len(theirs) < min_inliers:
            return None
        theirs_rows, ours = _matches(theirs, raw, descriptors)
        if len(ours) < min_inliers:
            return None
        rows = described[theirs_rows]
        here = undistort(self._rig.left, raw[ours])[0]
        ok = np.isfinite(here).all(axis=1)
        return self._consensus(place, rows[ok], here[ok], min_inliers)

    def _consensus(self, place: Place, rows: NDArray[np.intp], px: Float, min_inliers: int) -> Relocalisation | None:
        n = len(rows)
        points = place.points[rows]
        # About a pixel and a half of matching error on either side.
        lateral = (1.5 * points[:, 2] / self._rig.left.fx) ** 2
        covariance = lateral[:, None, None] * np.eye(3)
        both = np.hstack((px, np.full((n, 2), np.nan)))
        pixels = np.broadcast_to(1.5**2 * np.eye(4), (n, 4, 4))
        motion = estimate_motion(points, covariance, both, pixels, [np.eye(4)], self._rig, min_inliers)
        if motion is None or motion.inliers.mean() < 0.25:
            return None
        return Relocalisation(
            place.stamp_ns,
            motion.reference_T_this,
            int(motion.inliers.sum()),
            place.ids[rows[motion.inliers]],
            px[motion.inliers],
        )


def place_of(view: View) -> AtlasPlace:
    """A view as it can be recognised without its picture."""
    descriptors, rows = _described(_orb(), view.left, view.raw_px)
    return AtlasPlace(view.chain_T_keyframe, _thumbnail(view.left), view.ids[rows], view.points[rows], descriptors)


def _orb() -> cv2.ORB:
    return cv2.ORB.create(nfeatures=700, fastThreshold=8, edgeThreshold=18, patchSize=25)


def _described(orb: cv2.ORB, left: Image, raw_px: Float) -> tuple[Image, NDArray[np.intp]]:
    """Descriptors (n, 32) at given pixels, and whose they are; those too near the rim have none."""
    angles = _angles(left, raw_px).tolist()
    keypoints = [
        cv2.KeyPoint(u, v, 25.0, angle, 1.0, 0, index)
        for index, ((u, v), angle) in enumerate(zip(raw_px.tolist(), angles, strict=True))
    ]
    kept, descriptors = orb.compute(left, keypoints)
    found = np.zeros((0, 32), np.uint8) if descriptors is None else np.asarray(descriptors, np.uint8)
    return found, np.array([point.class_id for point in kept], dtype=np.intp)


def _matches(theirs: Image, raw: Float, descriptors: Image) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rows of descriptors that are nearest to each other, and nearer than to any of another place in the image."""
    if len(descriptors) <= _RIVALS:
        return np.zeros(0, np.intp), np.zeros(0, np.intp)
    found = cv2.batchDistance(theirs, descriptors, cv2.CV_32S, normType=cv2.NORM_HAMMING, K=_RIVALS)
    distance, index = np.asarray(found[0], np.int64), np.asarray(found[1], np.intp)
    elsewhere = np.linalg.norm(raw[index[:, 1:]] - raw[index[:, :1]], axis=2) > _SAME_PX
    rival = np.where(elsewhere, distance[:, 1:], np.iinfo(np.int64).max).min(axis=1)
    good = distance[:, 0] < _CLEAR * rival
    return np.flatnonzero(good), index[good, 0]


def _thumbnail(image: Image) -> Float32:
    small = cv2.resize(image, THUMBNAIL, interpolation=cv2.INTER_AREA)
    small = np.asarray(cv2.GaussianBlur(small, (0, 0), 1.0), np.float32)
    small = small - small.mean()
    return small / max(float(np.linalg.norm(small)), 1e-6)


def _angles(image: Image, raw_px: Float, radius: int = 12) -> Float:
    """Directions (n,) of the intensity centroids in degrees (Rublee et al. 2011), as ORB's own detector sets them."""
    if len(raw_px) == 0:
        return np.zeros(0)
    padded = np.pad(image, radius)
    rows, columns = np.mgrid[-radius : radius + 1, -radius : radius + 1]
    within = rows**2 + columns**2 <= radius**2
    dx, dy = columns[within], rows[within]
    x, y = np.rint(raw_px).astype(np.intp).T
    x, y = np.clip(x, 0, image.shape[1] - 1) + radius, np.clip(y, 0, image.shape[0] - 1) + radius
    values = padded[y[:, None] + dy, x[:, None] + dx].astype(np.float64)
    return np.asarray(np.degrees(np.arctan2(values @ dy, values @ dx)) % 360.0, dtype=np.float64)
