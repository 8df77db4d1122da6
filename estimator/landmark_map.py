"""The mobile camera's landmarks as a map that clouds can be laid on."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..factors import keys
from ..frontends.cloud.point_registration import MapPoints
from .engine import Engine

Float = NDArray[np.float64]

FEWEST_VIEWS = 3
LANDMARK_SIGMA_PX = 0.3
LEAST_SIGMA_M = 0.005


@dataclass(frozen=True, slots=True)
class LandmarkMap:
    """Landmarks and their keys."""

    keys: tuple[int, ...]
    points: MapPoints


def landmark_map(engine: Engine, fewest_views: int = FEWEST_VIEWS) -> LandmarkMap:
    """Landmarks with a known place in {o} that were seen often enough to be points: rough sigmas, seen from where."""
    state, odometry = engine.state, engine.odometry
    tracks = [
        t
        for t, n in odometry.observations.items()
        if n >= fewest_views
        and state.has(keys.landmark(t))
        and state.has(keys.keyframe(odometry.seen_in[t]))
        and not engine.adrift.holds(keys.landmark(t))
    ]
    if not tracks:
        none = np.zeros((0, 3))
        return LandmarkMap((), MapPoints(none, np.zeros(0), none))
    points = np.array([state.point(keys.landmark(t)) for t in tracks])
    eyes = np.array([state.pose(keys.keyframe(odometry.seen_in[t])).translation() for t in tracks])
    views = np.sqrt([odometry.observations[t] for t in tracks])
    focal = state.intrinsics(keys.intrinsics("m_left")).fx()
    baseline = float(np.linalg.norm(state.pose(keys.extrinsics("m_right")).translation()))
    distance = np.linalg.norm(points - eyes, axis=1)
    sigma = distance**2 * LANDMARK_SIGMA_PX / (focal * baseline) / views + LEAST_SIGMA_M
    return LandmarkMap(tuple(keys.landmark(t) for t in tracks), MapPoints(points, sigma, eyes))
