"""The scene as triangles with texture charts, ready for rays: where they hit, and how bright it is there."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from ..frontends.open3d_loader import load_open3d
from .atlas import Atlas, build_atlas
from .rigid import transform
from .surfaces import Body, Patch

Float = NDArray[np.float64]
FINE_PRINT_M = 0.0005
_CHUNK = 400_000
Poses = Mapping[str, Float]
"""Body name -> `w_T_body`, shape (4, 4)."""


@dataclass(frozen=True, slots=True)
class Lamp:
    """A square area light that shines downwards and sideways."""

    position_m: Float
    size_m: float
    power: float


@dataclass(frozen=True, slots=True)
class Hits:
    """What rays met. Arrays of length n."""

    distance: NDArray[np.float32]
    """In lengths of the ray's direction vector; inf where nothing was hit."""
    body: NDArray[np.uint32]
    triangle: NDArray[np.int64]
    """Row of the stage's triangle table."""
    barycentric: NDArray[np.float32]
    """Shape (n, 2)."""
    flat_normal: NDArray[np.float32]
    """Shape (n, 3), of the triangle, in the world, either side."""


@dataclass(frozen=True, slots=True)
class Stage:
    """All bodies with their textures; `view` places them."""

    bodies: tuple[Body, ...]
    meshes: tuple[tuple[NDArray[np.float32], NDArray[np.uint32]], ...]
    """Vertices and triangles of each body in its own frame."""
    first_triangle: NDArray[np.int64]
    uv: NDArray[np.float32]
    """Shape (triangles, 6): texel coordinates of corner 0, and of corners 1 and 2 less corner 0."""
    normals: NDArray[np.float32]
    """Shape (triangles, 3, 3), at the corners, in the body's frame."""
    chart: NDArray[np.int32]
    patches: tuple[Patch, ...]
    atlas: Atlas
    lamps: tuple[Lamp, ...]

    def view(self, poses: Poses) -> "View":
        """The scene with every body in its place."""
        open3d = load_open3d()
        scene = open3d.t.geometry.RaycastingScene()
        for body, (vertices, triangles) in zip(self.bodies, self.meshes, strict=True):
            moved = transform(poses[body.name], vertices).astype(np.float32)
            scene.add_triangles(open3d.core.Tensor(moved), open3d.core.Tensor(triangles))
        rotations = np.stack([poses[body.name][:3, :3] for body in self.bodies]).astype(np.float32)
        return View(self, scene, rotations)

    def body_index(self, name: str) -> int:
        """Position of a body, as `Hits.body` gives it."""
        return [body.name for body in self.bodies].index(name)


