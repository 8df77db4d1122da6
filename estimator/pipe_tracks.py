"""Tracks on a named pipe: points that slide.

What looks like a corner on something round and smooth is where an outline, a flange's rim or a highlight cross. When
the view turns, they slide over the surface, all alike, and their residuals stay small because they are near, so that
the estimate follows them. The outline of a cylinder of radius r that is seen from a direction turned by an angle is
`r (1 - cos angle)` away from where a point of it would be: that much each view of such a track may be off.
"""

from collections import Counter, defaultdict
from dataclasses import dataclass
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from ..factors import keys
from ..factors.projection import reweighed
from .engine import Engine
from .odometry import FAMILY

Float = NDArray[np.float64]

REACH = 2.0
"""Radii from the axis within which something is the pipe, or a flange or collar on it."""


@dataclass(frozen=True, slots=True)
class _View:
    index: int
    """Place of its factor in the log."""
    factor: Any
    camera: str
    keyframe: int


def widen_pipe_tracks(engine: Engine) -> None:
    """Gives the views of landmarks on named pipes the variance of what slides.

    The tracks that one image sees on pipes err alike: errors in common do to a motion what independent ones of so many
    times the variance do.
    """
    near = _on_pipes(engine)
    views: dict[int, list[_View]] = defaultdict(list)
    for index, factor, record in engine.solver.log.active():
        if record.family == FAMILY and record.camera is not None:
            involved = factor.keys()  # the pose first
            if (landmark := keys.landmark_among(involved)) in near:
                views[landmark].append(_View(index, factor, record.camera, involved[0]))
    together = Counter((view.camera, view.keyframe) for seen in views.values() for view in seen)
    factors: dict[int, gtsam.NonlinearFactor] = {}
    for landmark, seen in views.items():
        rays = np.array([engine.state.point(landmark) - engine.state.pose(v.keyframe).translation() for v in seen])
        slide_m = near[landmark] * (1.0 - _least_cosine(rays))
        for view, ray in zip(seen, rays, strict=True):
            focal_px = engine.state.intrinsics(keys.intrinsics(view.camera)).fx()
            slide_px = slide_m * focal_px / float(np.linalg.norm(ray))
            weight = _weight(view.factor, together[view.camera, view.keyframe] * slide_px**2)
            factors[view.index] = reweighed(view.factor, weight, engine.rig.gates.robust_sigma)
    if factors:
        engine.solver.exchange(factors)


def _least_cosine(rays: Float) -> float:
    """Of the angles between the first view (3,) of `rays` (n, 3) and the others."""
    rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    return float(np.clip((rays @ rays[0]).min(), -1.0, 1.0))


def _weight(factor: Any, more_px2: float) -> float:
    """Information over what it was with so much more variance."""
    whitening = factor.noiseModel().noise().R()
    variance_px2 = 2.0 / float((whitening**2).sum())
    return variance_px2 / (variance_px2 + more_px2)


def _on_pipes(engine: Engine) -> dict[int, float]:
    """Landmarks on pipes, and how far from the axis they are, m."""
    state = engine.state
    landmarks = [key for t in engine.odometry.observations if state.has(key := keys.landmark(t))]
    axes = [axis for name in engine.pipes.named() if (axis := engine.pipes.axis(name)) is not None]
    if not landmarks or not axes:
        return {}
    points = np.array([state.point(key) for key in landmarks])
    distances = np.array([_distances(points, start, end) for start, end, _ in axes])
    reach = REACH * np.array([radius for _, _, radius in axes])[:, None]
    near = np.where(distances < reach, distances, np.inf).min(axis=0)
    return {landmarks[i]: float(near[i]) for i in np.flatnonzero(np.isfinite(near))}


def _distances(points: Float, start: Float, end: Float) -> Float:
    """Of points (n, 3) from an axis, (n,)."""
    along = (end - start) / np.linalg.norm(end - start)
    return np.linalg.norm(np.cross(points - start, along), axis=1)
