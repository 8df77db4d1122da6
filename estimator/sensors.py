"""The front ends of one run: opened when their camera's calibration is known, fed with images, giving measurements."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, cast

import numpy as np
from numpy.typing import NDArray

from ..factors.camera import CameraModel, rectified_pair
from ..factors.errors import LogError
from ..factors.measurements import CameraName, MarkerSighting, Pick, Rejection, StereoFrame
from ..factors.rig import Rig
from ..frontends.stereo.atlas import Atlas, Memorable
from ..frontends.stereo.frontend import Early, StereoFrontEnd
from ..frontends.stereo.geometry import exponential
from ..frontends.stereo.settings import StereoSettings
from ..frontends.undistort import undistort
from ..io.messages import DetectionsBody, PickBody
from .sides import swapped

if TYPE_CHECKING:
    from ..frontends.fiducials.detector import MarkerFrontEnd
    from .depth_sensor import DepthSensor, DepthView

Float = NDArray[np.float64]
Grey = NDArray[np.uint8]

MATCH_SIGMA_PX = 0.5
"""Disparity error of semi-global matching on a window's median (OpenCV, one pixel steps interpolated to 1/16)."""

ENOUGH_MATCHES = 20
"""Features in both images of a pair that leave no doubt about which is left."""
UNMATCHED_PAIRS = 3
"""Pairs from the start on in which exchanged sides are looked for."""


@dataclass(frozen=True, slots=True)
class PairImages:
    """One stereo pair's pictures, grey."""

    stamp_ns: int
    left: Grey
    right: Grey

    def of(self, camera: str) -> Grey:
        return self.left if camera == "m_left" else self.right

    @property
    def nbytes(self) -> int:
        return self.left.nbytes + self.right.nbytes


