"""The operator's clicks: on the middle of the pipe's outline, where the point is really seen."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..factors.camera import CameraModel
from .cell import PipeTruth
from .rigid import inverse, transform
from .sensor import project
from .stage import View

Float = NDArray[np.float64]
_MARGIN_PX = 12


@dataclass(frozen=True, slots=True)
class Click:
    """One click in one image, raw pixels."""

    camera: str
    point_id: str
    role: str
    uv_px: tuple[float, float]


def clicks(
    view: View,
    camera: CameraModel,
    w_T_camera: Float,
    pipe: PipeTruth,
    points: Mapping[str, tuple[str, Float]],
    sigma_px: float,
    rng: np.random.Generator,
) -> list[Click]:
    """Clicks on the points that this image shows: their rays pass through the axis, but for the hand's error."""
    found = []
    for point_id, (role, place) in points.items():
        u, v = project(camera, transform(inverse(w_T_camera), place))[0]
        inside = _MARGIN_PX < u < camera.width - _MARGIN_PX and _MARGIN_PX < v < camera.height - _MARGIN_PX
        if inside and _seen(view, w_T_camera[:3, 3], place, pipe):
            du, dv = rng.normal(0, sigma_px, 2)
            found.append(Click(camera.name, point_id, role, (float(u + du), float(v + dv))))
    return found


def _seen(view: View, eye: Float, place: Float, pipe: PipeTruth) -> bool:
    """Whether the pipe's whole width is the first thing met at the point, from this eye."""
    towards = place - eye
    reach = float(np.linalg.norm(towards))
    side = np.cross(towards, pipe.axis)
    side *= 0.8 * pipe.radius_m / np.linalg.norm(side)
    rays = np.array([[*eye, *((towards + share * side) / reach)] for share in (-1.0, 0.0, 1.0)], np.float32)
    hits = view.cast(rays)
    on_pipe = hits.body == view.stage.body_index("pipe")
    close = np.abs(hits.distance - reach) < 3 * pipe.radius_m
    return bool(np.all(on_pipe & close))
