"""Corners spread over the image (Shi and Tomasi 1994), with a threshold that follows the view."""

import cv2
import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]
Image = NDArray[np.uint8]


def detect(
    image: Image, existing_px: Float, wanted: int, min_distance_px: float, margin_px: int, noise: float
) -> Float:
    """New corners (n, 2), strongest first within the cells of a grid, away from existing points.

    Args:
        image: grey image.
        existing_px: (m, 2), tracks that are there already.
        wanted: number of new corners at most.
        min_distance_px: between corners, old and new.
        margin_px: rim without corners.
        noise: standard deviation of the pixel noise; what noise alone would score is no corner.
    """
    if wanted <= 0:
        return np.zeros((0, 2))
    score = np.asarray(cv2.cornerMinEigenVal(image, 7, ksize=3), dtype=np.float32)
    peak = cv2.dilate(score, np.ones((3, 3), np.uint8))
    # cornerMinEigenVal scales by 1 / (4 * 255 * 7)^2 per sample; 49 samples of a Sobel response with variance 12 s^2.
    floor = 49 * 12 * (noise / (4 * 255.0 * 7)) ** 2 * 4.0
    threshold = max(floor, float(np.quantile(score[::3, ::3], 0.98)) * 0.005)
    good = (score == peak) & (score > threshold)
    good[:margin_px], good[-margin_px:], good[:, :margin_px], good[:, -margin_px:] = False, False, False, False
    v, u = np.nonzero(good)
    return _spread(u, v, score[v, u], existing_px, wanted, min_distance_px, image.shape)


def _spread(
    u: NDArray[np.int64],
    v: NDArray[np.int64],
    score: NDArray[np.float32],
    existing_px: Float,
    wanted: int,
    min_distance_px: float,
    shape: tuple[int, ...],
) -> Float:
    """Takes the best corner of every cell, then the second best, ..., keeping the distance."""
    rows, columns = 6, 9
    cell = (v * rows // shape[0]) * columns + u * columns // shape[1]
    order = np.lexsort((-score, cell))
    cell = cell[order]
    rank = np.arange(len(cell)) - np.searchsorted(cell, cell)
    load = np.zeros(rows * columns, dtype=np.int64)
    if len(existing_px):
        column = np.clip(existing_px[:, 0] * columns / shape[1], 0, columns - 1).astype(int)
        row = np.clip(existing_px[:, 1] * rows / shape[0], 0, rows - 1).astype(int)
        np.add.at(load, row * columns + column, 1)
    turn = np.argsort(rank + load[cell], kind="stable")
    order = order[turn]
    free = np.ones(shape[:2], dtype=np.uint8)
    radius = max(1, round(min_distance_px))
    for x, y in np.rint(existing_px).astype(int):
        cv2.circle(free, (int(x), int(y)), radius, 0, -1)
    chosen: list[tuple[int, int]] = []
    for x, y in zip(u[order].tolist(), v[order].tolist(), strict=True):
        if free[y, x]:
            chosen.append((x, y))
            if len(chosen) == wanted:
                break
            cv2.circle(free, (x, y), radius, 0, -1)
    return np.array(chosen, dtype=np.float64).reshape(-1, 2)


def apart(px: Float, others: Float, distance_px: float) -> Bool:
    """Which of px (n, 2) keep a distance from all others (m, 2)."""
    if len(others) == 0:
        return np.ones(len(px), dtype=bool)
    return (np.linalg.norm(px[:, None] - others[None], axis=2) > distance_px).all(axis=1)
