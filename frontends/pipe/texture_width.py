"""How wide a pipe is by what is beside it, over many views: where the texture of the background begins.

In one view a stripe of a pipe's finish, a highlight or its own shadow looks like its outline. Over many views it does
not: along a pipe the grey value goes on, beside it other things come into view each time. So the images are cut into
strips along the axis, which are told apart by how much the grey value changes along them, and the width that parts
quiet strips from restless ones in all views together is the pipe's.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from ...factors.camera import CameraModel
from ..undistort import distort
from .surface import flat, sampled

Float = NDArray[np.float64]
Grey = NDArray[np.uint8]

REACH_M = 0.13
"""Strips are cut so far to both sides: the widest pipe, and some of what is behind it."""
THINNEST_M = 0.008
FEWEST_VIEWS = 4
AXIS_M = 0.012
"""How far the axis may be off what was expected."""
USUAL_BLUR_PX = float(np.hypot(0.6, 1 / np.sqrt(6.0)))
"""Of lens and pixel together (0.6, see `limb_model`), and of the linear interpolation between pixels (its kernel is a
triangle of variance 1/6): a strip nearer to the edge than this holds both sides."""
_STRIP_PX, _BIN_PX = 0.5, 3.0
_FEWEST_BINS = 6
_LEAST_CONTRAST = 2.0
"""Variance beside the pipe over that on it; below it a view says nothing."""
_INDEPENDENT, _MOST = 6.0, 3.0
"""As in `surface`: independent bits of texture along a strip, and what one strip may say at most."""
_SHARE = 0.4
"""Neighbouring strips, and the two images of a pair, show the same texture."""
_AGAINST, _AGAINST_INSIDE, _AGAINST_BESIDE, _BESIDE_M = 0.05, 0.07, 0.18, 0.02
"""Share of what all strips say that may speak against the width; or, where another quiet thing such as a second pipe is
in view, of those on the pipe and of those just beside it. On rendered recordings it is 0.01 to 0.05 about the right
axis, and 0.05 to 0.25 about axes that are 5 to 40 degrees or 50 to 150 mm off; on the pipe 0.02 to 0.1, and 0.08 to
0.25; just beside it 0.02 to 0.07, with a second pipe 0.17, and 0.19 to 0.32. Where it is more, nothing is said."""
_NEAR_BORDER = 0.8
"""An axis so far off may be still farther off. Along the line of sight views from one side leave it open: its mean
stays in the middle then."""
_PIXEL_SIGMA = 1 / np.sqrt(12.0)


@dataclass(frozen=True, slots=True)
class PipeView:
    """A picture of a pipe that is known roughly."""

    image: Grey
    camera: CameraModel
    point_a_m: Float
    """Shape (3,), one end of the part that is looked at, on the axis, in the camera's frame."""
    point_b_m: Float
    o_R_c: Float
    """Shape (3, 3): the camera's axes in a frame that all views share."""


@dataclass(frozen=True, slots=True)
class TextureWidth:
    """What the background says about a pipe."""

    radius_m: float
    sigma_m: float
    offset_m: Float
    """Shape (3,): by how much the axis is off the expected one, in the frame that the views share, across the axis."""
    views: int


@dataclass(frozen=True, slots=True)
class _Strips:
    """One view: what each place beside the axis says for the pipe's surface, summed up from one side."""

    total: Float
    """(n + 1,), at the borders of the strips."""
    across_o: Float
    """(3,), the direction of growing distance."""
    blurred_m: float
    """How far inside the edge strips begin to look like the background."""
    pixel_m: float
    distance_m: float
    """Of the axis from the camera."""


def width_by_texture(views: Sequence[PipeView]) -> TextureWidth | None:
    """The radius that all views agree on; None where too few of them show texture beside the pipe."""
    borders = _borders(views)
    strips = [s for s in (_strips(view, borders) for view in views) if s is not None]
    if len(strips) < FEWEST_VIEWS:
        return None
    axis = views[0].o_R_c @ (views[0].point_b_m - views[0].point_a_m)
    across = _across(axis / np.linalg.norm(axis))
    pixel = float(np.median([s.pixel_m for s in strips]))
    radii = np.arange(THINNEST_M, REACH_M - AXIS_M, 0.25 * pixel)
    steps = np.arange(-AXIS_M, AXIS_M + 1e-9, 0.5 * pixel)
    offsets = np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1).reshape(-1, 2)
    score = np.zeros((len(offsets), len(radii)))
    for one in strips:
        middle = (offsets @ (across @ one.across_o))[:, None]
        inner = np.maximum(_visible(radii, one.distance_m) - one.blurred_m, 0.0)
        high = np.interp((middle + inner).ravel(), borders, one.total)
        low = np.interp((middle - inner).ravel(), borders, one.total)
        score += (high - low).reshape(score.shape)
    # What is inside counts for the pipe, what is outside against it: twice the inside, less all.
    share = np.exp(2 * _SHARE * (score - score.max()))
    share /= share.sum()
    by_radius, by_offset = share.sum(axis=0), share.sum(axis=1)
    mean = float(by_radius @ radii)
    spread = float(np.sqrt(by_radius @ (radii - mean) ** 2))
    offset = by_offset @ offsets
    if not radii[1] < mean < radii[-2] or spread > 2 * pixel or np.abs(offset).max() > _NEAR_BORDER * AXIS_M:
        return None
    width = TextureWidth(mean, float(np.hypot(spread, _PIXEL_SIGMA * pixel)), offset @ across, len(strips))
    return width if _agreed(strips, borders, width) else None


def _visible(radius_m: Float, distance_m: float) -> Float:
    """Half the width that a cylinder covers of the plane through its axis: its outline touches it nearer by."""
    return radius_m / np.sqrt(1.0 - np.minimum(radius_m / distance_m, 0.9) ** 2)


