"""Surfaces of the cell: rectangles, tubes and rings, each with its own texture chart measured in metres.

A chart's u runs to the right and v downwards as seen from outside; both start at 0 and are lengths on the surface.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]
Texture = Callable[[float, float, float, np.random.Generator], NDArray[np.float32]]
"""(width m, height m, texel m, generator) -> reflectance 0..1, shape (rows, columns) that cover the chart."""


def across(axis: Float) -> tuple[Float, Float]:
    """Two unit vectors across a unit axis; the second is the first one crossed with the axis."""
    helper = np.eye(3)[np.argmin(np.abs(axis))]
    first: Float = np.cross(axis, helper).astype(float)
    first /= np.linalg.norm(first)
    return first, np.cross(first, axis).astype(float)


@dataclass(frozen=True, slots=True)
class Rectangle:
    """A flat rectangle: `origin + u eu + v ev`, seen from the side where eu points right and ev down."""

    origin: Float
    eu: Float
    ev: Float
    width_m: float
    height_m: float

    def at(self, u: Float, v: Float) -> tuple[Float, Float]:
        """Points and outward normals, shape (n, 3) each."""
        points = self.origin + u[:, None] * self.eu + v[:, None] * self.ev
        return points, np.broadcast_to(np.cross(self.ev, self.eu), points.shape)

    def mesh(self) -> tuple[Float, NDArray[np.int64]]:
        """Chart coordinates of the vertices (n, 2) and triangles (m, 3)."""
        w, h = self.width_m, self.height_m
        return np.array([[0, 0], [w, 0], [w, h], [0, h]], dtype=float), np.array([[0, 1, 2], [0, 2, 3]])


@dataclass(frozen=True, slots=True)
class Tube:
    """The outside of a cylinder; v runs from `top` along `axis`, u round it."""

    top: Float
    axis: Float
    radius_m: float
    height_m: float
    segments: int = 96

    @property
    def width_m(self) -> float:
        return 2 * np.pi * self.radius_m

    def at(self, u: Float, v: Float) -> tuple[Float, Float]:
        """Points and outward normals, shape (n, 3) each."""
        first, second = across(self.axis)
        angle = u / self.radius_m
        normals = np.cos(angle)[:, None] * first + np.sin(angle)[:, None] * second
        return self.top + v[:, None] * self.axis + self.radius_m * normals, normals

    def mesh(self) -> tuple[Float, NDArray[np.int64]]:
        """Chart coordinates of the vertices (n, 2) and triangles (m, 3)."""
        # Short pieces: long slivers of a tilted tube have huge bounding boxes, and rays become seven times slower.
        pieces = max(1, int(np.ceil(self.height_m / (2.5 * self.radius_m))))
        u = np.linspace(0, self.width_m, self.segments + 1)
        v = np.linspace(0, self.height_m, pieces + 1)
        chart = np.stack([np.tile(u, len(v)), np.repeat(v, len(u))], axis=1)
        ring, step = np.meshgrid(np.arange(pieces) * len(u), np.arange(self.segments), indexing="ij")
        a = (ring + step).ravel()
        b = a + len(u)
        return chart, np.concatenate([np.stack([a, a + 1, b + 1], 1), np.stack([a, b + 1, b], 1)])


@dataclass(frozen=True, slots=True)
class Ring:
    """A flat ring (or disc) between two radii; the chart is the square about it."""

    centre: Float
    eu: Float
    ev: Float
    inner_m: float
    outer_m: float
    segments: int = 48

    @property
    def width_m(self) -> float:
        return 2 * self.outer_m

    @property
    def height_m(self) -> float:
        return 2 * self.outer_m

    def at(self, u: Float, v: Float) -> tuple[Float, Float]:
        """Points and outward normals, shape (n, 3) each."""
        points = self.centre + (u - self.outer_m)[:, None] * self.eu + (v - self.outer_m)[:, None] * self.ev
        return points, np.broadcast_to(np.cross(self.ev, self.eu), points.shape)

    def mesh(self) -> tuple[Float, NDArray[np.int64]]:
        """Chart coordinates of the vertices (n, 2) and triangles (m, 3)."""
        angle = np.linspace(0, 2 * np.pi, self.segments + 1)
        circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        chart = np.concatenate([self.inner_m * circle, self.outer_m * circle]) + self.outer_m
        a = np.arange(self.segments)
        b = a + self.segments + 1
        return chart, np.concatenate([np.stack([a, a + 1, b + 1], 1), np.stack([a, b + 1, b], 1)])


@dataclass(frozen=True, slots=True)
class Patch:
    """A surface with its look."""

    shape: Rectangle | Tube | Ring
    texture: Texture
    texel_m: float = 0.0025
    tint_bgr: tuple[float, float, float] = (1.0, 1.0, 1.0)
    specular: float = 0.0
    """Share of mirrored light, 0..1 (steel: 0.3 to 0.6)."""


@dataclass(frozen=True, slots=True)
class Body:
    """Patches that move together, in the body's own frame."""

    name: str
    patches: list[Patch] = field(default_factory=list)


def box(
    size_m: tuple[float, float, float],
    texture: Texture,
    centre_m: tuple[float, float, float] = (0.0, 0.0, 0.0),
    texel_m: float = 0.0025,
    tint_bgr: tuple[float, float, float] = (1.0, 1.0, 1.0),
    yaw_rad: float = 0.0,
) -> list[Patch]:
    """Six sides of a box with z up, each with a texture of its own."""
    half = np.asarray(size_m) / 2
    turn = np.array([[np.cos(yaw_rad), -np.sin(yaw_rad), 0], [np.sin(yaw_rad), np.cos(yaw_rad), 0], [0, 0, 1.0]])
    x, y, z = turn.T
    sides = [(x, y, -z), (-x, -y, -z), (y, -x, -z), (-y, x, -z), (z, x, -y), (-z, x, y)]
    extent = {0: half[0], 1: half[1], 2: half[2]}
    patches = []
    for normal, right, down in sides:
        length = {name: extent[int(np.argmax(np.abs(turn.T @ axis)))] for name, axis in (("u", right), ("v", down))}
        depth = extent[int(np.argmax(np.abs(turn.T @ normal)))]
        origin = np.asarray(centre_m) + depth * normal - length["u"] * right - length["v"] * down
        shape = Rectangle(origin, right, down, 2 * length["u"], 2 * length["v"])
        patches.append(Patch(shape, texture, texel_m, tint_bgr))
    return patches


def rod(
    start: Float,
    end: Float,
    radius_m: float,
    texture: Texture,
    texel_m: float = 0.0015,
    specular: float = 0.0,
    segments: int = 96,
    tint_bgr: tuple[float, float, float] = (1.0, 1.0, 1.0),
) -> list[Patch]:
    """A closed cylinder from start to end."""
    axis = (end - start) / np.linalg.norm(end - start)
    tube = Tube(start, axis, radius_m, float(np.linalg.norm(end - start)), segments)
    first, second = across(axis)
    caps = [Ring(start, second, first, 0.0, radius_m), Ring(end, first, second, 0.0, radius_m)]
    return [Patch(shape, texture, texel_m, tint_bgr, specular) for shape in (tube, *caps)]
