"""Surface samples of every depth image or cloud of a recording, without boards, picks or a mobile camera."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from ..factors.camera import CameraModel
from ..factors.errors import LogError
from ..factors.measurements import CloudFrame
from ..factors.rig import Rig
from ..frontends.cloud.frontend import CloudConfig, CloudFrontEnd
from ..frontends.cloud.points import cloud_from_points
from ..io.messages import CameraInfoBody, CloudBody, DepthBody
from ..io.reader import LogReader
from .items import COMPRESSED

SAMPLES = 2500
"""Surface samples of an image: on a real recording more made the path no better."""


def depth_clouds(log: Path, rig: Rig) -> Iterator[CloudFrame]:
    """One cloud per depth image; where no image comes, one per cloud message.

    Raises:
        LogError: no depth image and no cloud, or an image before its calibration.
    """
    camera_topics, seen = rig.cameras.b_depth, 0
    image = camera_topics.image_topic
    topics = [image, image + COMPRESSED, camera_topics.info_topic, rig.kinect.points_topic]
    camera: CameraModel | None = None
    clouds: CloudFrontEnd | None = None
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
            yield clouds.process(message.stamp_ns, message.body.depth_m())
            seen += 1
        elif isinstance(message.body, CloudBody) and clouds is None:
            yield cloud_from_points(message.stamp_ns, message.body.points_m(), rig.kinect.model)
            seen += 1
    if not seen:
        raise LogError(
            f"{log}: no depth image on {image} and no cloud on {rig.kinect.points_topic}; correct the topics in the "
            "rig file (`surecut info LOG` lists what there is)"
        )
