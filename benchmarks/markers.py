"""Time of the marker front end where the board was in the frame before: one stereo pair, and one large image.

python benchmarks/markers.py [--seconds S]

Nearly all frames follow the markers of the one before; each fifteenth reads the whole image again. Both are in the
figures. The processor's time stands beside the clock's: where they differ, the core was shared with others.
"""

import argparse
import time
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from surecut.factors.camera import CameraModel
from surecut.factors.rig import Board, Marker, Rig
from surecut.frontends.fiducials.detector import MarkerFrontEnd
from surecut.simulation.marker_images import Photography, render_board

Image = NDArray[np.uint8]

PLACES = ((-0.096, 0.0555), (0.096, 0.0555), (0.096, -0.0555), (-0.096, -0.0555))
PAGE_M = (0.297, 0.21)
BASELINE_M = 0.15


@dataclass(frozen=True, slots=True)
class Setting:
    """A camera, the board's distance, and whether there are two of the camera."""

    width: int
    height: int
    focal_px: float
    depth_m: float
    distorted: bool
    stereo: bool


SETTINGS = (
    Setting(360, 240, 270.0, 1.2, False, True),
    Setting(360, 240, 270.0, 0.8, True, True),
    Setting(1280, 720, 960.0, 1.2, False, False),
    Setting(1280, 720, 960.0, 0.8, True, False),
)


def board() -> Board:
    markers = tuple(Marker(id=k, centre_m=place) for k, place in enumerate(PLACES))
    return Board(id="f0", side_m=0.075, markers=markers)


def camera(setting: Setting) -> CameraModel:
    K = np.array(
        [
            [setting.focal_px, 0.0, (setting.width - 1) / 2],
            [0.0, setting.focal_px, (setting.height - 1) / 2],
            [0.0, 0.0, 1.0],
        ]
    )
    D = np.array([-0.05, 0.02, 0.0, 0.0, 0.0]) if setting.distorted else np.zeros(0)
    return CameraModel("m_left", setting.width, setting.height, K, "plumb_bob", D, np.eye(3), None)


def sequence(setting: Setting, frames: int) -> list[tuple[Image, ...]]:
    """A hand that moves by some pixels a frame; noise, blur and a bent response."""
    rng = np.random.default_rng(0)
    taken = Photography(noise=2.0, blur_px=0.7, gamma=1.4, supersampling=4)
    result = []
    for k in range(frames):
        pose = np.eye(4)
        pose[:3, :3] = cv2.Rodrigues(np.array([0.25 + 0.004 * k, -0.2, 0.1 + 0.003 * k]))[0] @ np.diag([1.0, -1, -1])
        pose[:3, 3] = 0.004 * k + 0.02, 0.02 - 0.003 * k, setting.depth_m
        images = []
        for x in (0.0, BASELINE_M) if setting.stereo else (0.0,):
            seen = pose.copy()
            seen[0, 3] -= x
            images.append(render_board(board(), PAGE_M, camera(setting), seen, taken, rng))
        result.append(tuple(images))
    return result


def measure(setting: Setting, seconds: float) -> None:
    frames = sequence(setting, 15)
    ends = [MarkerFrontEnd(Rig(boards=(board(),)), camera(setting), "m_left") for _ in frames[0]]
    walls, found, begin = [], [], time.perf_counter()
    used = 0.0
    order = frames + frames[-2:0:-1]
    while time.perf_counter() - begin < seconds:
        for stamp, images in enumerate(order):
            clock, busy = time.perf_counter(), time.process_time()
            found.append(sum(len(e.process(stamp, i)[0]) for e, i in zip(ends, images, strict=True)))
            walls.append(1e3 * (time.perf_counter() - clock))
            used += 1e3 * (time.process_time() - busy)
    wall = np.array(walls[len(order) :])
    kind = "pair" if setting.stereo else "image"
    lens = "distorted" if setting.distorted else "pinhole"
    print(
        f"{setting.width}x{setting.height} {kind}, {setting.depth_m} m, {lens}: "
        f"mean {wall.mean():.1f}, median {np.median(wall):.1f}, 95 % {np.quantile(wall, 0.95):.1f} ms; "
        f"processor {used / len(walls):.1f} ms; markers {np.mean(found):.1f}",
        flush=True,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=5.0)
    seconds = parser.parse_args().seconds
    cv2.setNumThreads(1)
    for setting in SETTINGS:
        measure(setting, seconds)


if __name__ == "__main__":
    main()
