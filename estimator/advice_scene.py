"""What a further view would have to work with: the map's landmarks, the noise of this run, what hides what."""

from collections import defaultdict
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray

from ..factors import keys
from ..factors.cloud import corrected, depth_states
from .engine import Engine
from .graph import Record
from .odometry import FAMILY as ODOMETRY
from .pipes import WIDE_RADIUS_M

Float = NDArray[np.float64]
Active = list[tuple[int, gtsam.NonlinearFactor, Record]]

SAME_SIDE = np.cos(np.radians(45.0))
"""A landmark is known again from directions within 45 degrees of those that it was seen from."""
REACH = 1.3
"""... and from not more than so many times the distance."""
NEAREST_M = 0.3
MARGIN_PX = 6.0
TIED_BY = 16
"""Landmarks that stand for all that a new keyframe would see; they carry the weight of the usual number."""
TIED_BY_AT_LEAST = 6
CLEAR_OF_SIGHT_M = 0.03
"""A mapped point nearer to the line of sight than this hides what is behind it."""

TYPICAL = 500
"""Measurements of a kind whose sigmas tell what is typical."""


@dataclass(frozen=True, slots=True)
class View:
    """A keyframe that is not there yet, or one that is."""

    key: int
    o_T_m: gtsam.Pose3
    landmarks: tuple[int, ...] = ()
    """Keys of the landmarks that hold it in the map; empty for a keyframe that is there."""
    share: float = 1.0
    """Landmarks that a keyframe of this run sees, over those."""


class Surroundings:
    """The map of one solved run, for planning."""

    def __init__(self, engine: Engine, values: gtsam.Values, active: Active) -> None:
        self.engine = engine
        self.values = values
        self._noise = _typical_sigmas(active)
        observers: dict[int, list[int]] = defaultdict(list)
        count: dict[int, int] = defaultdict(int)
        for _, factor, record in active:
            if record.family == ODOMETRY and record.camera == "m_left":
                pose, point = factor.keys()[:2]
                observers[point].append(pose)
                count[pose] += 1
        self.usual_landmarks = float(np.median(list(count.values()))) if count else 0.0
        self.seen_in: dict[int, set[int]] = {k: set(v) for k, v in observers.items()}
        self.keys = np.array(sorted(observers), dtype=np.uint64)
        self.points = np.array([values.atPoint3(int(k)) for k in self.keys]).reshape(-1, 3)
        self._from, self._reach = self._directions(observers)
        self._opaque = self._all_points()

    def _directions(self, observers: dict[int, list[int]]) -> tuple[Float, Float]:
        """Mean unit direction from each landmark to those who saw it, and the largest distance."""
        places = {k: self.values.atPose3(k).translation() for k in {p for v in observers.values() for p in v}}
        mean, reach = np.zeros((len(self.keys), 3)), np.zeros(len(self.keys))
        for i, key in enumerate(self.keys):
            rays = np.array([places[p] for p in observers[int(key)]]) - self.points[i]
            length = np.linalg.norm(rays, axis=1)
            mean[i] = (rays / length[:, None]).mean(0)
            reach[i] = length.max()
        norm = np.linalg.norm(mean, axis=1, keepdims=True)
        return mean / np.where(norm > 0, norm, 1.0), reach

    def _all_points(self) -> Float:
        """Everything mapped, in {o}: landmarks and the Kinect's surface."""
        cloud, base = self.engine.surfaces.cloud, self.engine.base
        if cloud is None or not self.values.exists(base) or not self.values.exists(keys.DEPTH):
            return self.points
        o_T_b = self.values.atPose3(base)
        b_p = corrected(cloud.points_m, *depth_states(self.values))
        return np.vstack([self.points, b_p @ o_T_b.rotation().matrix().T + o_T_b.translation()])

    def sigma(self, family: str, camera: str, default: float) -> float:
        """Median sigma of this run's measurements of a kind, px."""
        return self._noise.get((family, camera), default)

    def track_sigma(self, camera: str) -> float:
        return self.sigma(ODOMETRY, camera, self.sigma(ODOMETRY, "m_left", 0.25))

    # What a place would see -----------------------------------------------------------------------------------

    def pixels(self, camera: str, o_T_m: gtsam.Pose3, points: Float) -> tuple[Float, NDArray[np.bool_]]:
        """Pixels of points of {o}, shape (n, 2), and which of them are in the image."""
        o_T_c = self.camera_pose(camera, o_T_m)
        c_p = (points - o_T_c.translation()) @ o_T_c.rotation().matrix()
        model = self.engine.cameras[camera]
        front = c_p[:, 2] > 0.5 * NEAREST_M
        px = (c_p @ self.values.atCal3DS2(keys.intrinsics(camera)).K().T)[:, :2] / np.where(front, c_p[:, 2], 1)[
            :, None
        ]
        size = np.array([model.width, model.height])
        return px, front & ((px > MARGIN_PX) & (px < size - 1 - MARGIN_PX)).all(1)

    def camera_pose(self, camera: str, o_T_m: gtsam.Pose3) -> gtsam.Pose3:
        if camera == "m_left":
            return o_T_m
        return o_T_m.compose(self.values.atPose3(keys.extrinsics(camera)))

    def view(self, number: int, o_T_m: gtsam.Pose3, preferred: set[int]) -> View | None:
        """A new keyframe at a place, tied to the map; None where the map would not hold it.

        Args:
            number: of the new keyframe among all that are planned.
            preferred: landmarks that other plans use already; they are taken first, and new ones are added to them.
        """
        if len(self.keys) == 0:
            return None
        px, inside = self.pixels("m_left", o_T_m, self.points)
        rays = o_T_m.translation() - self.points
        length = np.linalg.norm(rays, axis=1)
        known = (rays * self._from).sum(1) > SAME_SIDE * length
        rows = np.flatnonzero(inside & known & (length < REACH * self._reach) & (length > NEAREST_M))
        if len(rows) < TIED_BY_AT_LEAST:
            return None
        chosen = _spread(px, rows, self.keys, preferred)
        preferred |= {int(self.keys[r]) for r in chosen}
        usual = min(self.usual_landmarks, float(len(rows)))
        key = keys.keyframe(self.engine.odometry.last_keyframe + 1 + number)
        return View(key, o_T_m, tuple(int(self.keys[r]) for r in chosen), max(usual / len(chosen), 1.0))

    def hidden(self, eye: Float, place: Float, radius_m: float) -> bool:
        """Whether something that is mapped stands between an eye and a place (of a thing of that radius)."""
        ray = place - eye
        length = float(np.linalg.norm(ray))
        along = (self._opaque - eye) @ (ray / length)
        across = np.linalg.norm(self._opaque - eye - np.outer(along, ray / length), axis=1)
        free = length - radius_m - 2 * CLEAR_OF_SIGHT_M
        return bool(((along > 0.1) & (along < free) & (across < CLEAR_OF_SIGHT_M)).any())

    def radius_of(self, pipe: str | None) -> float:
        """Radius of a pipe, or what pipes usually have."""
        cylinder = self.engine.pipes.cylinders.get(pipe or "")
        if cylinder is None or not cylinder.known or not self.values.exists(keys.radius(cylinder.index)):
            return WIDE_RADIUS_M[0]
        return float(self.values.atVector(keys.radius(cylinder.index))[0])


