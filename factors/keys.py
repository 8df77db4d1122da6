"""The only place where variables get their symbols, and their names in words."""

from collections.abc import Iterable

import gtsam

_WORDS = {
    "x": "o_T_m[{}], the mobile camera at keyframe {}",
    "l": "landmark {}",
    "q": "marker corner {}",
    "f": "o_T_f[{}], a fiducial board",
    "h": "side and print scale of board {}",
    "b": "o_T_b[{}], the machine's Kinect",
    "p": "pipe point {}",
    "u": "pipe axis, first point of pipe {}",
    "v": "pipe axis, second point of pipe {}",
    "r": "radius of pipe {}",
    "w": "how far the visible edges of pipe {} lie inside its outline",
    "k": "intrinsics of camera {}",
    "e": "camera extrinsics {}",
    "g": "centre and focal length of the Kinect's depth camera",
    "d": "depth offset and scale of the Kinect",
}

EPOCHS = 64
"""A board that was knocked or carried away gets a new pose: up to this many per board."""


def keyframe(index: int) -> int:
    """`o_T_m` at a keyframe: Pose3."""
    return gtsam.symbol("x", index)


def landmark(track: int) -> int:
    """A tracked point in {o}: Point3."""
    return gtsam.symbol("l", track)


def landmark_before(track: int) -> int:
    """A landmark as earlier keyframes saw it, where it is torn from what later ones see: Point3."""
    return gtsam.symbol("z", track)


def corner(slot: int, index: int) -> int:
    """Corner `index` (0..3) of the marker in `slot` (one per marker and board epoch), in {o}: Point3."""
    return gtsam.symbol("q", 4 * slot + index)


def board(index: int, epoch: int = 0) -> int:
    """`o_T_f`: Pose3."""
    return gtsam.symbol("f", EPOCHS * index + epoch)


def page(index: int) -> int:
    """Apparent side length [m] and print scale of a board: Vector2."""
    return gtsam.symbol("h", index)


def base(station: int) -> int:
    """`o_T_b` of a station: Pose3."""
    return gtsam.symbol("b", station)


def point(index: int) -> int:
    """A pipe point in {o}: Point3."""
    return gtsam.symbol("p", index)


def axis_start(pipe: int) -> int:
    """First point of a pipe's axis in {o}: Point3; only the line matters."""
    return gtsam.symbol("u", pipe)


def axis_end(pipe: int) -> int:
    """Second point of a pipe's axis in {o}: Point3."""
    return gtsam.symbol("v", pipe)


def radius(pipe: int) -> int:
    """A pipe's radius [m]: Vector1."""
    return gtsam.symbol("r", pipe)


def inset(pipe: int) -> int:
    """How far the visible edges of a pipe lie inside its outline [m]: Vector1."""
    return gtsam.symbol("w", pipe)


CAMERA_INDEX = {"m_left": 0, "m_right": 1, "b_rgb": 2}


def intrinsics(camera: str) -> int:
    """A camera's pinhole, and what its given lens model leaves over: Cal3DS2."""
    return gtsam.symbol("k", CAMERA_INDEX[camera])


def extrinsics(camera: str) -> int:
    """`m_left_T_m_right` or `b_T_rgb`: Pose3."""
    return gtsam.symbol("e", CAMERA_INDEX[camera])


DEPTH: int = gtsam.symbol("d", 0)
"""Kinect depth: true = measured * (1 + scale) + offset; Vector2 (offset [m], scale)."""
DEPTH_RAYS: int = gtsam.symbol("g", 0)
"""Rays of the depth camera, z = 1: true = given * (1 + scale) + shift; Vector3 (shift x, shift y [rad], scale)."""


_LANDMARK = ord("l")


def kind(key: int) -> str:
    """The letter of a key: its highest byte. Asked for all factors' keys, for which GTSAM's own Symbol is slow."""
    return chr(key >> 56)


def landmark_among(several: Iterable[int]) -> int:
    """The first landmark's key. Asked for all factors that see one.

    Raises:
        ValueError: there is none.
    """
    for key in several:
        if key >> 56 == _LANDMARK:
            return key
    raise ValueError("no landmark among the keys")


def index(key: int) -> int:
    """The number of a key."""
    return int(gtsam.Symbol(key).index())


def words(key: int) -> str:
    """A variable's name for people."""
    symbol = gtsam.Symbol(key)
    index = symbol.index()
    letter = chr(symbol.chr())
    if letter == "f":
        index //= EPOCHS
    return _WORDS.get(letter, "variable {}").replace("{}", str(index))
