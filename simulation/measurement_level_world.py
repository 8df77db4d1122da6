"""What one run at measurement level is drawn from, and the pinhole that all of it is seen through."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..factors.rig import Rig
from .measurement_level_scenario import Outliers, Scenario
from .measurement_level_scene import Scene
from .measurement_level_truth import Float, TrueCamera, TrueRig, invert, transform

Bool = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class World:
    """What the measurements of one run are drawn from."""

    scenario: Scenario
    rig: Rig
    nominal: dict[str, TrueCamera]
    true: TrueRig
    scene: Scene
    w_T_m: Float
    w_T_f: dict[str, Float]
    stamps_ns: tuple[int, ...]
    place_stamps_ns: tuple[int, ...]
    points_w: dict[str, Float]
    inset: float
    """How far inside of its outline the pipe's edges are seen, in all views, as a part of its radius."""
    rng: np.random.Generator
    outlier_rng: np.random.Generator
    """Of its own, so that a run with outliers has the scene and noise of the one without."""


def project(camera: TrueCamera, w_T_camera: Float, points_w: Float) -> tuple[Float, Float]:
    """Pixels (n, 2) and depths (n,); pixels of points behind the camera are NaN."""
    points = transform(invert(w_T_camera), points_w)
    depth_m = points[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        pixels = (points @ camera.K.T)[:, :2] / np.where(depth_m > 1e-6, depth_m, np.nan)[:, None]
    return pixels, depth_m


def inside(pixels: Float, camera: TrueCamera, margin_px: float = 0.0) -> Bool:
    low, high = margin_px, np.array([camera.width, camera.height]) - 1.0 - margin_px
    return np.asarray(((pixels >= low) & (pixels <= high)).all(axis=1))


def spoil(pixels: Float, outliers: Outliers, rng: np.random.Generator) -> Float:
    """Some of the pixels thrown somewhere into the square of `size_px` around them."""
    hit = rng.random(len(pixels)) < outliers.share
    return pixels + hit[:, None] * rng.uniform(-outliers.size_px, outliers.size_px, pixels.shape)