def _agreed(strips: Sequence[_Strips], borders: Float, width: TextureWidth) -> bool:
    """Do nearly all strips agree: those on the pipe that it is there, and those beside it that it is not?"""
    place = 0.5 * (borders[1:] + borders[:-1])
    for_it, against = np.zeros(3), np.zeros(3)
    for one in strips:
        beyond = np.abs(place - float(width.offset_m @ one.across_o)) + one.blurred_m
        beyond -= float(_visible(np.array(width.radius_m), one.distance_m))
        gain, inside, beside = np.diff(one.total), beyond < 0, (beyond >= 0) & (beyond < _BESIDE_M)
        all_of_it = np.where(inside, gain, -gain)
        said = np.array([all_of_it, all_of_it * inside, all_of_it * beside])
        for_it += np.maximum(said, 0.0).sum(axis=1)
        against += np.maximum(-said, 0.0).sum(axis=1)
    share = against / np.maximum(for_it + against, 1e-9)
    return bool(share[0] < _AGAINST or (share[1] < _AGAINST_INSIDE and share[2] < _AGAINST_BESIDE))


def _borders(views: Sequence[PipeView]) -> Float:
    """Borders of the strips, metres beside the axis, the same in all views."""
    pixel = np.median([0.5 * (v.point_a_m + v.point_b_m)[2] / v.camera.fx for v in views]) if views else 1e-3
    count = int(np.ceil(REACH_M / (_STRIP_PX * float(np.clip(pixel, 2e-4, 1e-2)))))
    return np.linspace(-REACH_M, REACH_M, 2 * count + 1)


def _strips(view: PipeView, borders: Float) -> _Strips | None:
    """The strips of one view; None where it shows no texture beside the pipe, or too little of the pipe."""
    middles = 0.5 * (borders[1:] + borders[:-1])
    cut = _cut(view, middles)
    if cut is None:
        return None
    grey, across, pixel = cut
    known = np.isfinite(grey).all(axis=0)
    variance = np.full(len(middles), np.nan)
    variance[known] = flat(grey[:, known].T).var(axis=1) + 0.5
    core, far = variance[known & (np.abs(middles) < THINNEST_M)], variance[known & (np.abs(middles) > 0.5 * REACH_M)]
    if len(core) < 2 or len(far) < 8:
        return None
    pipe, wall = float(np.median(core)), float(np.median(far))
    if wall < _LEAST_CONTRAST * pipe:
        return None
    gain = 0.5 * _INDEPENDENT * (np.log(wall / pipe) - variance * (1 / pipe - 1 / wall))
    gain = np.where(known, np.clip(gain, -_MOST, _MOST), 0.0)
    # A strip that holds a share w of the background varies by about (1 - w)^2 pipe + w^2 wall; this is where it counts
    # as background.
    even = np.log(wall / pipe) / (1 / pipe - 1 / wall)
    share = float(np.sqrt(np.clip((even - pipe) / wall, 1e-4, 0.25)))
    blurred = float(-ndtri(share)) * USUAL_BLUR_PX * pixel
    # Strips are as wide as a fraction of a pixel in the middle view: weigh them by their width in this one.
    width = (borders[1] - borders[0]) / pixel
    axis_m = 0.5 * (view.point_a_m + view.point_b_m)
    distance = float(np.linalg.norm(np.cross(axis_m, view.point_b_m - view.point_a_m)))
    distance /= float(np.linalg.norm(view.point_b_m - view.point_a_m))
    total = np.concatenate(([0.0], np.cumsum(gain * width)))
    return _Strips(total, view.o_R_c @ across, blurred, pixel, distance)


def _cut(view: PipeView, middles: Float) -> tuple[Float, Float, float] | None:
    """Grey values (bins along, strips) in the plane through the axis that faces the camera; the direction across it in
    the camera's frame, and the size of a pixel there [m]."""
    K = view.camera.K
    way = view.point_b_m - view.point_a_m
    length = float(np.linalg.norm(way))
    ends = np.stack([view.point_a_m, view.point_b_m])
    if ends[:, 2].min() < 0.1:
        return None
    px = ends @ K.T
    px = px[:, :2] / px[:, 2:]
    bins = int(np.linalg.norm(px[1] - px[0]) / _BIN_PX)
    if bins < _FEWEST_BINS:
        return None
    each = round(_BIN_PX)
    along = (np.arange(bins * each) + 0.5) / (bins * each)
    line = view.point_a_m + along[:, None] * way
    centre = line @ K.T
    centre = centre[:, :2] / centre[:, 2:]
    size = np.array([view.camera.width, view.camera.height])
    inside = ((centre > 0) & (centre < size - 1)).all(axis=1)
    if inside.sum() < _FEWEST_BINS * each:
        return None
    line = line[inside][: int(inside.sum()) // each * each]
    sight = line[len(line) // 2]
    across = np.asarray(np.cross(way / length, sight), np.float64)
    across /= np.linalg.norm(across)
    grid = line[:, None, :] + middles[:, None] * across
    ideal = grid @ K.T
    raw = distort(view.camera, ideal[..., :2] / ideal[..., 2:])
    grey = sampled(view.image.astype(np.float32), raw).astype(float)
    return grey.reshape(-1, each, len(middles)).mean(axis=1), across, float(sight[2] / view.camera.fx)


def _across(axis: Float) -> Float:
    """Two unit directions across an axis, shape (2, 3)."""
    first = np.cross(axis, np.eye(3)[int(np.argmin(np.abs(axis)))])
    first /= np.linalg.norm(first)
    return np.asarray(np.stack([first, np.cross(axis, first)]), np.float64)
