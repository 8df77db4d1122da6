"""Pictures of marker boards with exact truth: a supersampled page, blurred, shaded, with noise."""

from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..factors.camera import CameraModel
from ..factors.rig import Board
from ..frontends.fiducials.dictionaries import marker_dictionary
from ..frontends.undistort import undistort

Float = NDArray[Any]


@dataclass(frozen=True, slots=True)
class Photography:
    """How a picture is taken. Grey values are those of an 8-bit image."""

    blur_px: float = 0.7
    """Standard deviation of the lens' point spread."""
    motion_px: tuple[float, float] = (0.0, 0.0)
    """Path of the image during the exposure; the truth holds for its middle."""
    noise: float = 2.0
    black: float = 25.0
    white: float = 225.0
    background: float = 110.0
    shading: tuple[float, float] = (0.0, 0.0)
    """Relative change of the light over the width and over the height of the image."""
    vignetting: float = 0.0
    """Relative loss of light in the image's corners."""
    gamma: float = 1.0
    """Grey values are the light to the power 1 / gamma; `black`, `white` and `background` are grey values."""
    supersampling: int = 8


def marker_corners(board: Board, side_m: float | None = None) -> dict[int, Float]:
    """Corners of each marker in {f}, shape (4, 3), order 0..3 = (-,-), (+,-), (+,+), (-,+)."""
    half = (board.side_m if side_m is None else side_m) / 2
    square = half * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    corners = {}
    for marker in board.markers:
        c, s = np.cos(marker.rotation_rad), np.sin(marker.rotation_rad)
        flat = square @ np.array([[c, s], [-s, c]]) + marker.centre_m
        corners[marker.id] = np.column_stack([flat, np.zeros(4)])
    return corners


def project(camera: CameraModel, camera_T_f: Float, points_f: Float) -> Float:
    """Ideal pixels of points in {f}, shape (n, 2)."""
    local = points_f @ camera_T_f[:3, :3].T + camera_T_f[:3, 3]
    image = local @ camera.K.T
    return image[:, :2] / image[:, 2:]


def render_board(
    board: Board,
    page_m: tuple[float, float],
    camera: CameraModel,
    camera_T_f: Float,
    photography: Photography,
    rng: np.random.Generator,
) -> NDArray[np.uint8]:
    """One 8-bit image of the board, shape (height, width). The page is white, everything else `background`."""
    photography = _in_light(photography)
    image = np.full((camera.height, camera.width), photography.background)
    page = np.array(page_m) / 2
    outline = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * [*page, 0]
    x0, y0, x1, y1 = _window(camera, project(camera, camera_T_f, outline))
    if x1 > x0 and y1 > y0:
        image[y0:y1, x0:x1] = _page(board, page, camera, camera_T_f, photography, (x0, y0, x1, y1))
    image = _blurred(image, photography)
    image *= _light(camera, photography)
    if photography.gamma != 1.0:
        image = 255.0 * np.clip(image / 255.0, 0.0, None) ** (1.0 / photography.gamma)
    noisy = image + rng.normal(0.0, photography.noise, image.shape) if photography.noise > 0 else image
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


def _in_light(photography: Photography) -> Photography:
    """Black, white and background as what the response makes grey values of."""
    if photography.gamma == 1.0:
        return photography
    names = ("black", "white", "background")
    light = {n: 255.0 * (getattr(photography, n) / 255.0) ** photography.gamma for n in names}
    return replace(photography, **light)


def _window(camera: CameraModel, corners: Float) -> tuple[int, int, int, int]:
    """The part of the image that can show the page: all of it where the lens bends."""
    if camera.distortion_model != "none" and camera.D.any():
        return 0, 0, camera.width, camera.height
    low, high = np.floor(corners.min(0) - 4).astype(int), np.ceil(corners.max(0) + 5).astype(int)
    return max(low[0], 0), max(low[1], 0), min(high[0], camera.width), min(high[1], camera.height)


