"""A pipe that is known roughly, in a depth image or a cloud: its points become one summarised cylinder."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ...factors.camera import CameraModel
from ...factors.cloud import depth_moves
from ...factors.measurements import CylinderSighting, Rejection
from ..cloud.frontend import trusted_pixels
from ..cloud.noise import SMOOTH_SHARE, DepthModel, depth_noise
from ..rays import pixel_rays
from .consensus import Axis
from .cylinder import CylinderConfig, CylinderFit, fit_cylinder
from .segment import cylinder_sighting

Float = NDArray[np.float64]

FEWEST_POINTS = 20
"""Near the predicted pipe, for a search."""
LEAST_REACH_M = 0.06
"""The search goes so far beyond the predicted surface at least: a mount that is off has to show, not to hide."""
GATE_SIGMA = 3.0
_FIRST, _SECOND = 1000, 2500
"""Points for the place, and for the fit that is kept: more cost time and change nothing."""
_COARSE = 8
SHORTEST_RADII = 2.0
"""A piece of pipe shorter than so many radii holds no direction."""


@dataclass(frozen=True, slots=True)
class PredictedPipe:
    """Where a pipe should be, in the depth camera's optical frame."""

    point_a_m: Float
    """Shape (3,), one end of the part that is looked for, on the axis."""
    point_b_m: Float
    """Shape (3,)."""
    radius_m: float
    sigma_m: float
    """Standard deviation of the axis across itself, pose and depth calibration included."""

    @property
    def axis(self) -> Float:
        way = self.point_b_m - self.point_a_m
        return np.asarray(way / np.linalg.norm(way), np.float64)

    @property
    def reach_m(self) -> float:
        """Distance from the axis within which points may belong to the pipe."""
        return self.radius_m + max(GATE_SIGMA * self.sigma_m, LEAST_REACH_M)

    def near(self, points_m: Float) -> NDArray[np.bool_]:
        """Which points (n, 3) may be on it."""
        return _within(points_m, self.point_a_m, self.point_b_m, self.reach_m)


class DepthImages:
    """Reads the surroundings of a pipe from depth images of one camera; holds its ray table."""

    def __init__(self, camera: CameraModel, model: DepthModel) -> None:
        self._camera, self._noise = camera, depth_noise(model)
        self._rays = np.nan_to_num(pixel_rays(camera), nan=np.inf).astype(np.float32)

    def points_near(self, depth_m: NDArray[np.float32], pipe: PredictedPipe) -> Float:
        """Trusted points (n, 3) of a depth image (height, width) within reach of a predicted pipe."""
        part = self._region(pipe)
        if part is None:
            return np.zeros((0, 3))
        rays = self._rays[part]
        depth, good = trusted_pixels(depth_m[part], self._camera, self._noise)
        good &= np.isfinite(rays).all(axis=2)
        z = depth[good].astype(np.float64)
        points = np.column_stack((rays[good] * z[:, None], z))
        return np.asarray(points[pipe.near(points)], np.float64)

    def _region(self, pipe: PredictedPipe) -> tuple[slice, slice] | None:
        """Rows and columns that the reach of a pipe covers."""
        line = pipe.point_a_m + np.linspace(0, 1, 33)[:, None] * (pipe.point_b_m - pipe.point_a_m)
        line = line[line[:, 2] > pipe.reach_m + 0.1]
        if len(line) == 0:
            return None
        coarse = self._rays[::_COARSE, ::_COARSE]
        margin = pipe.reach_m / (line[:, 2] - pipe.reach_m)
        low = (line[:, :2] / line[:, 2:] - margin[:, None]).min(axis=0)
        high = (line[:, :2] / line[:, 2:] + margin[:, None]).max(axis=0)
        mask = ((coarse >= low) & (coarse <= high)).all(axis=2)
        rows, columns = (np.flatnonzero(mask.any(axis=a)) for a in (1, 0))
        if len(rows) == 0:
            return None
        first, last = ((i[0] - 1) * _COARSE for i in (rows, columns)), ((i[-1] + 1) * _COARSE for i in (rows, columns))
        top, left = (max(int(i), 0) for i in first)
        bottom, right = (int(i) for i in last)
        return slice(top, bottom + 1), slice(left, right + 1)


