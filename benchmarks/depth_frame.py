"""How long one 640x480 depth image takes on one core: surface samples, the pipe in it, its factor; and registrations.

    OMP_NUM_THREADS=1 python benchmarks/depth_frame.py

Processor time, median of repetitions. The pipe stands before a wall, with the published noise and steps of a Kinect v1.
"""

import time
from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from surecut.factors import keys
from surecut.factors.camera import CameraModel
from surecut.factors.measurements import CylinderSighting
from surecut.factors.noise import gaussian
from surecut.factors.pipe import cylinder_covariance, cylinder_factor
from surecut.frontends.cloud.frontend import CloudFrontEnd
from surecut.frontends.cloud.noise import depth_noise
from surecut.frontends.cloud.point_registration import MapPoints, register_points
from surecut.frontends.cloud.registration import register
from surecut.frontends.pipe.depth_cylinder import DepthImages, PredictedPipe, cylinder_near

Float = NDArray[np.float64]
RADIUS_M, PIPE_M, WALL_M = 0.045, 1.4, 2.2
LANDMARKS = 1000


def main() -> None:
    """Prints a line per part."""
    cv2.setNumThreads(1)
    camera = CameraModel(
        "b_depth", 640, 480, np.array([[585.0, 0, 319.5], [0, 585.0, 239.5], [0, 0, 1]]), "none", np.zeros(5),
        np.eye(3), None,
    )  # fmt: skip
    depth = image(camera)
    clouds, images = CloudFrontEnd(camera, "kinect_v1"), DepthImages(camera, "kinect_v1")
    pipe = PredictedPipe(np.array([0.0, -0.4, PIPE_M]), np.array([0.0, 0.4, PIPE_M]), RADIUS_M, 0.015)
    points = images.points_near(depth, pipe)
    found = cylinder_near(0, "pipe0", points, "kinect_v1", pipe)
    assert isinstance(found, CylinderSighting), found
    parts = {
        "surface samples": milliseconds(lambda: clouds.process(0, depth)),
        "points near the pipe": milliseconds(lambda: images.points_near(depth, pipe)),
        "cylinder": milliseconds(lambda: cylinder_near(0, "pipe0", points, "kinect_v1", pipe)),
        "factor": milliseconds(lambda: cylinder_factor(found, gaussian(cylinder_covariance(found)), keys.base(0), 0)),
    }
    for name, value in parts.items():
        print(f"{name:32s}{value:7.1f} ms")
    print(f"{'depth image in all':32s}{sum(parts.values()):7.1f} ms")
    cloud, guess = clouds.process(0, depth), np.eye(4)
    guess[:3, 3] = 0.03
    print(f"{'cloud on cloud':32s}{milliseconds(lambda: register(cloud, cloud, guess), 7):7.1f} ms")
    rows = np.random.default_rng(0).permutation(len(cloud.points_m))[:LANDMARKS]
    landmarks = MapPoints(cloud.points_m[rows], np.full(len(rows), 0.01), np.zeros((len(rows), 3)))
    sigmas = np.array([0.015, 0.005])
    print(f"{f'{len(rows)} landmarks on a cloud':32s}"
          f"{milliseconds(lambda: register_points(landmarks, cloud, guess, sigmas), 7):7.1f} ms")  # fmt: skip


def image(camera: CameraModel) -> NDArray[np.float32]:
    """An upright pipe before a wall that leans."""
    v, u = np.mgrid[0:480, 0:640]
    x, y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
    wall = WALL_M / (1.0 + 0.2 * x + 0.1 * y)
    a, b, c = 1 + x**2, -2.0 * PIPE_M, PIPE_M**2 - RADIUS_M**2
    inside = b**2 - 4 * a * c
    z = np.where(inside > 0, (-b - np.sqrt(np.maximum(inside, 0))) / (2 * a), wall)
    noise = depth_noise("kinect_v1")
    z = z + np.random.default_rng(0).normal(size=z.shape) * noise.axial(z, 0.0)
    step = noise.step(z)
    return (np.round(z / step) * step).astype(np.float32)


def milliseconds(call: Callable[[], object], repeat: int = 15) -> float:
    """Median processor time."""
    call()
    times = []
    for _ in range(repeat):
        start = time.process_time()
        call()
        times.append(time.process_time() - start)
    return 1e3 * float(np.median(times))


if __name__ == "__main__":
    main()
