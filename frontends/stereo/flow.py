"""Pyramidal optical flow (Lucas and Kanade; Bouguet 2000) with a forward-backward check."""

import cv2
import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]
Image = NDArray[np.uint8]


def inside(px: Float, shape: tuple[int, ...], margin: float) -> Bool:
    """Which pixels (n, 2) lie in an image of `shape` with a margin; NaN does not."""
    with np.errstate(invalid="ignore"):
        return (
            (px[:, 0] >= margin)
            & (px[:, 1] >= margin)
            & (px[:, 0] <= shape[1] - 1 - margin)
            & (px[:, 1] <= shape[0] - 1 - margin)
        )


def flow(
    source: Image, target: Image, px: Float, guess: Float, window: int, levels: int, iterations: int = 15
) -> tuple[Float, Bool]:
    """Positions (n, 2) in `target` of points (n, 2) in `source`, and which were found."""
    if len(px) == 0:
        return guess.copy(), np.zeros(0, dtype=bool)
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, iterations, 0.02)
    found, status, _ = cv2.calcOpticalFlowPyrLK(
        source,
        target,
        px.astype(np.float32).reshape(-1, 1, 2),
        guess.astype(np.float32).reshape(-1, 1, 2).copy(),
        winSize=(window, window),
        maxLevel=levels,
        criteria=criteria,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        minEigThreshold=1e-5,
    )
    return found.reshape(-1, 2).astype(np.float64), status.ravel().astype(bool)


def checked_flow(
    source: Image,
    target: Image,
    px: Float,
    guess: Float,
    window: int,
    levels: int,
    tolerance_px: float,
    first_levels: int = 1,
) -> tuple[Float, Bool]:
    """Flow forth and back: positions (n, 2) and which came back to their start.

    The guess is mostly good to a few pixels: `first_levels` coarse levels do, and only those that fail there are
    looked for again from the coarsest level. Where most fail, the guess itself was wrong (a sudden turn).
    """
    found, good = _there_and_back(source, target, px, guess, window, first_levels, tolerance_px)
    if levels > first_levels and not good.all():
        again = ~good
        found[again], good[again] = _there_and_back(
            source, target, px[again], guess[again], window, levels, tolerance_px
        )
    return found, good


def _there_and_back(
    source: Image, target: Image, px: Float, guess: Float, window: int, levels: int, tolerance_px: float
) -> tuple[Float, Bool]:
    """The way back starts where the guessed flow leads back to, not at the answer; a smaller window does for it."""
    found, good = flow(source, target, px, guess, window, levels)
    good &= inside(found, target.shape, 1.0)
    if good.any():
        start = px[good] + found[good] - guess[good]
        smaller = 2 * (3 * window // 8) + 1
        returned, came_back = flow(target, source, found[good], start, smaller, min(levels, 1))
        off = returned - px[good]
        good[good] = came_back & (off[:, 0] ** 2 + off[:, 1] ** 2 < tolerance_px**2)
    return found, good
