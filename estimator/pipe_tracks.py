"""Tracks on a named pipe: no points of it.

What looks like a corner on something round and smooth is where an outline, a flange's rim or a highlight cross. They
slide over the surface by some tenths of a millimetre when the view turns, all alike, and their residuals stay small
because they are near, so that the estimate follows them. The pipe has measurements of its own.
"""

from collections import Counter, defaultdict

import numpy as np
from numpy.typing import NDArray

from ..factors import keys
from ..factors.measurements import Rejection
from .engine import Engine
from .odometry import FAMILY

Float = NDArray[np.float64]

REACH = 2.0
"""Radii from the axis within which something is the pipe, or a flange or collar on it."""
ENOUGH = 15
"""Other landmarks that every keyframe keeps: where there is hardly anything but the pipe, it has to do. A few more than
a motion takes; one such track among 29 others carried a keyframe 6 mm away in the dark."""


def leave_out_pipe_tracks(engine: Engine) -> None:
    """Takes landmarks on named pipes out of the graph, with their views and what lays them on surfaces."""
    near = _on_pipes(engine)
    if not near:
        return
    seen_in: dict[int, set[int]] = defaultdict(set)
    for _, factor, record in engine.solver.log.active():
        if record.family == FAMILY and record.camera is not None:
            involved = factor.keys()  # the pose first
            seen_in[keys.landmark_among(involved)].add(involved[0])
    left = Counter(keyframe for landmark, seen in seen_in.items() if landmark not in near for keyframe in seen)
    gone = {landmark: radii for landmark, radii in near.items() if all(left[k] >= ENOUGH for k in seen_in[landmark])}
    engine.state.values = engine.solver.leave_out(gone)
    reason = "on a named pipe, where nothing is a point; radii from its axis"
    engine.rejected += [
        Rejection(engine.end_ns, FAMILY, keys.words(landmark), reason, radii, REACH) for landmark, radii in gone.items()
    ]


def _on_pipes(engine: Engine) -> dict[int, float]:
    """Landmarks, and how many radii they are from the axis of a pipe."""
    state = engine.state
    landmarks = [key for t in engine.odometry.observations if state.has(key := keys.landmark(t))]
    axes = [axis for name in engine.pipes.named() if (axis := engine.pipes.axis(name)) is not None]
    if not landmarks or not axes:
        return {}
    points = np.array([state.point(key) for key in landmarks])
    radii = np.min([_radii(points, *axis) for axis in axes], axis=0)
    return {landmarks[i]: float(radii[i]) for i in np.flatnonzero(radii < REACH)}


def _radii(points: Float, start: Float, end: Float, radius_m: float) -> Float:
    """Distances (n,) of points (n, 3) from an axis, in radii."""
    along = (end - start) / np.linalg.norm(end - start)
    return np.linalg.norm(np.cross(points - start, along), axis=1) / radius_m
