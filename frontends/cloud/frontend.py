"""Depth images to surface samples with normals and honest noise.

Every window of the image is fitted with a plane in inverse depth: on a plane 1/z is linear in the ray's (x, y), and
the noise of structured light is even there. Windows that hold an edge, clutter or a grazing surface give no sample.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ...factors.camera import CameraModel
from ...factors.measurements import CloudFrame
from ..rays import pixel_rays
from .noise import DepthModel, DepthNoise, depth_noise

Float = NDArray[np.float64]
Float32 = NDArray[np.float32]
Bool = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class CloudConfig:
    """How a depth image is cut into surface samples."""

    samples: int = 4000
    """At most so many."""
    grazing_rad: float = np.deg2rad(75.0)
    """Surfaces seen flatter than this give no sample: the published noise models end there."""
    clutter_sigma: float = 4.0
    """Windows whose residual exceeds this many times the published noise are no surface."""
    valid_share: float = 0.5
    """Part of a window that must be valid and off the edges."""


@dataclass(frozen=True, slots=True)
class _Windows:
    """Plane fits of all windows: inverse depth = gradient . (x, y, 1)."""

    gradient: Float
    """(n, 3)"""
    centre: Float
    """(n, 2), mean normalised coordinates of the pixels used."""
    rms: Float
    """(n,), residual in inverse depth."""
    count: Float
    """(n,)"""
    correlation: float
    """Share of the pixels that count as independent, from the residuals' correlation between neighbours."""


class CloudFrontEnd:
    """Turns depth images of one camera into `CloudFrame`s. Holds tables of the camera only, no frames."""

    def __init__(self, camera: CameraModel, model: DepthModel, config: CloudConfig | None = None) -> None:
        self._config = config or CloudConfig()
        self._noise = depth_noise(model)
        self._camera = camera
        self._stride = max(3, int(np.ceil(np.sqrt(camera.width * camera.height / self._config.samples))))
        self._window = self._stride | 1
        rays = pixel_rays(camera)
        self._inside = np.isfinite(rays).all(axis=2)
        self._x, self._y = (self._tiles(np.nan_to_num(rays[..., i]).astype(np.float32)) for i in (0, 1))

    def process(self, stamp_ns: int, depth_m: Float32, averaged: int = 1) -> CloudFrame:
        """Surface samples of one depth image.

        Args:
            stamp_ns: Time of the image.
            depth_m: Shape (height, width), metres along the optical axis, NaN where invalid.
            averaged: Number of frames that were averaged into the image (see `average_depth`); the noise that
                differs from frame to frame falls with it, quantisation does not.
        """
        shape = (self._camera.height, self._camera.width)
        if depth_m.shape != shape:
            raise ValueError(f"depth image of {depth_m.shape}, the camera {self._camera.name} has {shape}")
        depth, good = trusted_pixels(depth_m, self._camera, self._noise)
        fit = self._fit(depth, good & self._inside)
        return self._samples(stamp_ns, fit, averaged)

    def _tiles(self, image: Float32) -> Float32:
        """(n, window * window) copies of the windows, at the stride."""
        views = np.lib.stride_tricks.sliding_window_view(image, (self._window, self._window))
        views = views[:: self._stride, :: self._stride]
        return np.ascontiguousarray(views).reshape(-1, self._window**2)

    def _fit(self, depth: Float32, good: Bool) -> _Windows:
        weight = self._tiles(good.astype(np.float32))
        keep = weight.sum(axis=1) >= self._config.valid_share * self._window**2
        weight = weight[keep]
        x, y = self._x[keep], self._y[keep]
        value = np.divide(weight, self._tiles(depth)[keep], out=np.zeros_like(weight), where=weight > 0)
        return _plane_fits(x, y, value, weight, self._window)

    def _samples(self, stamp_ns: int, fit: _Windows, averaged: int) -> CloudFrame:
        length = np.linalg.norm(fit.gradient, axis=1)
        rays = np.column_stack((fit.centre, np.ones(len(fit.centre))))
        inverse = np.einsum("ni,ni->n", fit.gradient, rays)
        with np.errstate(divide="ignore", invalid="ignore"):
            z = 1.0 / inverse
            points = rays * z[:, None]
            cosine = inverse / (length * np.linalg.norm(rays, axis=1))
            normals = -fit.gradient / length[:, None]
            planarity = fit.rms * z / length
        keep = (inverse > 0) & (cosine > np.cos(self._config.grazing_rad))
        keep &= np.isfinite(planarity) & np.isfinite(normals).all(axis=1)
        points, normals, planarity = points[keep], normals[keep], planarity[keep]
        z, cosine, independent = z[keep], cosine[keep], np.maximum(fit.count[keep] * fit.correlation, 1.0)
        pixel = self._noise.axial(z, np.arccos(np.minimum(cosine, 1.0))) * cosine
        bias = self._noise.step(z) * cosine / np.sqrt(12.0)
        # What neighbours do not share averages over the window and over frames; the scatter seen decides when larger.
        random = np.maximum(pixel, planarity) / np.sqrt(independent * averaged)
        keep = planarity < self._config.clutter_sigma * np.hypot(pixel, bias)
        sigma = np.hypot(random, bias)
        return CloudFrame(stamp_ns, points[keep], normals[keep], sigma[keep], planarity[keep], bias[keep])


