"""A small recording of a cell, written in a moment: markers of one board seen by a moving stereo camera, and picks.

The messages come as a list, so that a test can spoil what it is about before the log is written.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from surecut.factors.camera import CameraModel
from surecut.io import build
from surecut.io.writer import McapSink
from surecut.simulation.page import marker_cells

START_NS = 1_000_000_000_000
STEP_NS = 100_000_000
K = np.array([[300.0, 0, 179.5], [0, 300.0, 119.5], [0, 0, 1]])
BASELINE_M = 0.12
LEFT = CameraModel("m_left", 360, 240, K, "none", np.zeros(0), np.eye(3), 0.0)
RIGHT = CameraModel("m_right", 360, 240, K, "none", np.zeros(0), np.eye(3), BASELINE_M)
CENTRES = {0: (-0.05, 0.09), 1: (0.05, 0.09), 2: (-0.05, -0.09), 3: (0.05, -0.09)}
SIDE_M = 0.075
POINT_F = np.array([0.2, 0.05, 0.1])
"""The pipe point, in the page frame; {b} is the page frame moved by the mount."""
POINT_B = POINT_F - np.array([0.3, 0.0, 0.0])
RIG = """
version: 1
boards:
  - id: f0
    markers:
      - {id: 0, centre_m: [-0.05, 0.09]}
      - {id: 1, centre_m: [0.05, 0.09]}
      - {id: 2, centre_m: [-0.05, -0.09]}
      - {id: 3, centre_m: [0.05, -0.09]}
