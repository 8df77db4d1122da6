"""The pipe in a depth image: points about a pick, grown along the axis that they show."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ...factors.camera import CameraModel
from ...factors.measurements import CameraName, CylinderSighting, Rejection
from ..cloud.frontend import trusted_pixels
from ..cloud.noise import DepthModel, depth_noise
from ..rays import pixel_rays
from .cylinder import CylinderConfig, CylinderFit, fit_cylinder

Float = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class SegmentConfig:
    """How far the pipe is followed from the pick."""

    first_reach_m: float = 0.12
    reach_m: float = 0.4
    pick_window_px: int = 4


def segment_pipe(
    depth_m: NDArray[np.float32], camera: CameraModel, model: DepthModel, pick_px: Float, reach_m: float
) -> tuple[Float, Float] | None:
    """Points of the surface about a pick, and their sigmas across it; None where the pick has no depth.

    The surface is followed from pixel to pixel, up to depth edges and `reach_m` from the picked point.

    Args:
        depth_m: Shape (height, width), NaN invalid.
        camera: The depth camera.
        model: Its noise.
        pick_px: Shape (2,), raw pixels of the depth image.
        reach_m: Metres.
    """
    noise = depth_noise(model)
    depth, good = trusted_pixels(depth_m, camera, noise)
    column, row = (int(v) for v in np.round(pick_px))
    window = SegmentConfig().pick_window_px
    rows, columns = (slice(max(c - window, 0), c + window + 1) for c in (row, column))
    near = depth[rows, columns][good[rows, columns]]
    if near.size < 3:
        return None
    middle = float(np.median(near))
    ray = pixel_rays(camera)[np.clip(row, 0, camera.height - 1), np.clip(column, 0, camera.width - 1)]
    half = int(np.ceil(camera.fx * reach_m / max(middle - 0.5 * reach_m, 0.2)))
    rows, columns = slice(max(row - half, 0), row + half + 1), slice(max(column - half, 0), column + half + 1)
    part, mask = depth[rows, columns], good[rows, columns]
    points = np.dstack((pixel_rays(camera)[rows, columns], np.ones(part.shape))) * part[..., None]
    mask &= np.linalg.norm(points - middle * np.append(ray, 1.0), axis=2) < reach_m
    _, label = cv2.connectedComponents(mask.astype(np.uint8), connectivity=4)
    local = label[max(row - rows.start - window, 0) : row - rows.start + window + 1,
                  max(column - columns.start - window, 0) : column - columns.start + window + 1]  # fmt: skip
    count = np.bincount(local[local > 0])
    if len(count) == 0:
        return None
    chosen = label == int(np.argmax(count))
    return points[chosen].astype(float), noise.axial(part[chosen].astype(float), 0.0)


def kinect_cylinder(
    stamp_ns: int,
    pipe_id: str,
    depth_m: NDArray[np.float32],
    camera: CameraModel,
    model: DepthModel,
    pick_px: Float,
    radius_prior_m: tuple[float, float] | None = None,
    config: SegmentConfig | None = None,
) -> CylinderSighting | Rejection:
    """The pipe under a pick in a depth image as one summarised measurement.

    The depth's quantisation moves all points of a patch together; half a step over root three is added to every
    direction along the view.
    """
    config = config or SegmentConfig()
    seed: tuple[Float, Float] | None = None
    fit: CylinderFit | None = None
    for reach in (config.first_reach_m, config.reach_m):
        part = segment_pipe(depth_m, camera, model, pick_px, reach)
        if part is None:
            return Rejection(stamp_ns, "cylinder", f"{camera.name} {pipe_id}", "no depth at the pick", 0.0, 3.0)
        points, sigma = part
        if fit is not None and seed is not None:
            across = np.linalg.norm(np.cross(points - seed[0], seed[1]), axis=1)
            near = across < 1.5 * fit.radius_m
            points, sigma = points[near], sigma[near]
        grown = fit_cylinder(points, sigma, seed, radius_prior_m, CylinderConfig(), stamp_ns)
        if isinstance(grown, Rejection):
            if fit is None:
                return grown
            break
        fit, seed = grown, (grown.point_a_m, grown.axis)
    assert fit is not None
    step = float(depth_noise(model).step(np.array([fit.point_a_m[2]]))[0]) / np.sqrt(12.0)
    return cylinder_sighting(stamp_ns, camera.name, pipe_id, fit, step, "kinect_cloud")  # type: ignore[arg-type]


def cylinder_sighting(
    stamp_ns: int, camera: CameraName, pipe_id: str, fit: CylinderFit, common_sigma_m: float, source: str
) -> CylinderSighting:
    """A fit as a measurement, with an error that all its points share along the view added to its covariance."""
    information = fit.information
    if common_sigma_m > 0:
        middle = 0.5 * (fit.point_a_m + fit.point_b_m)
        ray = middle / np.linalg.norm(middle)
        shared = np.concatenate((ray, ray, [0.0]))
        # Woodbury: (P^-1)^+ with P + s^2 v v^T, on the observable part.
        pulled = information @ shared
        information = information - np.outer(pulled, pulled) / (1 / common_sigma_m**2 + shared @ pulled)
    return CylinderSighting(
        stamp_ns, camera, pipe_id, fit.point_a_m, fit.point_b_m, fit.radius_m, information, int(fit.inliers.sum()),
        fit.rms_m, source,  # type: ignore[arg-type]
    )  # fmt: skip
