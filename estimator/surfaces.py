"""The Kinect's surfaces in the graph: landmarks of the mobile camera lie on planes that the Kinect measured."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import gtsam
import numpy as np
from numpy.typing import NDArray

from ..factors import keys
from ..factors.cloud import corrected, plane_factor
from ..factors.measurements import CloudFrame, Rejection
from ..factors.noise import robust, sigmas
from ..frontends.cloud.associate import associate
from ..frontends.cloud.noise import SMOOTH_RAD, SMOOTH_SHARE
from .graph import Record, State, Update

Float = NDArray[np.float64]

FAMILY = "depth cloud"
SAME_SIDE_COSINE = 0.1
"""Between a surface's normal and the mobile camera's view of it: beyond, the camera may see another face."""


@dataclass(frozen=True, slots=True)
class PlaneMatch:
    """A landmark on a surface that the Kinect saw, in {b}, as measured (depth states not applied)."""

    landmark: int
    """Row in the landmarks that were asked about."""
    point_m: Float
    normal: Float
    sigma_m: float


class Associator(Protocol):
    """Finds the surface patches of landmarks; lives in the front ends, because it searches clouds."""

    def __call__(
        self, landmarks_m: Float, sigma_m: Float, cloud: CloudFrame
    ) -> tuple[list[PlaneMatch], list[tuple[int, str, float, float]]]:
        """Matches, and refusals as (row, reason, value, limit)."""
        ...


@dataclass(frozen=True, slots=True)
class SurfaceSettings:
    minimum_views: int = 3
    """A landmark seen in fewer keyframes is not yet well enough known to be laid on a surface."""
    most: int = 250
    """Landmarks on surfaces per station: more would not tell more about six degrees of freedom."""
    landmark_sigma_px: float = 0.3
    retry_keyframes: int = 10


class Surfaces:
    """Lays landmarks on the Kinect's cloud of the present station."""

    def __init__(self, state: State, settings: SurfaceSettings, robust_sigma: float, associate: Associator) -> None:
        self._state = state
        self._settings = settings
        self._robust_sigma = robust_sigma
        self._associate = associate
        self.loose: Callable[[int], bool] = lambda key: False
        """Is it unknown where a landmark is?"""
        self.cloud: CloudFrame | None = None
        self._tried: dict[int, int] = {}
        self._laid: set[int] = set()
        self._shared: dict[tuple[int, int], int] = {}
        """Landmarks laid so far by the part of the view whose smooth distortion they share."""
        self.refused: dict[int, Rejection] = {}

    def see(self, cloud: CloudFrame) -> None:
        """The newest cloud of a machine that stands still replaces the last one."""
        self.cloud = cloud

    def restart(self) -> None:
        """The machine stands elsewhere: its old cloud is of no use, and every landmark may be laid again."""
        self.cloud = None
        self._tried.clear()
        self._laid.clear()
        self._shared.clear()

    def retry(self) -> None:
        """{b} has moved: landmarks that lay on no surface are due again."""
        self._tried.clear()

    def lay(self, base: int, camera: gtsam.Pose3, observations: dict[int, int]) -> Update:
        """Plane factors for landmarks that were not laid yet.

        Args:
            base: key of `o_T_b`.
            camera: `o_T_m` now; a stereo point's uncertainty grows with its distance from where it was seen.
            observations: keyframes per landmark.
        """
        update = Update()
        if self.cloud is None or len(self._laid) >= self._settings.most:
            return update
        rows = self._candidates(observations)
        if not rows:
            return update
        o_T_b = self._state.pose(base)
        points = np.array([o_T_b.transformTo(self._state.point(keys.landmark(t))) for t in rows])
        sigma = self._spread(rows, camera, observations)
        offset, scale = self._state.vector(keys.DEPTH)
        measured = corrected(points, -offset, -scale, -self._state.vector(keys.DEPTH_RAYS))
        matches, refusals = self._associate(measured, sigma, self.cloud)
        seen_from = o_T_b.transformTo(camera.translation())
        matches, behind = _same_side(matches, seen_from)
        refusals = [*refusals, *behind]
        for match in matches[: self._settings.most - len(self._laid)]:
            self._lay_one(update, rows[match.landmark], match, base)
        for row, reason, value, limit in refusals:
            what = f"landmark {rows[row]}"
            self.refused[rows[row]] = Rejection(self.cloud.stamp_ns, FAMILY, what, reason, value, limit)
        return update

    def forget(self, landmarks: set[int]) -> None:
        """These have left the graph; what they said about the surfaces stays there."""
        self._laid -= landmarks
        self._tried = {t: n for t, n in self._tried.items() if t not in landmarks}
        self.refused = {t: r for t, r in self.refused.items() if t not in landmarks}

    def laid(self) -> tuple[set[int], dict[tuple[int, int], int]]:
        """Landmarks that lie on this station's surfaces, and how many share the distortion of a part of the view."""
        return set(self._laid), dict(self._shared)

    def recall(self, laid: set[int], shared: dict[tuple[int, int], int]) -> None:
        """What an earlier run has laid at this station is not laid again: it was the same error of the same camera."""
        self._laid, self._shared = laid, shared

    def _candidates(self, observations: dict[int, int]) -> list[int]:
        rows = []
        for track, count in observations.items():
            due = self._tried.get(track, 0)
            if track in self._laid or count < max(self._settings.minimum_views, due):
                continue
            if self._state.has(keys.landmark(track)) and not self.loose(keys.landmark(track)):
                self._tried[track] = count + self._settings.retry_keyframes
                rows.append(track)
        return rows

    def _spread(self, rows: list[int], camera: gtsam.Pose3, observations: dict[int, int]) -> Float:
        """Rough sigma of the landmarks along the line of sight, for the search radius only, not for the factor."""
        focal = self._state.intrinsics(keys.intrinsics("m_left")).fx()
        baseline = float(np.linalg.norm(self._state.pose(keys.extrinsics("m_right")).translation()))
        points = np.array([self._state.point(keys.landmark(t)) for t in rows])
        distance = np.linalg.norm(points - camera.translation(), axis=1)
        views = np.sqrt([observations[t] for t in rows])
        return distance**2 * self._settings.landmark_sigma_px / (focal * baseline) / views + 0.005

    def _lay_one(self, update: Update, track: int, match: PlaneMatch, base: int) -> None:
        assert self.cloud is not None
        model = robust(sigmas([self._sigma(match)]), self._robust_sigma)
        factor = plane_factor(base, keys.landmark(track), match.point_m, match.normal, model)
        what = f"landmark {track} on the Kinect's surface"
        update.add(factor, Record(FAMILY, "landmarks on surfaces", self.cloud.stamp_ns, what))
        self._laid.add(track)
        self.refused.pop(track, None)

    def _sigma(self, match: PlaneMatch) -> float:
        """Of one landmark's distance from its plane. Those before it share the depth camera's smooth distortion.

        The n-th of a part of the view takes n times that error: all together say no more than 1.3 times as exactly
        where the part is than the error itself allows, however many they are.
        """
        x, y, z = match.point_m
        cell = (int(np.floor(x / z / np.tan(SMOOTH_RAD))), int(np.floor(y / z / np.tan(SMOOTH_RAD))))
        self._shared[cell] = self._shared.get(cell, 0) + 1
        shared = SMOOTH_SHARE * abs(float(match.normal @ match.point_m))
        return float(np.hypot(match.sigma_m, np.sqrt(self._shared[cell]) * shared))


