"""Single views of a scene: what a camera sees from one pose, sharp, or blurred by its motion."""

from collections.abc import Callable, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from ..factors.camera import CameraModel
from .faults import PAGE_M
from .page import PrintedMarker, page_texture
from .scenario import Light
from .sensor import RayGrid, expose, ray_grid
from .stage import Lamp, Stage, View, build_stage
from .surfaces import Body, Patch, Rectangle
from .textures import brick, poster

Float = NDArray[np.float64]
_ORDER = (0, 2, 3, 1)
"""Of the four places in a pixel; 0 and 3, 1 and 2 lie opposite each other."""


def render_light(
    view: View,
    grid: RayGrid,
    w_T_camera: Callable[[float], Float],
    exposure_s: float = 0.0,
    colour: bool = False,
) -> NDArray[np.float32]:
    """Radiance image, shape (height, width) or (height, width, 3) BGR.

    Args:
        view: the scene.
        grid: the camera's rays, 2x2 per pixel.
        w_T_camera: pose by time from the middle of the exposure, s.
        exposure_s: shutter time; the sub-samples are spread over it, more of them when the image moves fast.
        colour: BGR instead of grey.
    """
    samples = _schedule(grid, w_T_camera, exposure_s)
    rays = [_rays(grid.directions[place], w_T_camera(share * exposure_s)) for place, share in samples]
    light = view.radiance(np.concatenate(rays), grid.spread, colour)
    shape = (len(samples), grid.height, grid.width, *light.shape[1:])
    return light.reshape(shape).mean(axis=0)


def _schedule(grid: RayGrid, w_T_camera: Callable[[float], Float], exposure_s: float) -> Sequence[tuple[int, float]]:
    still = tuple((place, 0.0) for place in range(len(grid.directions)))
    if exposure_s <= 0 or len(grid.directions) != 4:
        return still
    start, end = w_T_camera(-exposure_s / 2), w_T_camera(exposure_s / 2)
    turn = np.arccos(np.clip((np.trace(start[:3, :3].T @ end[:3, :3]) - 1) / 2, -1, 1))
    blur_px = (turn + np.linalg.norm(end[:3, 3] - start[:3, 3]) / 1.5) / (2 * grid.spread)
    if blur_px < 0.15:
        return still
    return _spread(4 if blur_px < 1.5 else 8 if blur_px < 5 else 16)


def _spread(count: int) -> tuple[tuple[int, float], ...]:
    """Places in the pixel and shares of the exposure, point-symmetric in both, so that edges do not shift."""
    first = [(_ORDER[k % 4], (k + 0.5) / count - 0.5) for k in range(count // 2)]
    return (*first, *((3 - place, -share) for place, share in reversed(first)))


def _rays(directions: NDArray[np.float32], w_T_camera: Float) -> NDArray[np.float32]:
    rays = np.empty((len(directions), 6), np.float32)
    rays[:, :3] = w_T_camera[:3, 3]
    # cv2 keeps to one thread here; BLAS wakes all of them for a product this thin.
    rays[:, 3:] = cv2.transform(directions[:, None], w_T_camera[:3, :3].astype(np.float32))[:, 0]
    return rays


def render_view(
    view: View,
    camera: CameraModel,
    w_T_camera: Float,
    light: Light | None = None,
    rng: np.random.Generator | None = None,
    w_twist: Sequence[float] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
    gain: float | None = None,
    colour: bool = False,
) -> NDArray[np.uint8]:
    """One image, shape (height, width) or (height, width, 3) BGR.

    Args:
        view: the scene, for example `board_stage(...)`'s, placed with `Stage.view`.
        camera: the true camera.
        w_T_camera: pose of its optical frame in the scene, (4, 4).
        light: exposure, gamma and noise (`Light()` when None).
        rng: for the noise; None gives the same noise each time.
        w_twist: motion during the exposure, m/s and rad/s in the camera's frame (translation, rotation).
        gain: radiance to full scale; None exposes so that 98 % of the image is below full scale.
        colour: BGR instead of grey.
    """
    from .rigid import rigid

    settings = light or Light()
    generator = rng if rng is not None else np.random.default_rng(0)
    twist = np.asarray(w_twist, dtype=float)

    def pose(time_s: float) -> Float:
        return w_T_camera @ rigid(twist[3:] * time_s, twist[:3] * time_s)

    image = render_light(view, ray_grid(camera), pose, settings.exposure_s, colour)
    return expose(image, settings, exposure_gain(image) if gain is None else gain, generator)


def exposure_gain(light: NDArray[np.float32]) -> float:
    """Gain that takes the 98th percentile of an image to 0.85 of full scale."""
    return 0.85 / max(float(np.percentile(light, 98)), 1e-3)


def board_stage(
    markers: Sequence[PrintedMarker],
    page_m: tuple[float, float] = PAGE_M,
    dictionary: str = "DICT_4X4_50",
    seed: int = 0,
) -> Stage:
    """A page with markers before a brick wall. World frame = page frame {f} (x right, y up, z out of the page).

    Place it with `stage.view({"page": np.eye(4), "wall": np.eye(4)})`.
    """
    rng = np.random.default_rng([seed, 77])
    x, y = np.array([1.0, 0, 0]), np.array([0, -1.0, 0])
    width, height = page_m
    page = Rectangle(np.array([-width / 2, height / 2, 0]), x, y, width, height)
    wall = Rectangle(np.array([-3.0, 2.0, -0.4]), x, y, 6.0, 4.0)
    sheet = Rectangle(np.array([0.25, 0.5, -0.3]), x, y, 0.5, 0.6)
    bodies = [
        Body("page", [Patch(page, page_texture(markers, dictionary), 0.0002)]),
        Body("wall", [Patch(wall, brick(0.35), 0.0025), Patch(sheet, poster, 0.0015)]),
    ]
    lamps = [Lamp(np.array([*rng.normal((0, 1.0), 0.8), 2.5]), 0.4, 3.0)]
    return build_stage(bodies, lamps, {body.name: np.eye(4) for body in bodies}, rng)
