"""The path of a depth camera that is carried about: every cloud is registered to a map of the earlier ones."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ...factors.measurements import CloudFrame
from .registration import RegistrationConfig, SurfaceMap, register

Float = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class DepthOdometryConfig:
    registration: RegistrationConfig = field(
        default_factory=lambda: RegistrationConfig(reaches_m=(0.10, 0.05), iterations=6)
    )
    """A hand moves a camera by centimetres between frames, and the last motion is expected to go on."""
    voxel_m: float = 0.03
    """The map takes a new sample where it has none so near with a like normal."""
    keyframe_m: float = 0.1
    keyframe_rad: float = 0.08
    """The map grows when the camera has moved so far: chained frames drift, a map that grows rarely does less."""
    least_overlap: float = 0.3
    """Part of a cloud that must meet the map."""


@dataclass(frozen=True, slots=True)
class DepthPose:
    """A cloud's place in the frame of the first one."""

    stamp_ns: int
    first_T_this: Float
    """Shape (4, 4)."""
    lost: bool
    """True where the cloud hardly met the map: the pose is the last motion's continuation."""


class DepthOdometry:
    """Follows clouds one by one."""

    def __init__(self, config: DepthOdometryConfig | None = None) -> None:
        self._config = config or DepthOdometryConfig()
        self._map: SurfaceMap | None = None
        self._pose, self._step, self._keyframe = np.eye(4), np.eye(4), np.eye(4)

    def add(self, cloud: CloudFrame) -> DepthPose:
        """The next cloud's pose."""
        if self._map is None:
            self._map = SurfaceMap.of(cloud)
            return DepthPose(cloud.stamp_ns, self._pose, False)
        config = self._config
        found = register(self._map, cloud, self._pose @ self._step, config.registration)
        lost = found.overlap < config.least_overlap
        pose = self._pose @ self._step if lost else found.a_T_b
        self._step = np.linalg.inv(self._pose) @ pose
        self._pose = pose
        way = np.linalg.inv(self._keyframe) @ pose
        turn = float(Rotation.from_matrix(way[:3, :3]).magnitude())
        if not lost and (np.linalg.norm(way[:3, 3]) > config.keyframe_m or turn > config.keyframe_rad):
            self._map, self._keyframe = self._map.joined(cloud, pose, config.voxel_m), pose
        return DepthPose(cloud.stamp_ns, pose, lost)