def _same_side(
    matches: list[PlaneMatch], seen_from: Float
) -> tuple[list[PlaneMatch], list[tuple[int, str, float, float]]]:
    """Only what the mobile camera sees from the Kinect's side: the back of a thin panel is another surface.

    Args:
        seen_from: the mobile camera in {b}, shape (3,).
    """
    good: list[PlaneMatch] = []
    refused: list[tuple[int, str, float, float]] = []
    for match in matches:
        ray = seen_from - match.point_m
        cosine = float(match.normal @ ray / np.linalg.norm(ray))
        if cosine > SAME_SIDE_COSINE:
            good.append(match)
        else:
            refused.append((match.landmark, "seen from the other side; cosine", cosine, SAME_SIDE_COSINE))
    return good, refused


def lay_on_surfaces(
    landmarks_m: Float, sigma_m: Float, cloud: CloudFrame
) -> tuple[list[PlaneMatch], list[tuple[int, str, float, float]]]:
    """The front end's search, in the engine's types. Noise and quantisation of a patch both count."""
    found = associate(landmarks_m, sigma_m, cloud)
    sigma = np.hypot(found.sigma_m, found.bias_m)
    matches = [
        PlaneMatch(int(row), point, normal, float(s))
        for row, point, normal, s in zip(found.landmark, found.point_m, found.normal, sigma, strict=True)
    ]
    refusals = [(i, reason, float(found.values[i]), 0.0) for i, reason in enumerate(found.reasons) if reason]
    return matches, refusals
