"""Procedural reflectance, from a generator: brick, concrete, painted metal, wood, posters, the marker page.

Every function has the form `(width_m, height_m, texel_m, rng) -> float32 (rows, columns)`, values 0..1, linear.
"""

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.float32]
Rng = np.random.Generator


def size(width_m: float, height_m: float, texel_m: float) -> tuple[int, int]:
    """Rows and columns that cover the chart."""
    return max(1, int(np.ceil(height_m / texel_m - 1e-9))), max(1, int(np.ceil(width_m / texel_m - 1e-9)))


def _limited(image: NDArray[Any], low: float = 0.02, high: float = 0.9) -> Image:
    return np.clip(image, low, high).astype(np.float32)


def clouds(shape: tuple[int, int], texel_m: float, coarsest_m: float, octaves: int, fall: float, rng: Rng) -> Image:
    """Smooth noise of several octaves, about zero mean and unit deviation, from `coarsest_m` downwards."""
    # Coarse octaves are made at a quarter of the resolution.
    small_shape = (shape[0] // 4 + 2, shape[1] // 4 + 2)
    coarse, fine = np.zeros(small_shape, np.float32), np.zeros(shape, np.float32)
    weight = 0.0
    for octave in range(octaves):
        cell = max(coarsest_m / 2**octave / texel_m, 1.0)
        target = coarse if cell > 24 else fine
        target += fall**octave * _waves(target.shape, cell / 4 if cell > 24 else cell, rng)
        weight += fall ** (2 * octave)
        if cell <= 1.0:
            break
    wide = cv2.resize(coarse, (small_shape[1] * 4, small_shape[0] * 4), interpolation=cv2.INTER_LINEAR)
    return (fine + wide[: shape[0], : shape[1]]) / np.float32(0.75 * np.sqrt(weight))


def _waves(shape: tuple[int, ...], cell: float, rng: Rng) -> Image:
    """One octave: a grid of random numbers `cell` texels apart, shifted at random so that octaves do not line up."""
    small = rng.standard_normal([int(n / cell) + 3 for n in shape]).astype(np.float32)
    shift = rng.random(2)
    matrix = np.array([[1 / cell, 0, shift[0]], [0, 1 / cell, shift[1]]])
    flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    size_px = (shape[1], shape[0])
    return np.asarray(cv2.warpAffine(small, matrix, size_px, flags=flags, borderMode=cv2.BORDER_REFLECT), np.float32)


def plain(level: float = 0.5, grain: float = 0.02, blotch: float = 0.03) -> Callable[..., Image]:
    """Painted metal or plaster: faint blotches, faint grain, a few scratches."""

    def texture(width_m: float, height_m: float, texel_m: float, rng: Rng) -> Image:
        shape = size(width_m, height_m, texel_m)
        image = level + blotch * clouds(shape, texel_m, 0.3, 4, 0.6, rng)
        image += grain * rng.standard_normal(shape).astype(np.float32)
        for _ in range(int(rng.poisson(6 * width_m * height_m))):
            scratch(image, texel_m, rng, rng.uniform(-0.25, 0.15) * level)
        return _limited(image)

    return texture


def scratch(image: Image, texel_m: float, rng: Rng, step: float) -> None:
    """One thin line or spot, added in place."""
    rows, columns = image.shape
    start = rng.random(2) * [columns, rows]
    end = start + rng.normal(0, 0.06, 2) / texel_m
    layer = np.zeros_like(image)
    width = max(1, int(rng.uniform(0.001, 0.004) / texel_m))
    cv2.line(layer, tuple(int(v) for v in start), tuple(int(v) for v in end), 1.0, width, cv2.LINE_AA)
    image += np.float32(step) * layer


def brick(tone: float, brick_m: tuple[float, float] = (0.215, 0.065), mortar_m: float = 0.01) -> Callable[..., Image]:
    """A brick wall: every brick with its own tone and wear, stains that run over it, some bricks painted over."""

    def texture(width_m: float, height_m: float, texel_m: float, rng: Rng) -> Image:
        shape = size(width_m, height_m, texel_m)
        wobble = 0.0025 * clouds(shape, texel_m, 0.08, 3, 0.6, rng)
        v = (np.arange(shape[0], dtype=np.float32) * texel_m)[:, None] + wobble
        course = np.floor(v / (brick_m[1] + mortar_m))
        u = (np.arange(shape[1], dtype=np.float32) * texel_m)[None, :] + wobble
        u = u + (course % 2) * (brick_m[0] + mortar_m) / 2 + 0.012 * np.sin(7.3 * course)
        column = np.floor(u / (brick_m[0] + mortar_m))
        in_u, in_v = u - column * (brick_m[0] + mortar_m), v - course * (brick_m[1] + mortar_m)
        edge = np.minimum(
            np.minimum(in_u - mortar_m / 2, brick_m[0] + mortar_m / 2 - in_u),
            np.minimum(in_v - mortar_m / 2, brick_m[1] + mortar_m / 2 - in_v),
        )
        face = np.clip(edge / 0.003 + 0.5, 0, 1)
        tones = rng.normal(tone, 0.16 * tone, (int(course.max()) + 3, int(column.max()) + 4)).astype(np.float32)
        rows, columns = (course + 1).astype(np.int32), (column + 1).astype(np.int32)
        surface = tones[np.maximum(rows, 0), np.maximum(columns, 0)]
        surface = surface * (1 + 0.12 * clouds(shape, texel_m, 0.03, 3, 0.8, rng))
        mortar = 1.5 * tone * (1 + 0.08 * clouds(shape, texel_m, 0.02, 2, 0.8, rng))
        image = face * surface + (1 - face) * mortar
        image *= 1 + 0.16 * clouds(shape, texel_m, 0.9, 4, 0.6, rng)
        return _limited(image * drips(shape, texel_m, rng))

    return texture


def drips(shape: tuple[int, int], texel_m: float, rng: Rng) -> Image:
    """Water marks that run down: a factor about one."""
    lines = rng.standard_normal((max(2, int(shape[0] * texel_m / 0.7)), max(4, int(shape[1] * texel_m / 0.05))))
    wide = cv2.resize(lines.astype(np.float32), (shape[1], shape[0]), interpolation=cv2.INTER_CUBIC)
    return _limited(1 + 0.10 * wide, 0.5, 1.4)


def concrete(tone: float) -> Callable[..., Image]:
    """A floor: cloudy, stained, cracked, with worn tape."""

    def texture(width_m: float, height_m: float, texel_m: float, rng: Rng) -> Image:
        shape = size(width_m, height_m, texel_m)
        image = tone * (1 + 0.13 * clouds(shape, texel_m, 0.8, 7, 0.75, rng))
        image *= 1 + 0.07 * rng.standard_normal(shape).astype(np.float32)
        for _ in range(int(4 + 2.5 * width_m * height_m)):
            blot(image, texel_m, rng)
        for _ in range(int(2 + 0.5 * width_m * height_m)):
            crack(image, texel_m, rng)
        return _limited(image)

    return texture


def blot(image: Image, texel_m: float, rng: Rng) -> None:
    """One stain with a soft edge, in place."""
    layer = np.zeros_like(image)
    centre = rng.random(2) * image.shape[::-1]
    axes = np.maximum(1, rng.gamma(2.0, 0.03, 2) / texel_m)
    angle = rng.uniform(0, 180)
    cv2.ellipse(layer, (centre.astype(int).tolist()), (axes.astype(int).tolist()), angle, 0, 360, 1.0, -1, cv2.LINE_AA)
    image *= 1 + np.float32(rng.uniform(-0.55, 0.3)) * layer


def crack(image: Image, texel_m: float, rng: Rng) -> None:
    """One crack as a random walk, in place."""
    steps = np.cumsum(rng.normal(0, 0.3, 40)) + rng.uniform(0, 2 * np.pi)
    walk = np.cumsum(np.stack([np.cos(steps), np.sin(steps)], 1) * 0.025 / texel_m, axis=0)
    points = (walk + rng.random(2) * image.shape[::-1]).astype(np.int32)
    layer = np.zeros_like(image)
    cv2.polylines(layer, [points], False, 1.0, max(1, int(0.003 / texel_m)), cv2.LINE_AA)
    image *= 1 - 0.5 * layer


def wood(tone: float) -> Callable[..., Image]:
    """Planks with grain, knots, gaps and a stencilled word."""

    def texture(width_m: float, height_m: float, texel_m: float, rng: Rng) -> Image:
        shape = size(width_m, height_m, texel_m)
        stretch = clouds((shape[0], max(4, shape[1] // 12)), texel_m, 0.04, 4, 0.8, rng)
        grain = np.asarray(cv2.resize(stretch, (shape[1], shape[0]), interpolation=cv2.INTER_LINEAR), np.float32)
        image = np.asarray(tone * (1 + 0.13 * grain), np.float32)
        plank = rng.uniform(0.09, 0.14)
        for index, top in enumerate(np.arange(0, height_m, plank)):
            rows = slice(int(top / texel_m), int((top + plank) / texel_m))
            image[rows] *= rng.normal(1, 0.12) if index else 1.0
            image[rows.start : rows.start + max(1, int(0.004 / texel_m))] *= 0.35
            for u in (0.03, width_m - 0.03):
                centre = (int(u / texel_m), int((top + plank / 2) / texel_m))
                cv2.circle(image, centre, max(1, int(0.005 / texel_m)), 0.3 * tone, -1, cv2.LINE_AA)
        word(image, texel_m, rng, 0.25 * min(width_m, height_m), 0.25 * tone)
        for _ in range(int(rng.integers(1, 6))):
            blot(image, texel_m, rng)
        return _limited(image)

    return texture


def word(image: Image, texel_m: float, rng: Rng, height_m: float, value: float) -> None:
    """A stencilled word or number somewhere on the chart, in place."""
    text = "".join(rng.choice(list("ABCDEFGHKLMNPRSTUVXYZ0123456789-"), int(rng.integers(3, 8))))
    scale = height_m / texel_m / 22
    if scale < 0.2:
        return
    thick = max(1, round(2.2 * scale))
    (wide, high), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, scale, thick)
    left = rng.uniform(0.05, 0.95) * max(1, image.shape[1] - wide)
    base = high + rng.uniform(0.05, 0.9) * max(1, image.shape[0] - high)
    layer = np.zeros(image.shape, np.uint8)
    cv2.putText(layer, text, (int(left), int(base)), cv2.FONT_HERSHEY_SIMPLEX, scale, (255,), thick, cv2.LINE_AA)
    mask = layer.astype(np.float32) / 255
    image += mask * (np.float32(value) - image)


def poster(width_m: float, height_m: float, texel_m: float, rng: Rng) -> Image:
    """A printed sheet: a frame, a headline, lines of text, a picture, a diagram."""
    shape = size(width_m, height_m, texel_m)
    paper = rng.uniform(0.5, 0.8)
    image = np.full(shape, paper, np.float32)
    ink = rng.uniform(0.05, 0.3)
    cv2.rectangle(image, (0, 0), (shape[1] - 1, shape[0] - 1), ink, max(1, int(0.01 / texel_m)))
    word(image[: shape[0] // 4], texel_m, rng, 0.16 * height_m, ink)
    top, left = int(shape[0] * rng.uniform(0.28, 0.4)), int(shape[1] * rng.uniform(0.08, 0.4))
    high, wide = int(shape[0] * rng.uniform(0.25, 0.45)), int(shape[1] * rng.uniform(0.3, 0.5))
    picture = 0.4 + 0.22 * clouds((high, wide), texel_m, 0.2, 6, 0.7, rng)
    target = image[top : top + high, left : left + wide]
    target[:] = np.clip(picture, 0.04, 0.85)[: target.shape[0], : target.shape[1]]
    for _ in range(int(rng.integers(2, 6))):
        corner = (rng.random(2) * [shape[1], shape[0]]).astype(int)
        radius = int(rng.uniform(0.03, 0.12) * min(shape))
        value, full = rng.uniform(0.05, 0.85), -1 if rng.random() < 0.6 else max(1, radius // 6)
        if rng.random() < 0.5:
            cv2.circle(image, corner.tolist(), max(1, radius), value, full, cv2.LINE_AA)
        else:
            far = (corner + radius * rng.uniform(0.6, 2.5, 2)).astype(int)
            cv2.rectangle(image, corner.tolist(), far.tolist(), value, full)
    line = max(3, int(0.018 / texel_m))
    for row in range(int(0.78 * shape[0]), shape[0] - line, line):
        _text_line(image, row, line, ink, rng)
    return _limited(image * (1 + 0.05 * clouds(shape, texel_m, 0.3, 3, 0.6, rng)))


def _text_line(image: Image, row: int, line: int, ink: float, rng: Rng) -> None:
    column = int(0.06 * image.shape[1])
    while column < 0.92 * image.shape[1]:
        length = int(rng.uniform(0.6, 3.0) * line)
        image[row : row + max(1, line // 2), column : column + length] = ink * rng.uniform(0.8, 1.6)
        column += length + max(1, line // 2)


def steel(tone: float, streaks: float = 0.05) -> Callable[..., Image]:
    """Drawn pipe: streaks along v, a few rust spots and marks; little to track."""

    def texture(width_m: float, height_m: float, texel_m: float, rng: Rng) -> Image:
        shape = size(width_m, height_m, texel_m)
        column = clouds((max(4, shape[0] // 40), shape[1]), texel_m, 0.02, 3, 0.8, rng)
        image = tone * (1 + streaks * cv2.resize(column, (shape[1], shape[0]), interpolation=cv2.INTER_LINEAR))
        image *= 1 + 0.06 * clouds(shape, texel_m, 0.25, 4, 0.6, rng)
        for _ in range(int(rng.poisson(3 + 25 * width_m * height_m))):
            spot = (rng.random(2) * [shape[1], shape[0]]).astype(int)
            radius = max(1, int(rng.gamma(1.5, 0.003) / texel_m))
            cv2.circle(image, spot.tolist(), radius, tone * rng.uniform(0.45, 0.8), -1, cv2.LINE_AA)
        return _limited(image)

    return texture


def stripes(width_m: float, height_m: float, texel_m: float, rng: Rng) -> Image:
    """Warning stripes, worn."""
    shape = size(width_m, height_m, texel_m)
    u = np.arange(shape[1], dtype=np.float32)[None, :] * texel_m
    v = np.arange(shape[0], dtype=np.float32)[:, None] * texel_m
    wave = np.sin((u + v) * 2 * np.pi / 0.12 + rng.uniform(0, 6))
    image = np.where(wave > 0, 0.55, 0.08).astype(np.float32)
    wear = np.clip(1.5 * clouds(shape, texel_m, 0.1, 5, 0.8, rng) - 0.9, 0, 1)
    return _limited(image + wear * (0.35 - image))


def grille(width_m: float, height_m: float, texel_m: float, rng: Rng) -> Image:
    """A cabinet's front: slots, a label, screws, a lamp."""
    image = plain(rng.uniform(0.25, 0.5), 0.015, 0.02)(width_m, height_m, texel_m, rng)
    rows, columns = image.shape
    for top in np.arange(0.15, rng.uniform(0.3, 0.5), 0.03):
        image[int(top * rows) : int((top + 0.012) * rows) + 1, int(0.2 * columns) : int(0.8 * columns)] *= 0.25
    label = image[int(0.6 * rows) : int(0.8 * rows), int(0.15 * columns) : int(0.7 * columns)]
    label[:] = 0.75
    word(label, texel_m, rng, 0.09 * height_m, 0.08)
    for u, v in ((0.05, 0.04), (0.95, 0.04), (0.05, 0.96), (0.95, 0.96), (0.85, 0.7)):
        cv2.circle(image, (int(u * columns), int(v * rows)), max(1, int(0.008 / texel_m)), 0.12, -1, cv2.LINE_AA)
    return image