def look_at(eye: Float, target: Float, down: Float) -> gtsam.Pose3:
    """A camera at `eye` that looks at `target`, its y axis as far along `down` as that allows."""
    z = (target - eye) / np.linalg.norm(target - eye)
    x = np.cross(down, z)
    if np.linalg.norm(x) < 1e-3:
        x = np.cross([z[1], z[2], z[0]], z)
    x /= np.linalg.norm(x)
    return gtsam.Pose3(gtsam.Rot3(np.stack([x, np.cross(z, x), z], axis=1)), eye)


def _typical_sigmas(active: Active) -> dict[tuple[str, str], float]:
    """Median sigma by family and camera, of measurements that are pixels: of some of them, evenly spread."""
    members: dict[tuple[str, str], list[gtsam.NonlinearFactor]] = defaultdict(list)
    for _, factor, record in active:
        if record.camera is not None:
            members[record.family, record.camera].append(factor)
    found = {}
    for kind, factors in members.items():
        sigmas = [s for f in factors[:: -(-len(factors) // TYPICAL)] if (s := _pixel_sigma(f)) is not None]
        if sigmas:
            found[kind] = float(np.median(sigmas))
    return found


def _pixel_sigma(factor: gtsam.NonlinearFactor) -> float | None:
    """Sigma of a measurement of two coordinates; None for anything else."""
    if factor.dim() != 2 or isinstance(factor, gtsam.CustomFactor):
        return None
    model = factor.noiseModel()  # type: ignore[attr-defined]
    model = model.noise() if isinstance(model, gtsam.noiseModel.Robust) else model
    return float(np.sqrt(np.trace(model.covariance()) / 2)) if isinstance(model, gtsam.noiseModel.Gaussian) else None


def _spread(px: Float, rows: NDArray[np.int64], all_keys: NDArray[np.uint64], preferred: set[int]) -> list[int]:
    """At most TIED_BY rows over the whole image: round robin over the cells of a coarse grid, preferred ones first."""
    cell = 1 + np.ptp(px[rows], axis=0) / 4
    bins: dict[tuple[int, int], list[int]] = defaultdict(list)
    for row in sorted(rows, key=lambda r: int(all_keys[r]) not in preferred):
        u, v = (px[row] // cell).astype(int)
        bins[int(u), int(v)].append(int(row))
    chosen: list[int] = []
    while len(chosen) < min(TIED_BY, len(rows)):
        for members in bins.values():
            if members and len(chosen) < TIED_BY:
                chosen.append(members.pop(0))
    return chosen
