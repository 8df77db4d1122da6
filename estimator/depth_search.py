"""Pipes in the Kinect's depth, looked for where the engine's estimate says that they are."""

import numpy as np
from numpy.typing import NDArray

from ..factors.measurements import CylinderSighting, Rejection
from ..frontends.cloud.noise import DepthModel
from ..frontends.pipe.depth_cylinder import FEWEST_POINTS, DepthImages, PredictedPipe, cylinder_near
from .depth_sensor import DepthView
from .engine import Engine

Float = NDArray[np.float64]


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