@dataclass(frozen=True, slots=True)
class View:
    """The scene at one instant."""

    stage: Stage
    scene: Any
    rotations: NDArray[np.float32]
    """Shape (bodies, 3, 3), `w_R_body`."""
    threads: int = 1

    def cast(self, rays: NDArray[np.float32]) -> Hits:
        """First hits of rays (n, 6): origin and direction in the world."""
        open3d = load_open3d()
        found = self.scene.cast_rays(open3d.core.Tensor.from_numpy(rays), nthreads=self.threads)
        distance = found["t_hit"].numpy()
        body = found["geometry_ids"].numpy()
        missed = ~np.isfinite(distance)
        own = found["primitive_ids"].numpy()
        if missed.any():
            body, own = np.where(missed, np.uint32(0), body), np.where(missed, np.uint32(0), own)
        triangle = np.take(self.stage.first_triangle, body) + own
        return Hits(distance, body, triangle, found["primitive_uvs"].numpy(), found["primitive_normals"].numpy())

    def blocked(self, rays: NDArray[np.float32], near: float, far: float) -> NDArray[np.bool_]:
        """Whether anything stands on each ray between near and far (in lengths of its direction)."""
        open3d = load_open3d()
        tensor = open3d.core.Tensor.from_numpy(np.ascontiguousarray(rays, np.float32))
        return self.scene.test_occlusions(tensor, near, far, nthreads=self.threads).numpy()

    def radiance(self, rays: NDArray[np.float32], spread: float, colour: bool = False) -> NDArray[np.float32]:
        """Light along rays, shape (n,), or (n, 3) as BGR.

        Args:
            rays: shape (n, 6).
            spread: size of a sample at distance 1, in lengths of the direction (1 / focal length in samples).
        """
        parts = [rays[i : i + _CHUNK] for i in range(0, len(rays), _CHUNK)]
        return np.concatenate([self._radiance(part, spread, colour) for part in parts])

    def _radiance(self, rays: NDArray[np.float32], spread: float, colour: bool) -> NDArray[np.float32]:
        hits = self.cast(rays)
        stage = self.stage
        uv = np.take(stage.uv, hits.triangle, axis=0)
        a, b = hits.barycentric[:, 0], hits.barycentric[:, 1]
        along = uv[:, 0] + a * uv[:, 2] + b * uv[:, 4], uv[:, 1] + a * uv[:, 3] + b * uv[:, 5]
        texels = np.stack(along).astype(np.float32, copy=False)
        direction = rays[:, 3:]
        cosine = np.abs(np.einsum("ij,ij->i", hits.flat_normal, direction))
        cosine /= np.sqrt(np.einsum("ij,ij->i", direction, direction))
        chart = np.take(stage.chart, hits.triangle)
        missed = ~np.isfinite(hits.distance)
        reach = np.where(missed, np.float32(1), hits.distance)
        # The footprint of a sample on a turned surface is an ellipse: take the circle of the same area.
        size = reach * np.float32(spread) / np.sqrt(np.maximum(cosine, np.float32(0.03)))
        level = np.log2(np.maximum(size / np.take(_texels(stage), chart), np.float32(1e-6)))
        light = stage.atlas.sample(chart, texels, level)
        if colour:
            light = light[:, None] * np.take(_tints(stage), chart, axis=0)
        self._add_mirrored(light, hits, chart, rays, reach)
        light[missed] = 0
        return light

    def normals(self, hits: Hits, rows: NDArray[np.intp]) -> NDArray[np.float32]:
        """Smooth unit normals in the world of some of the hits, shape (len(rows), 3)."""
        corners = np.take(self.stage.normals, hits.triangle[rows], axis=0)
        a, b = hits.barycentric[rows, :1], hits.barycentric[rows, 1:]
        local = corners[:, 0] * (1 - a - b) + corners[:, 1] * a + corners[:, 2] * b
        local /= np.linalg.norm(local, axis=1, keepdims=True)
        return np.einsum("nij,nj->ni", np.take(self.rotations, hits.body[rows], axis=0), local)

    def _add_mirrored(
        self,
        light: NDArray[np.float32],
        hits: Hits,
        chart: NDArray[np.int32],
        rays: NDArray[np.float32],
        reach: NDArray[np.float32],
    ) -> None:
        """Lamps and bright and dark bands of the room, mirrored in metal: what moves over it with the viewer."""
        share = np.take(_mirrors(self.stage), chart)
        rows = np.flatnonzero(share)
        if not len(rows):
            return
        direction = rays[rows, 3:]
        points = rays[rows, :3] + reach[rows, None] * direction
        ray = direction / np.linalg.norm(direction, axis=1, keepdims=True)
        n = self.normals(hits, rows)
        mirrored = ray - 2 * np.einsum("ij,ij->i", ray, n)[:, None] * n
        bearing = np.arctan2(mirrored[:, 1], mirrored[:, 0])
        extra = 0.10 + 0.07 * np.sin(2 * bearing + 0.7) + 0.05 * np.sin(5 * bearing + 2.1) + 0.06 * mirrored[:, 2]
        for lamp in self.stage.lamps:
            to_lamp = lamp.position_m.astype(np.float32) - points
            away = np.linalg.norm(to_lamp, axis=1)
            cosine = np.clip(np.einsum("ij,ij->i", mirrored, to_lamp) / away, 0, 1)
            extra += np.float32(lamp.power) * (1.2 * cosine**60 + 0.25 * cosine**12) / (0.5 + away**2)
        extra = (np.maximum(extra, 0) * share[rows]).astype(np.float32)
        light[rows] += extra if light.ndim == 1 else extra[:, None]


def _texels(stage: Stage) -> NDArray[np.float32]:
    return np.array([patch.texel_m for patch in stage.patches], np.float32)


def _tints(stage: Stage) -> NDArray[np.float32]:
    return np.array([patch.tint_bgr for patch in stage.patches], np.float32)


def _mirrors(stage: Stage) -> NDArray[np.float32]:
    return np.array([patch.specular for patch in stage.patches], np.float32)


