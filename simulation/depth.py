"""Depth images of a Kinect v1: structured light, so disparity steps, shadows, lost edges, noise that grows with z^2.

Noise: axial and lateral models of Nguyen, Izadi, Lovell, "Modeling Kinect Sensor Noise for Improved 3D
Reconstruction and Tracking" (3DIMPVT 2012). Steps: 1/8 px of disparity at a baseline of 75 mm (Khoshelham, Oude
Elberink, Sensors 2012, 12, 1437).
"""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from ..factors.camera import CameraModel
from .faults import TrueRig
from .sensor import directions
from .stage import View

Float = NDArray[np.float64]
Depth = NDArray[np.float32]
BASELINE_M = 0.075
STEP_PX = 0.125
RANGE_M = (0.5, 4.0)


def axial_sigma_m(z_m: Depth, angle_rad: Depth) -> Depth:
    """Standard deviation along the view at depth z, the surface turned by `angle_rad` from facing the camera."""
    turned = np.clip(angle_rad, 0, np.pi / 2 - 0.02)
    grazing = np.where(turned > np.pi / 3, 1e-4 / np.sqrt(z_m) * turned**2 / (np.pi / 2 - turned) ** 2, 0)
    return 0.0012 + 0.0019 * (z_m - 0.4) ** 2 + grazing


def depth_directions(camera: CameraModel) -> NDArray[np.float32]:
    """Rays of the depth image, z = 1, shape (height * width, 3)."""
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    return directions(camera, np.stack([u.ravel(), v.ravel()], axis=1).astype(float)).astype(np.float32)


@dataclass(frozen=True, slots=True)
class Surface:
    """What the depth camera would see without noise, shape (height, width) each."""

    z_m: Depth
    """0 where there is nothing, or the projector does not reach."""
    angle_rad: Depth
    """Between the view and the surface's normal."""


def look(view: View, camera: CameraModel, rays_b: NDArray[np.float32], w_T_b: Float) -> Surface:
    """Cast the depth image's rays (`depth_directions`) from a pose of {b}."""
    rays = np.empty((len(rays_b), 6), np.float32)
    rays[:, :3] = w_T_b[:3, 3]
    rays[:, 3:] = rays_b @ w_T_b[:3, :3].T.astype(np.float32)
    hits = view.cast(rays)
    z = np.where(np.isfinite(hits.distance), hits.distance, 0).astype(np.float32)
    normal = view.normals(hits, np.arange(len(rays)))
    cosine = np.abs(np.einsum("ij,ij->i", normal, rays[:, 3:])) / np.linalg.norm(rays[:, 3:], axis=1)
    z[_shaded(view, rays, z, w_T_b)] = 0
    shape = (camera.height, camera.width)
    return Surface(z.reshape(shape), np.arccos(np.clip(cosine, 0, 1)).astype(np.float32).reshape(shape))


def measure(
    surface: Surface, camera: CameraModel, rig: TrueRig, correlation_px: float, rng: np.random.Generator
) -> Depth:
    """One depth image in metres as the sensor reports it, 0 where it has none; shape (height, width)."""
    jittered, angle = _jittered(surface.z_m, surface.angle_rad, rng)
    noisy = _with_noise(jittered, angle, camera.fx, correlation_px, rng)
    measured = noisy * (1 + rig.depth_scale) + rig.depth_offset_m
    lost = (jittered <= 0) | _lost(surface.z_m, angle, rng)
    lost |= (measured < RANGE_M[0]) | (measured > RANGE_M[1])
    return np.where(lost, 0, measured).astype(np.float32)


def _shaded(view: View, rays: NDArray[np.float32], z: Depth, w_T_b: Float) -> NDArray[np.bool_]:
    """Where the projector, beside the camera, does not reach."""
    projector = (w_T_b[:3, 3] + BASELINE_M * w_T_b[:3, 0]).astype(np.float32)
    points = rays[:, :3] + (z * np.float32(0.998))[:, None] * rays[:, 3:]
    back = np.concatenate([points, projector - points], axis=1).astype(np.float32)
    return view.blocked(back, 0.0, 0.97)


def _jittered(z: Depth, angle: Depth, rng: np.random.Generator) -> tuple[Depth, Depth]:
    """Lateral noise: each pixel reports a neighbour's depth, about 0.8 px away, which frays edges."""
    height, width = z.shape
    shift = rng.standard_normal((2, height, width), dtype=np.float32) * 0.8
    u = np.clip(np.rint(np.arange(width)[None, :] + shift[0]).astype(np.int32), 0, width - 1)
    v = np.clip(np.rint(np.arange(height)[:, None] + shift[1]).astype(np.int32), 0, height - 1)
    moved = z[v, u]
    # On a surface the neighbour's depth is not a jump: keep the pixel's own, so that slopes get no extra noise.
    edge = np.abs(moved - z) > 0.03 * np.maximum(z, 0.1)
    return np.where(edge, moved, z), np.where(edge, angle[v, u], angle)


def _with_noise(z: Depth, angle: Depth, focal_px: float, correlation_px: float, rng: np.random.Generator) -> Depth:
    """Axial noise and disparity steps; their sum has the published standard deviation."""
    valid = np.maximum(z, 0.2)
    step = STEP_PX * valid**2 / (focal_px * BASELINE_M)
    sigma = np.sqrt(np.maximum(axial_sigma_m(valid, angle) ** 2 - step**2 / 12, 1e-8))
    noise = rng.standard_normal(z.shape, dtype=np.float32)
    if correlation_px > 0:
        noise = cv2.GaussianBlur(noise, (0, 0), correlation_px)
        noise /= np.float32(max(float(noise.std()), 1e-6))
    disparity = focal_px * BASELINE_M / np.maximum(valid + sigma * noise, 0.1)
    return (focal_px * BASELINE_M / (STEP_PX * np.maximum(np.rint(disparity / STEP_PX), 1))).astype(np.float32)


def _lost(z: Depth, angle: Depth, rng: np.random.Generator) -> NDArray[np.bool_]:
    """Dropouts: half of the pixels at depth jumps, grazing surfaces, and a few anywhere."""
    smooth = np.where(z > 0, z, 10.0).astype(np.float32)
    kernel = np.ones((3, 3), np.uint8)
    jump = cv2.dilate(smooth, kernel) - cv2.erode(smooth, kernel) > 0.05 + 0.05 * z
    chance = rng.random(z.shape, dtype=np.float32)
    grazing = np.clip((angle - 1.22) / 0.25, 0, 1)
    return (chance < grazing) | (jump & (chance < 0.5)) | (chance < 0.002)