def _page(
    board: Board,
    page: Float,
    camera: CameraModel,
    camera_T_f: Float,
    photography: Photography,
    window: tuple[int, int, int, int],
) -> Float:
    """The window before blur: each pixel the mean of its supersamples, in bands to save memory."""
    x0, y0, x1, y1 = window
    s = photography.supersampling
    depth = abs(camera_T_f[2, 3])
    texel = depth / camera.fx / s
    texture, x_origin, y_origin = _texture(board, page, texel, photography)
    to_plane = np.linalg.inv(np.column_stack([camera_T_f[:3, 0], camera_T_f[:3, 1], camera_T_f[:3, 3]]))
    to_plane = to_plane @ np.linalg.inv(camera.K)
    out = np.empty((y1 - y0, x1 - x0))
    columns = x0 + (np.arange((x1 - x0) * s) + 0.5) / s - 0.5
    for top in range(y0, y1, 32):
        bottom = min(top + 32, y1)
        rows = top + (np.arange((bottom - top) * s) + 0.5) / s - 0.5
        grid = np.stack(np.meshgrid(columns, rows), -1)
        ideal = undistort(camera, grid)[0]
        plane = ideal @ to_plane[:, :2].T + to_plane[:, 2]
        xy = plane[..., :2] / plane[..., 2:]
        map_x = ((xy[..., 0] - x_origin) / texel).astype(np.float32)
        map_y = ((y_origin - xy[..., 1]) / texel).astype(np.float32)
        # outside the page, or behind the camera: the background
        outside = (np.abs(xy) > page).any(-1) | ~np.isfinite(xy).all(-1) | (plane[..., 2] <= 0)
        fine = cv2.remap(texture, map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE).astype(float)
        fine[outside] = photography.background
        out[top - y0 : bottom - y0] = fine.reshape(bottom - top, s, x1 - x0, s).mean((1, 3))
    return out


def _texture(
    board: Board, page: Float, texel: float, photography: Photography
) -> tuple[NDArray[np.float32], float, float]:
    """The printed page, and where the centre of its top left texel lies in {f}."""
    width, height = (int(np.ceil(2 * side / texel)) + 2 for side in page)
    texture = np.full((height, width), photography.white, np.float32)
    x_origin, y_origin = -page[0] - texel / 2, page[1] + texel / 2
    dictionary = marker_dictionary(board.dictionary)
    corners = marker_corners(board)
    fine = 24
    for marker in board.markers:
        cells = np.kron(dictionary.pattern(marker.id).T, np.ones((fine, fine)))
        n = len(cells)
        target = np.stack(
            [(corners[marker.id][:3, 0] - x_origin) / texel, (y_origin - corners[marker.id][:3, 1]) / texel], -1
        )
        source = np.array([[0.0, 0.0], [n, 0.0], [n, n]]) - 0.5
        affine = cv2.getAffineTransform(source.astype(np.float32), target.astype(np.float32))
        value = (photography.black + (photography.white - photography.black) * cells).astype(np.float32)
        value = np.pad(value, fine, constant_values=np.float32(photography.white))
        affine[:, 2] -= affine[:, :2] @ [fine, fine]
        cv2.warpAffine(
            value, affine, (width, height), dst=texture, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_TRANSPARENT
        )
    return texture, x_origin, y_origin


def _blurred(image: Float, photography: Photography) -> Float:
    if any(photography.motion_px):
        image = _motion(image, photography.motion_px)
    if photography.blur_px > 0:
        image = cv2.GaussianBlur(image, (0, 0), photography.blur_px, borderType=cv2.BORDER_REPLICATE)
    return image


def _motion(image: Float, path: tuple[float, float]) -> Float:
    """Mean over the path, its middle at the image's own place."""
    steps = max(2, int(np.ceil(4 * np.hypot(*path))))
    total = np.zeros_like(image)
    for at in (np.arange(steps) + 0.5) / steps - 0.5:
        shift = np.array([[1.0, 0.0, at * path[0]], [0.0, 1.0, at * path[1]]])
        size = (image.shape[1], image.shape[0])
        total += cv2.warpAffine(image, shift, size, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    return total / steps


def _light(camera: CameraModel, photography: Photography) -> Float:
    x = np.linspace(-0.5, 0.5, camera.width)[None, :]
    y = np.linspace(-0.5, 0.5, camera.height)[:, None]
    shade = 1.0 + photography.shading[0] * x + photography.shading[1] * y
    return shade * (1.0 - photography.vignetting * 2 * (x**2 + y**2))