mount: {board: f0, f_T_b: {translation_m: [0.3, 0, 0]}}
"""
INFO, IMAGE, PICK = "sensor_msgs/msg/CameraInfo", "sensor_msgs/msg/Image", "surecut_msgs/msg/PixelPick"
MARKERS = "apriltag_msgs/msg/AprilTagDetectionArray"


@dataclass(frozen=True, slots=True)
class Entry:
    """One message to write."""

    topic: str
    type_name: str
    stamp_ns: int
    make: Callable[[int], Any]
    """The message for a stamp."""


def f_T_m(number: int) -> np.ndarray:
    """The left camera at a moment, about 1.2 m before the board, moving sideways and up and down."""
    t = 0.15 * number
    place = np.array([0.25 * np.sin(t), 0.12 * np.sin(2.3 * t), 1.2 + 0.1 * np.cos(t)])
    z = np.array([0.1, 0.0, 0.0]) - place
    z /= np.linalg.norm(z)
    x = np.cross(np.array([0.0, -1.0, 0.0]), z)
    x /= np.linalg.norm(x)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
    pose[:3, 3] = place
    return pose


def pixels(points_f: np.ndarray, number: int, right: bool) -> np.ndarray:
    pose = f_T_m(number)
    local = (points_f - pose[:3, 3]) @ pose[:3, :3] - (np.array([BASELINE_M, 0, 0]) if right else 0.0)
    image = local @ K.T
    return image[:, :2] / image[:, 2:]


def corners_f(marker: int) -> np.ndarray:
    signs = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], float)
    return np.array([*CENTRES[marker], 0.0]) + 0.5 * SIDE_M * signs


def messages(moments: int = 25, picks: Iterable[int] = (2, 8, 14), seed: int = 0) -> list[Entry]:
    """The sound recording."""
    rng = np.random.default_rng(seed)
    entries = []
    for number in range(moments):
        stamp = START_NS + number * STEP_NS
        for side, camera in (("left", LEFT), ("right", RIGHT)):
            entries.append(info(f"/m/{side}/camera_info", stamp, camera))
            seen = {m: pixels(corners_f(m), number, side == "right") + rng.normal(0, 0.1, (4, 2)) for m in CENTRES}
            entries.append(markers(f"/m/{side}/markers", stamp, seen))
        if number in picks:
            u, v = pixels(POINT_F[None], number, False)[0] + rng.normal(0, 0.5, 2)
            entries.append(pick(stamp, "m_left", u, v))
    return entries


def info(topic: str, stamp: int, camera: CameraModel) -> Entry:
    return Entry(topic, INFO, stamp, lambda t: build.camera_info(t, camera.name, camera))


def markers(topic: str, stamp: int, seen: dict[int, np.ndarray]) -> Entry:
    return Entry(topic, MARKERS, stamp, lambda t: build.marker_detections(t, "m", "DICT_4X4_50", seen))


def pick(
    stamp: int, camera: str, u: float, v: float, point: str = "P1", role: str = "cut", sigma: float = 1.0
) -> Entry:
    return Entry("/picks", PICK, stamp, lambda t: build.pixel_pick(t, camera, point, role, (u, v), sigma))


def image(topic: str, stamp: int, picture: np.ndarray) -> Entry:
    return Entry(topic, IMAGE, stamp, lambda t: build.image(t, "m", picture, "mono8"))


def shifted(entry: Entry, by_ns: int) -> Entry:
    """The same message with another header stamp, at the same place in the log."""
    return replace(entry, make=lambda t: entry.make(t + by_ns))


def write(path: Path, entries: Iterable[Entry] | None = None, rig: str | None = RIG, **options: Any) -> Path:
    with McapSink(path, **options) as sink:
        if rig is not None:
            sink.attach("rig.yaml", "application/yaml", rig)
        for entry in messages() if entries is None else entries:
            sink.write(entry.topic, entry.type_name, entry.make(entry.stamp_ns), entry.stamp_ns)
    return path


def pictures(moments: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """The board on a wall of blotches, left and right: a plane, so that a homography draws it."""
    wall = _wall()
    return [(_seen(wall, n, False), _seen(wall, n, True)) for n in range(moments)]


def _wall() -> np.ndarray:
    """Grey values of the plane of the page, 1 mm a pixel, 3 m by 2 m about its centre, y up."""
    rng = np.random.default_rng(5)
    coarse = [
        cv2.resize(rng.normal(size=(n, 3 * n // 2)), (3000, 2000), interpolation=cv2.INTER_CUBIC) for n in (40, 160)
    ]
    wall = np.clip(110 + 35 * coarse[0] + 30 * coarse[1], 0, 255)
    wall[850:1150, 1395:1605] = 230
    for marker, (x, y) in CENTRES.items():
        cells = marker_cells("DICT_4X4_50", marker)
        printed = cv2.resize(cells, (75, 75), interpolation=cv2.INTER_NEAREST)
        row, column = round(1000 - 1000 * y - 37.5), round(1500 + 1000 * x - 37.5)
        wall[row : row + 75, column : column + 75] = 25 + 200 * (printed > 0)
    return wall.astype(np.uint8)


def _seen(wall: np.ndarray, number: int, right: bool) -> np.ndarray:
    pose = f_T_m(number)
    shift = np.array([BASELINE_M, 0, 0]) if right else np.zeros(3)
    rotation, translation = pose[:3, :3].T, -pose[:3, :3].T @ pose[:3, 3] - shift
    wall_to_page = np.array([[1e-3, 0, -1.4995], [0, -1e-3, 0.9995], [0, 0, 1]])
    fine = np.array([[3, 0, 1], [0, 3, 1], [0, 0, 1]]) @ K
    homography = fine @ np.column_stack([rotation[:, :2], translation]) @ wall_to_page
    large = cv2.warpPerspective(wall, homography, (1080, 720), flags=cv2.INTER_LINEAR, borderValue=90)
    noise = np.random.default_rng([number, right]).normal(0, 1.5, (240, 360))
    return np.clip(cv2.resize(large, (360, 240), interpolation=cv2.INTER_AREA) + noise, 0, 255).astype(np.uint8)


def filmed(film: list[tuple[np.ndarray, np.ndarray]]) -> list[Entry]:
    """A recording with images instead of detected markers; the picks stay."""
    entries = [e for e in messages(len(film)) if e.type_name != MARKERS]
    for number, (left, right) in enumerate(film):
        stamp = START_NS + number * STEP_NS
        entries += [image("/m/left/image_raw", stamp, left), image("/m/right/image_raw", stamp, right)]
    return sorted(entries, key=lambda e: e.stamp_ns)