def cylinder_near(
    stamp_ns: int, pipe_id: str, points_m: Float, model: DepthModel, pipe: PredictedPipe
) -> CylinderSighting | Rejection:
    """The cylinder that points of a depth camera show near a predicted pipe, as one summarised measurement.

    Args:
        points_m: Shape (n, 3), in the depth camera's optical frame, as measured.
        model: The camera, for its noise.
        pipe: Where to look; it gives the start and the search region, no information.

    What the points share, the quantisation of the depth (a step over root twelve) and the smooth distortion of the
    image, is added to the covariance along the view; how a depth offset and scale would move the fit comes with it.
    """
    what = f"b_depth {pipe_id}"
    points = points_m[pipe.near(points_m)]
    if len(points) < FEWEST_POINTS:
        few = "few points near the predicted pipe"
        return Rejection(stamp_ns, "pipe cylinder", what, few, len(points), FEWEST_POINTS)
    noise = depth_noise(model)
    fit: CylinderFit | Rejection | None = None
    for start in (_moved_to(points, pipe), None):
        fit = _fitted(points, noise.axial(points[:, 2], 0.0), pipe, start)
        if isinstance(fit, CylinderFit):
            break
    assert fit is not None
    if isinstance(fit, Rejection):
        return replace(fit, stamp_ns=stamp_ns, family="pipe cylinder", what=what)
    length, least = float(np.linalg.norm(fit.point_b_m - fit.point_a_m)), SHORTEST_RADII * fit.radius_m
    if length < least:
        return Rejection(stamp_ns, "pipe cylinder", what, "the visible piece is short; m", length, least)
    turn = float(np.arccos(min(abs(float(fit.axis @ pipe.axis)), 1.0)))
    limit = GATE_SIGMA * np.hypot(pipe.sigma_m, LEAST_REACH_M) / (0.5 * length)
    if turn > limit:
        return Rejection(stamp_ns, "pipe cylinder", what, "another direction than predicted; rad", turn, float(limit))
    depth = np.array([0.5 * (fit.point_a_m + fit.point_b_m)[2]])
    common = float(np.hypot(noise.step(depth)[0] / np.sqrt(12.0), SMOOTH_SHARE * depth[0]))
    sighting = cylinder_sighting(stamp_ns, "b_depth", pipe_id, fit, common, "kinect_cloud")
    return replace(sighting, by_depth=depth_response(points[fit.inliers], fit))


def depth_response(points: Float, fit: CylinderFit) -> Float:
    """How a fit follows its depth camera's errors: d (point_a, point_b, radius) / d (depth states), shape (7, 5).

    The points move as `depth_moves` says; the least squares follow.
    """
    middle = 0.5 * (fit.point_a_m + fit.point_b_m)
    axis = Axis.of(middle, fit.axis, fit.radius_m, middle)
    _, jacobian = axis.residuals(points)
    unit = -jacobian[:, :2] @ axis.across
    outwards = np.einsum("ni,nik->nk", unit, depth_moves(points))
    change = -np.linalg.lstsq(jacobian, outwards, rcond=None)[0]
    response = np.zeros((7, 5))
    for rows, end in ((slice(0, 3), fit.point_a_m), (slice(3, 6), fit.point_b_m)):
        arm = float((end - middle) @ fit.axis)
        response[rows] = axis.across.T @ (change[:2] + arm * change[2:4])
    response[6] = change[4]
    return response


def _fitted(points: Float, sigma: Float, pipe: PredictedPipe, start: Axis | None) -> CylinderFit | Rejection:
    """A fit from the predicted place, and another one to the points that this leaves near the axis."""
    first, few = CylinderConfig(points=_FIRST, check_halves=False), _some(len(points), _FIRST)
    fit = fit_cylinder(points[few], sigma[few], (pipe.point_a_m, pipe.axis), None, first, start=start)
    if isinstance(fit, Rejection):
        return fit
    near = np.flatnonzero(_within(points, fit.point_a_m, fit.point_b_m, 1.5 * fit.radius_m, 0.2))
    near = near[_some(len(near), _SECOND)]
    middle = 0.5 * (fit.point_a_m + fit.point_b_m)
    second = CylinderConfig(points=_SECOND)
    again = fit_cylinder(
        points[near], sigma[near], None, None, second, start=Axis.of(middle, fit.axis, fit.radius_m, middle)
    )
    if isinstance(again, Rejection):
        return again
    inliers = np.zeros(len(points), bool)
    inliers[near[again.inliers]] = True
    return replace(again, inliers=inliers)


def _some(count: int, most: int) -> NDArray[np.int64]:
    """Indices of at most so many points, drawn: even steps could all fall into the same columns of an image."""
    if count <= most:
        return np.arange(count)
    return np.sort(np.random.default_rng(0).permutation(count)[:most])


def _moved_to(points: Float, pipe: PredictedPipe) -> Axis:
    """The predicted cylinder, moved along the view to where the points before its middle are."""
    middle = 0.5 * (pipe.point_a_m + pipe.point_b_m)
    axis = Axis.of(middle, pipe.axis, pipe.radius_m, middle)
    offset = points - middle
    side = np.abs(offset @ axis.across[1])
    front = np.sort((offset @ axis.across[0])[side < 0.5 * pipe.radius_m])
    if len(front) < 10:
        return axis
    shift = float(np.median(front[: max(10, int(0.7 * len(front)))])) + 0.94 * pipe.radius_m
    return replace(axis, point=axis.point + shift * axis.across[0])


def _within(points: Float, a: Float, b: Float, reach: float, beyond: float = 0.0) -> NDArray[np.bool_]:
    length = float(np.linalg.norm(b - a))
    direction = (b - a) / length
    offset = points - a
    along = offset @ direction
    across2 = (offset**2).sum(axis=1) - along**2
    return np.asarray((across2 < reach**2) & (along > -beyond) & (along < length + beyond), np.bool_)
