"""Depth and honesty of a board's pose from single images: random pose, blur, motion, light, response; a drawn rig.

python benchmarks/board_pose.py [--images N] [--exact]

Truth is drawn from what the rig file says: focal length, centre, page scale, side length, places of the markers. With
`--exact` the rig is right to the last digit, and says so.
"""

import argparse
from dataclasses import dataclass

import cv2
import gtsam
import numpy as np
from numpy.typing import NDArray

from surecut.estimator.run import estimate
from surecut.estimator.surfaces import lay_on_surfaces
from surecut.factors.camera import CameraModel
from surecut.factors.errors import SurecutError
from surecut.factors.rig import Board, Marker, Rig
from surecut.frontends.fiducials.detector import MarkerFrontEnd
from surecut.simulation.marker_images import Photography, render_board

Float = NDArray[np.float64]

PAGE_M = (0.210, 0.297)
PLACES_M = ((-0.05, 0.09), (0.05, 0.09), (-0.05, -0.09), (0.05, -0.09))
INK = 0.06
"""Light that ink throws back, as a share of what paper does."""


@dataclass(frozen=True, slots=True)
class View:
    """One image's outcome."""

    depth_m: float
    depth_error_m: float
    nees_per_dof: float
    rotation_error_rad: float


@dataclass(frozen=True, slots=True)
class Size:
    """A camera."""

    width: int
    height: int
    focal_px: float

    def model(self, focal_rel: float = 0.0, centre: Float | None = None) -> CameraModel:
        f = self.focal_px * (1.0 + focal_rel)
        x, y = (np.array([self.width, self.height]) - 1) / 2 + (0.0 if centre is None else centre)
        K = np.array([[f, 0.0, x], [0.0, f, y], [0.0, 0.0, 1.0]])
        return CameraModel("m_left", self.width, self.height, K, "none", np.zeros(0), np.eye(3), None)


SIZES = (Size(360, 240, 270.0), Size(640, 480, 500.0))


def rig(exact: bool) -> Rig:
    """The rig file; its lens model is exact, because `render_board` is fast without one."""
    small = {"side_sigma_m": 1e-6, "print_scale_sigma": 1e-6, "centre_sigma_m": 1e-6} if exact else {}
    markers = tuple(Marker(id=i, centre_m=place) for i, place in enumerate(PLACES_M))
    made = Rig(boards=(Board(id="f0", markers=markers, **small),))
    freeze = ("focal", "centre", "distortion") if exact else ("distortion",)
    left = made.cameras.m_left.model_copy(update={"freeze": freeze})
    return made.model_copy(update={"cameras": made.cameras.model_copy(update={"m_left": left})})


def drawn(made: Rig, size: Size, exact: bool, rng: np.random.Generator) -> tuple[Board, CameraModel]:
    """A true page and a true camera that the rig file allows."""
    board, camera = made.boards[0], made.cameras.m_left
    if exact:
        return board, size.model()
    scale = 1.0 + rng.normal(0.0, board.print_scale_sigma)
    markers = tuple(
        Marker(id=m.id, centre_m=tuple(scale * (np.array(m.centre_m) + rng.normal(0.0, board.centre_sigma_m, 2))))
        for m in board.markers
    )
    side = scale * board.side_m + rng.normal(0.0, board.side_sigma_m)
    true = size.model(rng.normal(0.0, camera.focal_sigma_rel), rng.normal(0.0, camera.centre_sigma_px, 2))
    return board.model_copy(update={"markers": markers, "side_m": side}), true


def placed(rng: np.random.Generator, size: Size, nearest_m: float, farthest_m: float) -> Float:
    """`camera_T_f`: any roll, tilted by up to 40 degrees, somewhere in the image."""
    z, about, tilt = rng.uniform(nearest_m, farthest_m), rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(0, 40))
    turn = cv2.Rodrigues(tilt * np.array([np.cos(about), np.sin(about), 0.0]))[0]
    roll = cv2.Rodrigues(np.array([0.0, 0.0, rng.uniform(0, 2 * np.pi)]))[0]
    room = np.maximum(np.array([size.width, size.height]) / 2 / size.focal_px * z - 0.17, 0.0)
    pose = np.eye(4)
    pose[:3, :3] = turn @ np.diag([1.0, -1.0, -1.0]) @ roll
    pose[:3, 3] = *(rng.uniform(-1, 1, 2) * room), z
    return pose


def photography(rng: np.random.Generator) -> Photography:
    """Blur, motion in every third image, light from one side, noise, response."""
    gamma, white = rng.uniform(1.0, 2.2), rng.uniform(130, 240)
    return Photography(
        blur_px=rng.uniform(0.5, 1.2),
        motion_px=tuple(rng.normal(0.0, 1.0, 2)) if rng.random() < 1 / 3 else (0.0, 0.0),
        noise=rng.uniform(1.0, 3.0),
        black=white * INK ** (1.0 / gamma),
        white=white,
        shading=(float(rng.uniform(-0.3, 0.3)), float(rng.uniform(-0.3, 0.3))),
        vignetting=rng.uniform(0.0, 0.3),
        gamma=gamma,
        supersampling=6,
    )


def look(size: Size, exact: bool, rng: np.random.Generator) -> View | None:
    """One image through the estimator; None where the board was not found."""
    made = rig(exact)
    board, camera = drawn(made, size, exact, rng)
    pose = placed(rng, size, 0.4, 2.0)
    image = render_board(board, PAGE_M, camera, pose, photography(rng), rng)
    sightings, _ = MarkerFrontEnd(made, size.model(), "m_left").process(0, image)
    try:
        result = estimate(sightings, made, {"m_left": size.model()}, lay_on_surfaces)
        page = next(p for p in result.poses if p.name == "f0")
    except (SurecutError, StopIteration):
        return None
    # fixed axes, translation first: the tangent of the result's covariance
    turn = gtsam.Rot3.Logmap(gtsam.Rot3(page.matrix[:3, :3] @ pose[:3, :3].T))
    error = np.concatenate([page.matrix[:3, 3] - pose[:3, 3], turn])
    assert page.covariance is not None
    nees = float(error @ np.linalg.solve(page.covariance, error)) / 6
    return View(float(pose[2, 3]), float(error[2]), nees, float(np.linalg.norm(turn)))


def measure(size: Size, images: int, exact: bool, seed: int) -> list[View]:
    """So many images in which the board was found."""
    rng, views = np.random.default_rng([seed, size.width]), []
    tries = 0
    while len(views) < images and tries < 4 * images:
        tries += 1
        view = look(size, exact, rng)
        if view is not None:
            views.append(view)
    return views


def summary(size: Size, views: list[View]) -> str:
    """One line."""
    relative = np.array([v.depth_error_m / v.depth_m for v in views])
    nees = np.array([v.nees_per_dof for v in views])
    turned = np.degrees(np.mean([v.rotation_error_rad for v in views]))
    return (
        f"{size.width}x{size.height}: {len(views)} images, depth error {100 * relative.mean():+.3f} % mean, "
        f"{100 * np.sqrt((relative**2).mean()):.3f} % rms; turned by {turned:.2f} deg; "
        f"NEES/dof {nees.mean():.2f} +/- {nees.std() / np.sqrt(len(nees)):.2f}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--images", type=int, default=100)
    parser.add_argument("--exact", action="store_true")
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    for size in SIZES:
        views = measure(size, arguments.images, arguments.exact, arguments.seed)
        print(summary(size, views), flush=True)


if __name__ == "__main__":
    main()