def build_stage(
    bodies: list[Body], lamps: list[Lamp], poses: Poses, rng: np.random.Generator, detail: float = 1.0
) -> Stage:
    """Triangles, textures and baked light (soft shadows, ambient occlusion) of a scene at rest in `poses`.

    `detail` divides the size of the texels, but for fine print.
    """
    bodies = [Body(body.name, [_finer(patch, detail) for patch in body.patches]) for body in bodies]
    patches = tuple(patch for body in bodies for patch in body.patches)
    looks = [p.texture(p.shape.width_m, p.shape.height_m, p.texel_m, rng).astype(np.float32) for p in patches]
    meshes, first, uvs, normals, charts = [], [], [], [], []
    number = total = 0
    for body in bodies:
        first.append(total)
        vertices, triangles, count = [], [], 0
        for patch in body.patches:
            chart, indices = patch.shape.mesh()
            points, corner_normals = patch.shape.at(chart[:, 0], chart[:, 1])
            texel = chart[indices] / patch.texel_m
            edges = texel[:, 1:] - texel[:, :1]
            uvs.append(np.concatenate([texel[:, 0], edges.reshape(-1, 4)], axis=1))
            normals.append(corner_normals[indices])
            charts.append(np.full(len(indices), number))
            vertices.append(points)
            triangles.append(indices + count)
            count, total, number = count + len(points), total + len(indices), number + 1
        meshes.append((np.concatenate(vertices).astype(np.float32), np.concatenate(triangles).astype(np.uint32)))
    stage = Stage(
        tuple(bodies),
        tuple(meshes),
        np.array(first, np.int64),
        np.concatenate(uvs).astype(np.float32),
        np.concatenate(normals).astype(np.float32),
        np.concatenate(charts).astype(np.int32),
        patches,
        build_atlas([np.ones((1, 1), np.float32)]),
        tuple(lamps),
    )
    lit = _lit(stage.view(poses), looks, poses, rng)
    return Stage(
        stage.bodies,
        stage.meshes,
        stage.first_triangle,
        stage.uv,
        stage.normals,
        stage.chart,
        stage.patches,
        build_atlas(lit),
        stage.lamps,
    )


def _finer(patch: Patch, detail: float) -> Patch:
    return patch if patch.texel_m < FINE_PRINT_M else replace(patch, texel_m=patch.texel_m / detail)


def _lit(
    view: View, looks: list[NDArray[np.float32]], poses: Poses, rng: np.random.Generator
) -> list[NDArray[np.float32]]:
    """Reflectance times the light that arrives: lamps with soft shadows, and the room's own dim light."""
    owners = [(patch, poses[body.name]) for body in view.stage.bodies for patch in body.patches]
    grids = [_light_grid(patch, w_T_body) for patch, w_T_body in owners]
    points, normals = (np.concatenate([grid[i] for grid in grids]) for i in (1, 2))
    arriving = 0.16 * _openness(view, points, normals, rng)
    for lamp in view.stage.lamps:
        arriving += _from_lamp(view, lamp, points, normals, rng)
    lit, start = [], 0
    for look, (shape, _, _) in zip(looks, grids, strict=True):
        count = shape[0] * shape[1]
        part = arriving[start : start + count].reshape(shape).astype(np.float32)
        smooth = cv2.GaussianBlur(part, (0, 0), 0.8)
        lit.append(look * cv2.resize(smooth, (look.shape[1], look.shape[0]), interpolation=cv2.INTER_LINEAR))
        start += count
    return lit


def _light_grid(patch: Patch, w_T_body: Float) -> tuple[tuple[int, int], Float, Float]:
    """Rows and columns of the light's grid on a patch, and its points and normals in {w}, shape (n, 3)."""
    width, height = patch.shape.width_m, patch.shape.height_m
    step = float(np.clip(max(width, height) / 30, 0.01, 0.04))
    columns, rows = max(2, int(width / step) + 1), max(2, int(height / step) + 1)
    u, v = np.meshgrid((np.arange(columns) + 0.5) / columns * width, (np.arange(rows) + 0.5) / rows * height)
    points, normals = patch.shape.at(u.ravel(), v.ravel())
    return (rows, columns), transform(w_T_body, points), normals @ w_T_body[:3, :3].T


def _from_lamp(view: View, lamp: Lamp, points: Float, normals: Float, rng: np.random.Generator) -> Float:
    """Irradiance of a square lamp, shape (n,), from eight stratified points on it."""
    total = np.zeros(len(points))
    for index in range(8):
        cell = np.array([index % 4, index // 4]) / [4, 2] - 0.5
        jitter = rng.random((len(points), 2)) / [4, 2]
        place = lamp.position_m + lamp.size_m * np.concatenate([cell + jitter, np.zeros((len(points), 1))], axis=1)
        towards = place - points
        away = np.linalg.norm(towards, axis=1)
        cosine = np.clip(np.einsum("ij,ij->i", towards, normals) / away, 0, 1)
        rays = np.concatenate([points + 2e-3 * normals, towards], axis=1).astype(np.float32)
        total += np.where(view.blocked(rays, 0.0, 0.98), 0.0, cosine / (0.3 + away**2))
    return lamp.power * total / 8


def _openness(view: View, points: Float, normals: Float, rng: np.random.Generator) -> Float:
    """How freely a point sees the room, 0..1: mean reach of twelve diffuse rays, cut at 0.8 m."""
    total = np.zeros(len(points))
    for _ in range(12):
        direction = normals + rng.normal(size=points.shape) * 0.55
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        rays = np.concatenate([points + 2e-3 * normals, direction], axis=1).astype(np.float32)
        reach = np.minimum(view.cast(rays).distance, 0.8) / 0.8
        total += reach * (np.einsum("ij,ij->i", direction, normals) > 0)
    return total / 12
