"""The Kinect's depth: images are averaged and become surface samples; clouds come as they are."""

import numpy as np
from numpy.typing import NDArray

from ..factors.camera import CameraModel
from ..factors.measurements import CloudFrame, CylinderSighting, Rejection
from ..factors.rig import Kinect
from ..frontends.cloud.frontend import CloudFrontEnd, average_depth
from ..frontends.cloud.noise import DepthModel
from ..frontends.cloud.points import cloud_from_points
from ..frontends.pipe.depth_cylinder import DepthImages, PredictedPipe, cylinder_near

Float = NDArray[np.float64]
Depth = NDArray[np.float32]

DEPTH_FRAMES = 10
WINDOW_NS = 2_000_000_000
"""Depth images of a still machine that are averaged before surfaces are read from them: so many, or so long."""


class DepthSensor:
    """One depth camera. It delivers images, or clouds where no image has come."""

    def __init__(self, kinect: Kinect) -> None:
        self._model: DepthModel = kinect.model
        self._clouds: CloudFrontEnd | None = None
        self._images: DepthImages | None = None
        self._waiting: list[tuple[int, Depth]] = []
        self._mean: tuple[int, Depth] | None = None
        self._points: tuple[int, Float] | None = None

    def image(self, stamp_ns: int, depth_m: Depth, camera: CameraModel) -> CloudFrame | None:
        """Surface samples of the last depth images, once enough have gathered."""
        if self._clouds is None:
            self._clouds = CloudFrontEnd(camera, self._model)
            self._images = DepthImages(camera, self._model)
        self._points = None
        self._waiting.append((stamp_ns, depth_m))
        if len(self._waiting) < DEPTH_FRAMES and stamp_ns - self._waiting[0][0] < WINDOW_NS:
            return None
        mean, count = average_depth(np.stack([depth for _, depth in self._waiting])), len(self._waiting)
        self._waiting.clear()
        self._mean = stamp_ns, mean
        return self._clouds.process(stamp_ns, mean, count)

    def cloud(self, stamp_ns: int, points_m: Float) -> CloudFrame:
        """Surface samples of a cloud, (n, 3) in the depth optical frame."""
        self._points = stamp_ns, points_m
        return cloud_from_points(stamp_ns, points_m, self._model)

    def cloud_due(self, stamp_ns: int) -> bool:
        """Is a cloud of this stamp wanted? One per window; none where depth images tell the same."""
        return self._clouds is None and (self._points is None or stamp_ns - self._points[0] >= WINDOW_NS)

    def cylinder(self, pipe_id: str, pipe: PredictedPipe) -> CylinderSighting | Rejection | None:
        """A pipe in what was seen last; None when nothing was."""
        if self._mean is not None and self._images is not None:
            stamp_ns, mean = self._mean
            return cylinder_near(stamp_ns, pipe_id, self._images.points_near(mean, pipe), self._model, pipe)
        if self._points is not None:
            return cylinder_near(self._points[0], pipe_id, self._points[1], self._model, pipe)
        return None
