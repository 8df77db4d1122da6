"""Pipes in the Kinect's depth, looked for where the engine's estimate says that they are."""

import gtsam
import numpy as np
from numpy.typing import NDArray

from ..factors.measurements import CylinderSighting, Rejection
from ..frontends.cloud.noise import DepthModel
from ..frontends.pipe.depth_cylinder import FEWEST_POINTS, DepthImages, PredictedPipe, cylinder_near
from .depth_pipes import MOST_SIGMA_M
from .depth_sensor import DepthView
from .engine import Engine
from .pipes import WIDE_RADIUS_M

Float = NDArray[np.float64]


NEAREST_M = 0.2
"""A pipe that reaches behind the depth camera is not looked for."""


class DepthSearch:
    """Keeps the newest view of the depth camera, and looks for pipes in it."""

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        self._model: DepthModel = engine.rig.kinect.model
        self._images: DepthImages | None = None
        self.view: DepthView | None = None
        """The newest."""

    def see(self, view: DepthView) -> None:
        """A view of the machine at rest."""
        self.view = view
        self.search()

    def search(self) -> None:
        """Looks in the newest view for all pipes that no view has shown so far."""
        engine, base = self._engine, self._engine.base
        for pipe in engine.depth_pipes.wanted(base):
            placed = engine.depth_pipes.place(pipe, base)
            points = None if placed is None else self._points_near(placed)
            if placed is None or points is None:
                continue
            if len(points) >= FEWEST_POINTS:  # the covariance of where it is costs much more than a look
                placed = engine.depth_pipes.narrowed(placed, pipe, base, engine.solver)
            if placed is not None:
                engine.add_cylinder(pipe, base, self._cylinder(pipe, points, placed))
        engine.flush()

    def begin_unknown(self) -> None:
        """Pipes whose edges nobody found, but on which two points were picked: the depth camera may see them.

        The cylinder that it sees is the pipe where all picks lie within it; a neighbour's would not hold them.
        """
        engine, base, view = self._engine, self._engine.base, self.view
        if view is None or not engine.machine.placed:
            return
        for name in engine.pipes.named():
            part = engine.pipes.known_part(name)
            if part is None or engine.pipes.axis(name) is not None:
                continue
            o_T_b = engine.state.pose(base)
            a, b = (o_T_b.transformTo(end) for end in part)
            expected = PredictedPipe(a, b, WIDE_RADIUS_M[0], MOST_SIGMA_M)
            points = self._points_near(expected) if min(a[2], b[2]) > NEAREST_M else None
            found = None if points is None else self._cylinder(name, points, expected)
            if not isinstance(found, CylinderSighting) or not _holds(found, o_T_b, engine.pipes.places(name)):
                continue
            ends = [o_T_b.transformFrom(end) for end in (found.point_a_m, found.point_b_m)]
            middle, stamp_ns = 0.5 * (ends[0] + ends[1]), view.cloud.stamp_ns
            engine.graph.take(engine.pipes.begin(name, middle, ends[1] - ends[0], found.radius_m, stamp_ns))
            engine.flush()

    def _points_near(self, pipe: PredictedPipe) -> Float | None:
        """What was seen last, near a pipe, (n, 3); None when nothing was."""
        view = self.view
        if view is None:
            return None
        if view.depth_m is None:
            return None if view.points_m is None else view.points_m[pipe.near(view.points_m)]
        if self._images is None:
            self._images = DepthImages(self._engine.cameras["b_depth"], self._model)
        return self._images.points_near(view.depth_m, pipe)

    def _cylinder(self, pipe_id: str, points_m: Float, pipe: PredictedPipe) -> CylinderSighting | Rejection:
        """A pipe among points of the newest view."""
        assert self.view is not None
        return cylinder_near(self.view.cloud.stamp_ns, pipe_id, points_m, self._model, pipe)


def _holds(found: CylinderSighting, o_T_b: gtsam.Pose3, places: list[Float]) -> bool:
    """Do all places (3,) of {o} lie within a cylinder of {b}?"""
    way = (found.point_b_m - found.point_a_m) / np.linalg.norm(found.point_b_m - found.point_a_m)
    off = [np.linalg.norm(np.cross(o_T_b.transformTo(place) - found.point_a_m, way)) for place in places]
    return bool(max(off) < found.radius_m)
