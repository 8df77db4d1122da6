"""Has the machine been moved? Still and moving phases of the depth camera, and the pose from station to station."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...factors.measurements import CloudFrame
from .registration import Registration, RegistrationConfig, SurfaceMap, register, small_motion

Float = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class MotionConfig:
    """When the base counts as moved."""

    translation_m: float = 0.012
    rotation_rad: float = np.deg2rad(0.5)
    confirm_frames: int = 3
    """So many frames in a row must show motion before a station ends."""
    still_ns: int = 500_000_000
    """The base stands again after so long without motion."""
    voxel_m: float = 0.1
    """Of KISS-ICP's map, which carries the guess through the motion."""
    reaches_m: tuple[float, ...] = (0.3, 0.15, 0.08)
    """Search radii of the registration between stations."""


@dataclass(frozen=True, slots=True)
class Station:
    """A phase in which the base stood still."""

    index: int
    start_ns: int
    end_ns: int | None
    """None while it lasts."""
    previous_T_this: Registration | None
    """Pose of this station's {b} in the previous station's, with covariance; None for the first."""


@dataclass(slots=True)
class _Moving:
    """A motion under way."""

    start_ns: int
    odometry: Any
    calm: tuple[CloudFrame, SurfaceMap, Float] | None = None
    """The frame since which nothing moved, and the odometry's pose of it."""


class BaseMotion:
    """Follows the depth camera's clouds one by one and tells stations apart."""

    def __init__(self, config: MotionConfig | None = None) -> None:
        self._config = config or MotionConfig()
        self._stations: list[Station] = []
        self._reference: SurfaceMap | None = None
        self._first: CloudFrame | None = None
        self._restless: list[CloudFrame] = []
        self._moving: _Moving | None = None

    @property
    def stations(self) -> tuple[Station, ...]:
        """All stations so far, the last may still be open."""
        return tuple(self._stations)

    @property
    def moving(self) -> bool:
        """True between two stations."""
        return self._moving is not None

    @property
    def restless(self) -> bool:
        """True while the base moves, and from the first frame that looks like it."""
        return self._moving is not None or bool(self._restless)

    def add(self, cloud: CloudFrame) -> Station | None:
        """Takes the next cloud; returns a station when one has just begun."""
        if self._reference is None:
            return self._begin(cloud, None)
        return self._while_moving(cloud) if self._moving is not None else self._while_still(cloud)

    def _begin(self, cloud: CloudFrame, link: Registration | None) -> Station:
        self._reference, self._first = SurfaceMap.of(cloud), cloud
        self._restless, self._moving = [], None
        self._stations.append(Station(len(self._stations), cloud.stamp_ns, None, link))
        return self._stations[-1]

    def _moved(self, reference: SurfaceMap, cloud: CloudFrame) -> bool:
        motion = small_motion(reference, cloud)
        if motion is None:
            return True
        turn, shift = float(np.linalg.norm(motion[:3])), float(np.linalg.norm(motion[3:]))
        return turn > self._config.rotation_rad or shift > self._config.translation_m

    def _while_still(self, cloud: CloudFrame) -> None:
        assert self._reference is not None
        if not self._moved(self._reference, cloud):
            self._restless = []
            return
        self._restless.append(cloud)
        if len(self._restless) < self._config.confirm_frames:
            return
        last = self._stations[-1]
        start_ns = self._restless[0].stamp_ns
        self._stations[-1] = Station(last.index, last.start_ns, start_ns, last.previous_T_this)
        assert self._first is not None
        odometry = _odometry(self._config.voxel_m)
        for seen in (self._first, *self._restless):
            odometry.register_frame(seen.points_m, np.zeros(len(seen.points_m)))
        self._moving = _Moving(start_ns, odometry)

    def _while_moving(self, cloud: CloudFrame) -> Station | None:
        assert self._moving is not None
        assert self._reference is not None
        self._moving.odometry.register_frame(cloud.points_m, np.zeros(len(cloud.points_m)))
        calm = self._moving.calm
        if calm is None or self._moved(calm[1], cloud):
            pose = np.array(self._moving.odometry.last_pose, float)
            self._moving.calm = (cloud, SurfaceMap.of(cloud), pose)
            return None
        if cloud.stamp_ns - calm[0].stamp_ns < self._config.still_ns:
            return None
        return self._begin(
            calm[0], register(self._reference, calm[0], calm[2], RegistrationConfig(reaches_m=self._config.reaches_m))
        )


def _odometry(voxel_m: float) -> Any:
    """KISS-ICP (Vizzo et al. 2023) for clouds of one instant."""
    from kiss_icp.config import KISSConfig  # heavy, and of use only once the base moves
    from kiss_icp.kiss_icp import KissICP

    config = KISSConfig()
    config.data.deskew = False
    config.data.max_range, config.data.min_range = 6.0, 0.2
    config.mapping.voxel_size = voxel_m
    return KissICP(config)
