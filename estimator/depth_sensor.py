"""The Kinect's depth: images are averaged and become surface samples; clouds come as they are."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..factors.camera import CameraModel
from ..factors.measurements import CloudFrame
from ..factors.rig import Kinect
from ..frontends.cloud.frontend import CloudFrontEnd, average_depth
from ..frontends.cloud.noise import DepthModel
from ..frontends.cloud.points import cloud_from_points

Float = NDArray[np.float64]
Depth = NDArray[np.float32]

DEPTH_FRAMES = 10
WINDOW_NS = 2_000_000_000
"""Depth images of a still machine that are averaged before surfaces are read from them: so many, or so long."""

CLOUD_POINTS = 100_000
"""Larger clouds are thinned out: their neighbours tell nothing of their own."""


@dataclass(frozen=True, slots=True)
class DepthView:
    """What a depth camera saw of a scene at rest. Plain data: it may cross a process border."""

    cloud: CloudFrame
    depth_m: Depth | None = None
    """Shape (height, width), averaged, NaN invalid; None where only clouds come."""
    points_m: Float | None = None
    """Shape (n, 3), in the depth optical frame, where only clouds come."""
    colour: NDArray[np.uint8] | None = None
    """The colour image beside it, grey."""


class DepthSensor:
    """One depth camera. It delivers images, or clouds where no image has come."""

    def __init__(self, kinect: Kinect) -> None:
        self._model: DepthModel = kinect.model
        self._clouds: CloudFrontEnd | None = None
        self._waiting: list[tuple[int, Depth]] = []
        self._last_cloud_ns: int | None = None

    def image(self, stamp_ns: int, depth_m: Depth, camera: CameraModel) -> DepthView | None:
        """The mean of the last depth images and its surfaces, once enough have gathered."""
        if self._clouds is None:
            self._clouds = CloudFrontEnd(camera, self._model)
        self._waiting.append((stamp_ns, depth_m))
        if len(self._waiting) < DEPTH_FRAMES and stamp_ns - self._waiting[0][0] < WINDOW_NS:
            return None
        mean, count = average_depth(np.stack([depth for _, depth in self._waiting])), len(self._waiting)
        self._waiting.clear()
        return DepthView(self._clouds.process(stamp_ns, mean, count), depth_m=mean)

    def cloud(self, stamp_ns: int, points_m: Float) -> DepthView:
        """A cloud (n, 3) in the depth optical frame and its surfaces."""
        self._last_cloud_ns = stamp_ns
        kept = points_m[:: max(1, len(points_m) // CLOUD_POINTS)]
        return DepthView(cloud_from_points(stamp_ns, kept, self._model), points_m=kept)

    def cloud_due(self, stamp_ns: int) -> bool:
        """Is a cloud of this stamp wanted? One per window; none where depth images tell the same."""
        late = self._last_cloud_ns is None or stamp_ns - self._last_cloud_ns >= WINDOW_NS
        return self._clouds is None and late
