"""A small log with one topic of every kind, for tests."""

from pathlib import Path
from typing import Any, BinaryIO

import cv2
import numpy as np

from surecut.factors.camera import CameraModel
from surecut.io import build, build_views
from surecut.io.writer import McapSink

START_NS = 1_000_000_000_000
STEP_NS = 50_000_000
K = np.array([[50.0, 0, 31.5], [0, 50, 23.5], [0, 0, 1]])
LEFT = CameraModel("m_left", 64, 48, K, "none", np.zeros(0), np.eye(3), 0.0)
RIGHT = CameraModel("m_right", 64, 48, K, "plumb_bob", np.array([0.1, -0.05, 1e-3, 2e-3, 0.0]), np.eye(3), 0.12)
POINT = ((1.0, 2.0, 3.0), np.diag([1e-6, 4e-6, 9e-6]))
SQUARE = [[10.0, 20.0], [20.0, 20.0], [20.0, 10.0], [10.0, 10.0]]
RIG = """
version: 1
boards:
  - id: f0
    markers: [{id: 7, centre_m: [0, 0]}]
mount: {board: f0, f_T_b: {translation_m: [0, 0, 1]}}
"""


def picture(number: int) -> np.ndarray:
    return np.random.default_rng(number).integers(0, 256, (48, 64), dtype=np.uint8)


def messages(number: int) -> list[tuple[str, str, Any]]:
    """Topic, type and message of one moment."""
    t = START_NS + number * STEP_NS
    pose = np.eye(4)
    pose[:3, 3] = number, 0, 1
    jpeg = cv2.imencode(".png", picture(number))[1].tobytes()
    depth = np.full((48, 64), 1.25)
    depth[0, 0] = np.nan
    return [
        ("/m/left/image_raw", "sensor_msgs/msg/Image", build.image(t, "m_left", picture(number), "mono8")),
        ("/m/right/image_raw", "sensor_msgs/msg/Image", build.image(t, "m_right", picture(number), "mono8")),
        ("/m/left/camera_info", "sensor_msgs/msg/CameraInfo", build.camera_info(t, "m_left", LEFT)),
        ("/m/right/camera_info", "sensor_msgs/msg/CameraInfo", build.camera_info(t, "m_right", RIGHT)),
        ("/b/depth/image_raw", "sensor_msgs/msg/Image", build.depth_image(t, "b", depth)),
        ("/b/depth/camera_info", "sensor_msgs/msg/CameraInfo", build.camera_info(t, "b", LEFT)),
        ("/zip", "sensor_msgs/msg/CompressedImage", build.compressed_image(t, "m_left", jpeg, "png")),
        ("/tf", "tf2_msgs/msg/TFMessage", build.tf_message([(t, "o", "m", pose)])),
        ("/tf_static", "tf2_msgs/msg/TFMessage", build.tf_message([(t, "o", "f", pose)])),
        ("/pose", "geometry_msgs/msg/PoseStamped", build.pose_stamped(t, "o", pose)),
        (
            "/pose_cov",
            "geometry_msgs/msg/PoseWithCovarianceStamped",
            build.pose_with_covariance_stamped(t, "o", pose, np.diag(np.arange(1.0, 7.0))),
        ),
        ("/picks", "surecut_msgs/msg/PixelPick", build.pixel_pick(t, "m_left", "P1", "cut", (30.5, 20.25), 1.5)),
        ("/truth/points", "surecut_msgs/msg/PointArray", build.point_array(t, "b", {"P1": POINT[0]})),
        (
            "/points",
            "surecut_msgs/msg/PointWithCovarianceArray",
            build.point_with_covariance_array(t, "b", {"P1": POINT}),
        ),
        ("/cloud", "sensor_msgs/msg/PointCloud2", build_views.covariance_cloud(t, "b", [POINT, POINT])),
        ("/spheres", "visualization_msgs/msg/MarkerArray", build_views.marker_array_ellipsoids(t, "b", "p", [POINT])),
        (
            "/health",
            "diagnostic_msgs/msg/DiagnosticArray",
            build_views.diagnostic_array(t, [("warn", "corners", "few", {"count": "3"})]),
        ),
        (
            "/m/left/markers",
            "apriltag_msgs/msg/AprilTagDetectionArray",
            build.marker_detections(t, "m_left", "tag36h11", {7: SQUARE}),
        ),
    ]


def write_log(target: Path | BinaryIO, moments: int = 20, rig: str | None = RIG, **options: Any) -> None:
    with McapSink(target, **options) as sink:
        if rig is not None:
            sink.attach("rig.yaml", "application/yaml", rig)
        for number in range(moments):
            for topic, type_name, message in messages(number):
                sink.write(topic, type_name, message, START_NS + number * STEP_NS + 1_000_000)
        sink.metadata("run", {"surecut": "0.1.0"})