class Sensors:
    """All front ends of one rig."""

    def __init__(self, rig: Rig, atlas: Atlas | None = None) -> None:
        """
        Args:
            atlas: what an earlier run saw.
        """
        self.rig = rig
        self._atlas = atlas or Atlas()
        self.cameras: dict[str, CameraModel] = {}
        self._given: dict[str, CameraModel] = {}
        """The last calibration that came, as the decoder gave it: mostly the very same object."""
        self._stereo: StereoFrontEnd | None = None
        self._markers: dict[str, MarkerFrontEnd] = {}
        self._unmatched = 0
        """Pairs from the start on that had hardly a feature in common."""
        self.rejected: list[Rejection] = []

    def calibrate(self, camera: str, model: CameraModel) -> None:
        """The first calibration of a camera counts; one that changes during the run is an error."""
        if self._given.get(camera) is model:
            return
        self._given[camera] = model
        named = replace(model, name=camera)
        known = self.cameras.setdefault(camera, named)
        if known is not named and not (np.allclose(known.K, named.K) and known.width == named.width):
            raise LogError(f"the calibration of {camera} changes during the recording; cut the recording there")
        if {"m_left", "m_right"} <= self.cameras.keys() and self.rig.stereo.m_left_T_m_right is None:
            self._check_baseline()

    def _check_baseline(self) -> None:
        baseline = self.cameras["m_right"].baseline_m or 0.0
        left = self.cameras["m_left"].baseline_m or 0.0
        info = self.rig.cameras.m_right.info_topic
        if baseline < 0 or (baseline == 0 and left > 0):
            raise LogError(
                f"{info}: the baseline is {baseline or -left:.3f} m: left and right are swapped; "
                "exchange their topics in the rig file"
            )
        if baseline == 0:
            raise LogError(f"{info}: no baseline in P[3]; give stereo.m_left_T_m_right in the rig file")

    # Stereo ---------------------------------------------------------------------------------------------------

    def track(self, pair: PairImages, wanted: bool = False, early: Early | None = None) -> StereoFrame:
        """Feature tracks of a pair.

        Args:
            wanted: it becomes a keyframe.
            early: told of a keyframe's motion before it is done.
        """
        if self._stereo is None:
            left, right = self._camera("m_left"), self._camera("m_right")
            self._fits(left, pair.left, self.rig.cameras.m_left.image_topic)
            self._fits(right, pair.right, self.rig.cameras.m_right.image_topic)
            self._stereo = StereoFrontEnd(left, right, self.left_T_right(), self._stereo_settings())
            self._stereo.recall(self._atlas)
            self._atlas = Atlas()
        frame = self._stereo.process(pair.stamp_ns, pair.left, pair.right, wanted, early)
        if self._unmatched < UNMATCHED_PAIRS:
            self._check_sides(pair, frame)
        return frame

    def memorable(self) -> Memorable | None:
        """What the last pair added to what can be found again."""
        return None if self._stereo is None else self._stereo.memorable

    def _stereo_settings(self) -> StereoSettings:
        cameras = (self.rig.cameras.m_left, self.rig.cameras.m_right)
        return StereoSettings(
            focal_sigma_rel=max(0.0 if "focal" in c.freeze else c.focal_sigma_rel for c in cameras),
            centre_sigma_px=max(0.0 if "centre" in c.freeze else c.centre_sigma_px for c in cameras),
        )

    def left_T_right(self) -> Float:
        """Nominal pose of the right mobile camera in the left one, (4, 4)."""
        left, right, given = self._camera("m_left"), self._camera("m_right"), self.rig.stereo.m_left_T_m_right
        if given is None:
            return rectified_pair(left, right)
        return exponential(np.array([*given.rotation_vector_rad, *given.translation_m]))  # no GTSAM

    def _check_sides(self, pair: PairImages, frame: StereoFrame) -> None:
        """The first pairs: where hardly a feature of the left image is in the right one, are they exchanged?"""
        matches = _matched(frame)
        if matches >= ENOUGH_MATCHES:
            self._unmatched = UNMATCHED_PAIRS
            return
        self._unmatched += 1
        other = StereoFrontEnd(self._camera("m_left"), self._camera("m_right"), self.left_T_right())
        exchanged = _matched(other.process(pair.stamp_ns, pair.right, pair.left))
        if exchanged >= ENOUGH_MATCHES and exchanged > 4 * matches:
            evidence = f"at {pair.stamp_ns} ns: {matches} features are in both images, {exchanged} when exchanged"
            raise swapped(self.rig, evidence)

    def _camera(self, name: str) -> CameraModel:
        if name not in self.cameras:
            topic = getattr(self.rig.cameras, name).info_topic
            raise LogError(
                f"{topic}: no calibration of {name} before its first image; "
                "record camera_info or correct the topic in the rig file"
            )
        return self.cameras[name]

    @staticmethod
    def _fits(camera: CameraModel, image: Grey, topic: str) -> None:
        if image.shape[:2] != (camera.height, camera.width):
            size = f"{image.shape[1]}x{image.shape[0]}"
            raise LogError(
                f"{topic}: images are {size}, the calibration is for {camera.width}x{camera.height}; "
                "record the camera_info that belongs to the images"
            )

    def depth_under(self, pick: Pick, pair: PairImages) -> tuple[float, float] | None:
        """Depth of the surface under a click in the left image by semi-global matching, and its sigma, m."""
        if pick.camera != "m_left":
            return None
        from ..frontends.paper_chain import clicked_point

        left, right = self.cameras["m_left"], self.cameras["m_right"]
        point = clicked_point(pair.left, pair.right, left, right, pick.raw_px)
        if point is None:
            return None
        z, baseline, stereo = float(point[2]), right.baseline_m or 1.0, self.rig.stereo
        parts = (
            z**2 * MATCH_SIGMA_PX / (left.fx * baseline),
            z * stereo.baseline_sigma_rel,
            z**2 * stereo.rotation_sigma_rad / baseline,
        )
        return z, float(np.linalg.norm(parts))

    # Markers --------------------------------------------------------------------------------------------------

    def markers(self, camera: str, stamp_ns: int, image: Grey) -> list[MarkerSighting]:
        """Markers in one image."""
        if not self.rig.boards or camera not in self.cameras:
            return []
        if camera not in self._markers:
            from ..frontends.fiducials.detector import MarkerFrontEnd  # who only follows the camera starts sooner

            self._fits(self.cameras[camera], image, getattr(self.rig.cameras, camera).image_topic)
            self._markers[camera] = MarkerFrontEnd(self.rig, self.cameras[camera], cast(CameraName, camera))
        found, refused = self._markers[camera].process(stamp_ns, image)
        self.rejected += refused
        return found

    def detections(self, camera: str, stamp_ns: int, body: DetectionsBody) -> list[MarkerSighting]:
        """Markers that were detected elsewhere."""
        from ..frontends.fiducials.messages import sightings_from_messages

        name = cast(CameraName, camera)
        found, refused = sightings_from_messages(
            self.rig, self._camera(camera), name, stamp_ns, body.families, [int(i) for i in body.ids], body.corners_px
        )
        self.rejected += refused
        return found

    # Kinect ---------------------------------------------------------------------------------------------------

    @cached_property
    def kinect(self) -> "DepthSensor":
        from .depth_sensor import DepthSensor  # with libraries that who only follows the camera need not wait for

        return DepthSensor(self.rig.kinect)

    def depth(self, stamp_ns: int, depth_m: NDArray[np.float32]) -> "DepthView | None":
        """The last depth images, once enough have gathered."""
        camera = self._camera("b_depth")
        self._fits(camera, cast(Grey, depth_m), self.rig.cameras.b_depth.image_topic)
        return self.kinect.image(stamp_ns, depth_m, camera)

    # Picks ----------------------------------------------------------------------------------------------------

    def pick(self, stamp_ns: int, body: PickBody) -> Pick:
        """A click in ideal pixels.

        Raises:
            LogError: a camera that does not exist, or a click outside its image.
        """
        topic = self.rig.picks_topic
        where = f"{topic} at {stamp_ns} ns: pick {body.point_id}"
        if body.camera not in ("m_left", "m_right", "b_rgb"):
            raise LogError(
                f"{where} names camera {body.camera!r}; picks are in m_left, m_right or b_rgb (header.frame_id)"
            )
        camera = self._camera(body.camera)
        u, v = (float(x) for x in body.px)
        if not (-0.5 <= u <= camera.width - 0.5 and -0.5 <= v <= camera.height - 0.5):
            raise LogError(
                f"{where} lies at ({u:.1f}, {v:.1f}) px, outside the {camera.width}x{camera.height} image of "
                f"{body.camera}; pick again"
            )
        if body.role not in ("grasp", "cut", "other"):
            raise LogError(f"{where} has role {body.role!r}; roles are grasp, cut and other")
        if not (body.sigma_px > 0 and np.isfinite(body.sigma_px)):
            raise LogError(f"{where} has sigma_px {body.sigma_px}; a click needs a positive sigma")
        covariance = np.eye(2)[None] * body.sigma_px**2
        ideal, spread = undistort(camera, body.px[None], covariance)
        if spread is None or not np.isfinite(ideal).all():
            raise LogError(
                f"{where} lies where the lens model of {body.camera} does not reach; pick nearer to the centre"
            )
        name = cast(CameraName, body.camera)
        return Pick(stamp_ns, name, body.point_id, body.role, ideal[0], np.asarray(body.px, float), spread[0])  # type: ignore[arg-type]


def _matched(frame: StereoFrame) -> int:
    return int(np.isfinite(frame.right_px).all(axis=1).sum())


def by_info_topic(rig: Rig) -> Mapping[str, str]:
    """Camera names by their camera_info topics."""
    return {getattr(rig.cameras, name).info_topic: name for name in ("m_left", "m_right", "b_rgb", "b_depth")}
