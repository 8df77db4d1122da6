"""A pipe that was begun in the wrong place begins anew.

One click has a depth by stereo matching, which may be that of something behind the pipe. The axis then begins metres
away or along the line of sight, from where no step leads back: robust losses let go of the clicks that would. Clicks
from several places tell where it is, without axis and outlines.
"""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from ..factors import keys
from ..factors.measurements import Event, Pick, Rejection
from ..factors.noise import floored
from .depth_pipes import FAMILY as CYLINDER
from .engine import Engine
from .marginal import FAMILY as EARLIER
from .pipe_parts import SeenFrom, intersection
from .pipes import AXIS_ROLES, OUTLINE

Float = NDArray[np.float64]

AGREE, ASTRAY = 4.0, 8.0
"""Clicks that lie within so many sigmas of one point agree; an axis that passes it by more in one of their pictures is
somewhere else."""


def clicked_places(engine: Engine, pipe: str) -> dict[int, Float]:
    """Points of a pipe whose axis is somewhere else than their clicks, and the others of which clicks tell the place.

    Returns:
        Places in {o}, shape (3,), by index of the point; nothing where the axis is right, or where clicks do not tell.
    """
    if engine.pipes.axis(pipe) is None or _known_otherwise(engine, pipe):
        return {}
    places, astray = {}, False
    for point in engine.pipes.points.values():
        if point.pipe != pipe or point.role not in AXIS_ROLES:
            continue
        views = _views(engine, point.id)
        place = intersection([engine.pipes.ray(where, pick.camera, pick.px) for where, pick in views])
        if place is None or max(_off(engine, where, pick, place) for where, pick in views) > AGREE:
            continue
        places[point.index] = place
        astray |= _passed_by(engine, pipe, point.id, place) > ASTRAY
    return places if astray else {}


def begin_anew(engine: Engine, pipe: str, places: Mapping[int, Float]) -> None:
    """Takes axis, radius and outlines of a pipe out of the graph, and puts its points where their clicks are."""
    points = {point.index: point.id for point in engine.pipes.points.values()}
    off = max(_passed_by(engine, pipe, points[i], place) for i, place in places.items())
    reason = "found about an axis that passes the clicks, sigmas of a click"
    engine.rejected += [
        Rejection(seen.stamp_ns, OUTLINE, f"outline of {pipe} in {seen.camera}", reason, off, ASTRAY)
        for _, seen in engine.pipes.outlined_of(pipe)
    ]
    index = engine.pipes.cylinders[pipe].index
    gone = {keys.axis_start(index), keys.axis_end(index), keys.radius(index), keys.inset(index)}
    engine.graph.give_up(gone, {keys.point(i): place for i, place in places.items()})
    engine.adrift.forget(gone)
    engine.pipes.begin_anew(pipe)
    text = f"clicks on {pipe} from several places agree with each other, and not with where it had begun; it began anew"
    engine.events.append(Event(engine.end_ns, "pipe_begun_anew", text, "info"))


def _passed_by(engine: Engine, pipe: str, point_id: str, place: Float) -> float:
    """How far a pipe's axis passes the clicks on a point, where it is nearest to the point's place, in their sigmas."""
    start, end, _ = engine.pipes.axis(pipe) or (place, place, 0.0)
    along = end - start
    nearest = start + along * float((place - start) @ along) / max(float(along @ along), 1e-12)
    return max(_off(engine, where, pick, nearest) for where, pick in _views(engine, point_id))


def _views(engine: Engine, point_id: str) -> list[tuple[SeenFrom, Pick]]:
    """Clicks on a point, with where their cameras are believed to be now."""
    found = [(engine.seen_from(pick.camera, pick.stamp_ns), pick) for _, pick in engine.pipes.clicked]
    return [(where, pick) for where, pick in found if where is not None and pick.point_id == point_id]


def _off(engine: Engine, where: SeenFrom, pick: Pick, o_p: Float) -> float:
    """Distance of a click from a point of {o}, in sigmas of the click."""
    c_p = where.o_T_c.transformTo(o_p)
    if c_p[2] <= 0.0:
        return np.inf
    px = engine.state.intrinsics(keys.intrinsics(pick.camera)).K() @ (c_p / c_p[2])
    variance = np.trace(floored(pick.covariance_px2, engine.rig.noise.pick_floor_px)) / 2
    return float(np.linalg.norm(px[:2] - pick.px) / np.sqrt(variance))


def _known_otherwise(engine: Engine, pipe: str) -> bool:
    """Does something else than clicks and edges of this graph know the axis: the Kinect, an earlier run, keyframes that
    have left?"""
    mine = {keys.axis_start(engine.pipes.cylinders[pipe].index), keys.radius(engine.pipes.cylinders[pipe].index)}
    return any(r.family in (CYLINDER, EARLIER) and mine & set(f.keys()) for _, f, r in engine.solver.log.active())
