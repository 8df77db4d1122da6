"""The message types that surecut writes: ROS 2's own, the AprilTag detector's, and three of surecut's.

Texts are `.msg` definitions; the store generates code, schema text and type hash from them.
"""

from dataclasses import dataclass
from functools import cache

from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

PIXEL_PICK = "surecut_msgs/msg/PixelPick"
POINT_ARRAY = "surecut_msgs/msg/PointArray"
POINT_WITH_COVARIANCE_ARRAY = "surecut_msgs/msg/PointWithCovarianceArray"
MARKER_DETECTIONS = "apriltag_msgs/msg/AprilTagDetectionArray"

DEFINITIONS: dict[str, str] = {
    PIXEL_PICK: """
# One click of the operator. Pixel (0, 0) is the centre of the top left pixel.
std_msgs/Header header
string point_id
string role
float64 u
float64 v
float64 sigma_px
""",
    POINT_ARRAY: """
# Points by name, in header.frame_id, metres.
std_msgs/Header header
string[] ids
geometry_msgs/Point[] points
""",
    POINT_WITH_COVARIANCE_ARRAY: """
# Points by name with their covariances, in header.frame_id; 9 numbers per point, row by row, square metres.
std_msgs/Header header
string[] ids
geometry_msgs/Point[] points
float64[] covariances
""",
    "apriltag_msgs/msg/Point": """
float64 x
float64 y
""",
    "apriltag_msgs/msg/AprilTagDetection": """
string family
int32 id
int32 hamming
float32 goodness
float32 decision_margin
apriltag_msgs/Point centre
apriltag_msgs/Point[4] corners
float64[9] homography
""",
    MARKER_DETECTIONS: """
std_msgs/Header header
apriltag_msgs/AprilTagDetection[] detections
""",
}


@dataclass(frozen=True, slots=True)
class Schema:
    """What a file holds about one message type."""

    name: str
    text: str
    """The `.msg` definition with those of all types it uses."""
    type_hash: str
    """ROS 2's RIHS01 hash."""


@cache
def typestore() -> Typestore:
    """ROS 2 Jazzy's types and those of `DEFINITIONS`. Shared: register nothing in it."""
    store = get_typestore(Stores.ROS2_JAZZY)
    for name, text in DEFINITIONS.items():
        store.register(get_types_from_msg(text, name))
    return store


@cache
def schema(name: str) -> Schema:
    """Text and hash of a type that `typestore` knows.

    Raises:
        KeyError: there is no such type.
    """
    store = typestore()
    if name not in store.fielddefs:
        raise KeyError(name)
    return Schema(name, store.generate_msgdef(name, ros_version=2)[0], store.hash_rihs01(name))
