"""Finding the way back after total loss: keyframes that are remembered by a thumbnail and ORB features.

The thumbnail (Klein and Murray, Improving the agility of keyframe-based SLAM, 2008) picks a few keyframes, ORB
matches with P3P consensus decide. Descriptors are computed when somebody is lost, not before.
"""

from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from ..undistort import undistort
from .geometry import Float, StereoGeometry
from .images import Float32, Image
from .motion import estimate_motion
from .tracks import Int

_TRIED = 8
ALIKE = 0.8
"""Correlation of thumbnails from which on a place is worth a look while nobody is lost."""
_THUMBNAIL = (40, 30)


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
        self._orb = cv2.ORB.create(nfeatures=700, fastThreshold=8, edgeThreshold=18, patchSize=25)

    def __len__(self) -> int:
        return len(self._places)

    def chain_pose(self, stamp_ns: int) -> Float:
        """`chain_T_keyframe` of the place with that stamp."""
        return next(place.chain_T_keyframe for place in self._places if place.stamp_ns == stamp_ns)

    def add(self, stamp_ns: int, pose: Float, left: Image, ids: Int, raw_px: Float, points: Float) -> None:
        """Remembers a keyframe unless a better one with about the same view is there."""
        known = np.isfinite(points).all(axis=1)
        if known.sum() < 25:
            return
        place = Place(stamp_ns, pose.copy(), left, _thumbnail(left), ids[known], raw_px[known], points[known])
        near = self._same_view(pose, 0.1 * float(np.median(points[known, 2])))
        if near is not None:
            if len(self._places[near].ids) < 0.7 * len(place.ids):
                self._places[near] = place
            return
        self._places.append(place)
        if len(self._places) > self._capacity:
            del self._places[min(range(len(self._places) - 1), key=lambda index: len(self._places[index].ids))]

    def _same_view(self, pose: Float, distance_m: float) -> int | None:
        """The first place within a distance and nine degrees of a pose."""
        if not self._places:
            return None
        poses = np.array([place.chain_T_keyframe for place in self._places])
        apart = np.linalg.norm(poses[:, :3, 3] - pose[:3, 3], axis=1)
        cosine = (np.einsum("nij,ij->n", poses[:, :3, :3], pose[:3, :3]) - 1.0) / 2.0
        near = np.flatnonzero((apart < distance_m) & (cosine > np.cos(0.15)))
        return int(near[0]) if len(near) else None

    def find(self, left: Image, min_inliers: int) -> list[Relocalisation]:
        """Places that the left image shows, the one with most inliers first."""
        if not self._places:
            return []
        picture = _thumbnail(left).ravel()
        likeness = np.array([float(place.thumbnail.ravel() @ picture) for place in self._places])
        keypoints, descriptors = self._orb.detectAndCompute(left, None)
        if descriptors is None or len(keypoints) < min_inliers:
            return []
        raw = np.array([point.pt for point in keypoints], dtype=np.float64)
        found = []
        for index in np.argsort(-likeness, kind="stable")[:_TRIED]:
            match = self._verify(self._places[int(index)], raw, np.asarray(descriptors, np.uint8), min_inliers)
            if match is not None:
                found.append(match)
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
        keypoints, descriptors = self._orb.detectAndCompute(left, None)
        if descriptors is None or len(keypoints) < min_inliers:
            return None
        raw = np.array([point.pt for point in keypoints], dtype=np.float64)
        return self._verify(old[best], raw, np.asarray(descriptors, np.uint8), min_inliers)

    def _describe(self, place: Place) -> tuple[Image, NDArray[np.intp]]:
        """Descriptors at the place's landmarks; those too near the rim have none."""
        if place.descriptors is None or place.described is None:
            keypoints = []
            for index, (u, v) in enumerate(place.raw_px.tolist()):
                angle = _angle(place.left, u, v)
                keypoints.append(cv2.KeyPoint(u, v, 25.0, angle, 1.0, 0, index))
            kept, descriptors = self._orb.compute(place.left, keypoints)
            place.descriptors = (
                np.zeros((0, 32), np.uint8) if descriptors is None else np.asarray(descriptors, np.uint8)
            )
            place.described = np.array([point.class_id for point in kept], dtype=np.intp)
        return place.descriptors, place.described

    def _verify(self, place: Place, raw: Float, descriptors: Image, min_inliers: int) -> Relocalisation | None:
        theirs, described = self._describe(place)
        if len(theirs) < min_inliers:
            return None
        pairs = cv2.BFMatcher(cv2.NORM_HAMMING).knnMatch(theirs, descriptors, k=2)
        good = [(p[0].queryIdx, p[0].trainIdx) for p in pairs if len(p) == 2 and p[0].distance < 0.8 * p[1].distance]
        if len(good) < min_inliers:
            return None
        rows = described[[a for a, _ in good]]
        here = undistort(self._rig.left, raw[[b for _, b in good]])[0]
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


def _thumbnail(image: Image) -> Float32:
    small = cv2.resize(image, _THUMBNAIL, interpolation=cv2.INTER_AREA)
    small = np.asarray(cv2.GaussianBlur(small, (0, 0), 1.0), np.float32)
    small = small - small.mean()
    return small / max(float(np.linalg.norm(small)), 1e-6)


def _angle(image: Image, u: float, v: float, radius: int = 12) -> float:
    """Direction of the intensity centroid in degrees (Rublee et al. 2011), as ORB's own detector sets it."""
    x, y = round(u), round(v)
    window = image[max(y - radius, 0) : y + radius + 1, max(x - radius, 0) : x + radius + 1].astype(np.float64)
    rows, columns = np.mgrid[: window.shape[0], : window.shape[1]]
    dx, dy = columns - (x - max(x - radius, 0)), rows - (y - max(y - radius, 0))
    round_window = dx**2 + dy**2 <= radius**2
    moment = (float((window * dx)[round_window].sum()), float((window * dy)[round_window].sum()))
    return float(np.degrees(np.arctan2(moment[1], moment[0])) % 360.0)
