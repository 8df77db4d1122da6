"""Pipes in the Kinect's depth, looked for where the engine's estimate says that they are."""

from ..factors.measurements import CylinderSighting, Rejection
from ..frontends.cloud.noise import DepthModel
from ..frontends.pipe.depth_cylinder import DepthImages, PredictedPipe, cylinder_near
from .depth_sensor import DepthView
from .engine import Engine


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
        base = self._engine.base
        for pipe in self._engine.depth_pipes.wanted(base):
            predicted = self._engine.depth_pipes.predict(pipe, base, self._engine.solver)
            found = None if predicted is None else self.cylinder(pipe, predicted)
            if found is not None:
                self._engine.add_cylinder(pipe, base, found)
        self._engine.flush()

    def cylinder(self, pipe_id: str, pipe: PredictedPipe) -> CylinderSighting | Rejection | None:
        """A pipe in what was seen last; None when nothing was."""
        view = self.view
        if view is None:
            return None
        points = view.points_m
        if view.depth_m is not None:
            if self._images is None:
                self._images = DepthImages(self._engine.cameras["b_depth"], self._model)
            points = self._images.points_near(view.depth_m, pipe)
        if points is None:
            return None
        return cylinder_near(view.cloud.stamp_ns, pipe_id, points, self._model, pipe)