def trusted_pixels(depth_m: Float32, camera: CameraModel, noise: DepthNoise) -> tuple[Float32, Bool]:
    """Depth with invalid pixels at 0, and the mask of pixels in range and away from depth edges.

    A pixel next to a jump larger than noise and a grazing surface explain may show either side, or what is between;
    the published lateral noise says how far from the edge that goes.
    """
    depth = depth_m.astype(np.float32, copy=False)
    depth = np.where((depth > noise.minimum_m) & (depth < noise.maximum_m), depth, np.float32(0))  # nor is NaN in range
    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    near, far = cv2.erode(depth, cross), cv2.dilate(depth, cross)
    steepest = np.float32(np.tan(np.deg2rad(80.0)) * 2.0 / camera.fx)
    jump = far - near
    steep = np.flatnonzero(jump > steepest * far)  # few: the noise is asked there alone
    jump, far = jump.ravel()[steep], far.ravel()[steep]
    edge = np.zeros(depth.shape, np.uint8)
    edge.ravel()[steep] = jump > 3 * noise.axial(far.astype(np.float64), 0.0) + steepest * far
    grow = 2 * int(np.ceil(noise.lateral_px)) - 1
    edge = cv2.dilate(edge, np.ones((grow, grow), np.uint8)) if grow > 1 else edge
    return depth, (depth > 0) & (edge == 0)


def average_depth(depths_m: Float32, share: float = 0.5) -> Float32:
    """Mean of several depth images of a still camera, shape (n, height, width) -> (height, width), NaN invalid.

    Pixels valid in less than `share` of the frames stay invalid; so do those that jump between two surfaces from
    frame to frame (range over 10 % of the depth).
    """
    shape = depths_m.shape[1:]
    count, total = np.zeros(shape, np.int32), np.zeros(shape, np.float32)
    low, high = np.full(shape, np.inf, np.float32), np.full(shape, -np.inf, np.float32)
    with np.errstate(invalid="ignore", divide="ignore"):
        for image in depths_m:  # one by one: together they are larger than a processor's cache
            depth = np.asarray(
                image + (image - image), np.float32
            )  # infinite becomes NaN, which fmin and fmax pass over
            count += np.isfinite(depth)
            np.fmin(low, depth, out=low)
            np.fmax(high, depth, out=high)
            total += cv2.patchNaNs(depth, 0.0)
        mean = total / count
        keep = (count >= share * len(depths_m)) & (high - low < 0.1 * mean)
    return np.where(keep, mean, np.nan).astype(np.float32)


def _plane_fits(x: Float32, y: Float32, value: Float32, weight: Float32, window: int) -> _Windows:
    """Least-squares planes value = a x + b y + c of every row; `value` is weighted already."""
    count = weight.sum(axis=1)
    mx, my, mv = ((weight * a).sum(axis=1) / count for a in (x, y, value))
    dx, dy = (x - mx[:, None]) * weight, (y - my[:, None]) * weight
    dv = (value - mv[:, None]) * weight
    xx, xy, yy = ((a * b).sum(axis=1, dtype=np.float64) for a, b in ((dx, dx), (dx, dy), (dy, dy)))
    xv, yv = ((a * dv).sum(axis=1, dtype=np.float64) for a in (dx, dy))
    with np.errstate(divide="ignore", invalid="ignore"):
        determinant = xx * yy - xy**2
        a, b = (yy * xv - xy * yv) / determinant, (xx * yv - xy * xv) / determinant
    residual = dv - a[:, None].astype(np.float32) * dx - b[:, None].astype(np.float32) * dy
    square = residual**2
    rms = np.sqrt(square.sum(axis=1, dtype=np.float64) / np.maximum(count - 3, 1))
    gradient = np.column_stack((a, b, mv - a * mx - b * my))
    independent = _independent_share(residual, window)
    return _Windows(gradient, np.column_stack((mx, my)).astype(float), rms, count.astype(float), independent)


def _independent_share(residual: Float32, window: int) -> float:
    """Effective share of independent pixels from the correlation of neighbouring residuals (first-order model)."""
    tiles = residual.reshape(-1, window, window)
    limit = _quantile(np.abs(residual).ravel(), 0.99) if residual.size else 0.0
    tiles = np.clip(tiles, -limit, limit)
    energy = float((tiles**2).mean()) if tiles.size else 0.0
    if energy == 0.0:
        return 1.0 / window**2
    share = 1.0
    for product in (tiles[:, :, 1:] * tiles[:, :, :-1], tiles[:, 1:] * tiles[:, :-1]):
        rho = min(max(float(product.mean()) / energy, 0.0), 0.95)
        share *= (1 - rho) / (1 + rho)
    return share


def _quantile(values: Float32, share: float) -> float:
    """Of values (n,), between neighbours: NumPy looks for both at once, which takes eight times as long."""
    place = share * (len(values) - 1)
    below = int(place)
    ordered = np.partition(values, below)
    low = float(ordered[below])
    above = float(ordered[below + 1 :].min()) if below + 1 < len(values) else low
    return low + (place - below) * (above - low)
