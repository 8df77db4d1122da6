"""A recording's depth images alone: the path of the depth camera, without boards, picks or a mobile camera."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from scipy.spatial.transform import Rotation

from ..factors.camera import CameraModel
from ..factors.errors import LogError
from ..factors.rig import Rig
from ..frontends.cloud.depth_odometry import DepthOdometry, DepthPose
from ..frontends.cloud.frontend import CloudConfig, CloudFrontEnd
from ..frontends.cloud.points import cloud_from_points
from ..io.messages import CameraInfoBody, CloudBody, DepthBody
from ..io.reader import LogReader
from .sensing import COMPRESSED

SAMPLES = 2500
"""Surface samples of an image: on a real recording more made the path no better."""


def depth_path(log: Path, rig: Rig) -> Iterator[DepthPose]:
    """Poses of the depth camera in the frame of its first image, one per image or cloud.

    Raises:
        LogError: no depth image and no cloud, or an image before its calibration.
    """
    camera_topics, seen = rig.cameras.b_depth, 0
    image = camera_topics.image_topic
    topics = [image, image + COMPRESSED, camera_topics.info_topic, rig.kinect.points_topic]
    camera: CameraModel | None = None
    clouds: CloudFrontEnd | None = None
    odometry = DepthOdometry()
    for message in LogReader(log, topics):
        if isinstance(message.body, CameraInfoBody):
            camera = camera or replace(message.body.camera, name="b_depth")
        elif isinstance(message.body, DepthBody):
            if camera is None:
                raise LogError(
                    f"{log}: {camera_topics.info_topic}: no calibration before the first depth image; "
                    "record camera_info"
                )
            clouds = clouds or CloudFrontEnd(camera, rig.kinect.model, CloudConfig(samples=SAMPLES))
            yield odometry.add(clouds.process(message.stamp_ns, message.body.depth_m()))
            seen += 1
        elif isinstance(message.body, CloudBody) and clouds is None:
            yield odometry.add(cloud_from_points(message.stamp_ns, message.body.points_m(), rig.kinect.model))
            seen += 1
    if not seen:
        raise LogError(
            f"{log}: no depth image on {image} and no cloud on {rig.kinect.points_topic}; correct the topics in the "
            "rig file (`surecut info LOG` lists what there is)"
        )


def tum_line(pose: DepthPose) -> str:
    """One line of a TUM trajectory: seconds, translation, quaternion x y z w."""
    seconds, rest = divmod(pose.stamp_ns, 1_000_000_000)
    x, y, z = pose.first_T_this[:3, 3]
    q = Rotation.from_matrix(pose.first_T_this[:3, :3]).as_quat()
    return f"{seconds}.{rest:09d} {x:.9f} {y:.9f} {z:.9f} " + " ".join(f"{v:.9f}" for v in q)
