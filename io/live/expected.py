"""What a rig lets come on which topic."""

from ...factors.rig import Rig
from ..messages import Body, CameraInfoBody, CloudBody, DepthBody, DetectionsBody, ImageBody, PickBody
from .admission import COMPRESSED, Expected

_DEPTH, _IMAGE = COMPRESSED


def expected_bodies(rig: Rig) -> Expected:
    """Types by topic: images, calibrations, markers, clouds and picks of the rig's sensors, nothing else."""
    cameras = rig.cameras
    expected: dict[str, tuple[type[Body], ...]] = {rig.picks_topic: (PickBody,), rig.kinect.points_topic: (CloudBody,)}
    for camera in (cameras.m_left, cameras.m_right, cameras.b_rgb):
        expected[camera.image_topic] = (ImageBody,)
        expected[camera.image_topic + _IMAGE] = (ImageBody,)
        if camera.markers_topic:
            expected[camera.markers_topic] = (DetectionsBody,)
    depth = cameras.b_depth.image_topic
    expected[depth] = expected[depth + _IMAGE] = expected[depth + _DEPTH] = (DepthBody,)
    for camera in (cameras.m_left, cameras.m_right, cameras.b_rgb, cameras.b_depth):
        expected[camera.info_topic] = (CameraInfoBody,)
    return expected
