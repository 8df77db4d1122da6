"""Noise of single pixels, apart from all that a model of the scene may get wrong."""

import numpy as np
from numpy.typing import NDArray

from .pixel_choice import Windows

Float = NDArray[np.float64]

_QUANTILE, _OF_NORMAL = 0.25, 0.3186394
"""A quarter of the absolute values of a normal variable are below so many sigmas. Edges sit in the upper quarters."""
_MOST_ROWS = 48


def pixel_noise(image: NDArray[np.uint8], windows: Windows) -> Float:
    """Standard deviation of the pixels of some windows, in grey values, shape (m,).

    Second differences along rows take out everything smooth (Immerkaer, "Fast noise variance estimation", 1996, does so
    in both directions); a low quantile leaves out the edges. Where light makes noise it is the noise of the dark parts:
    rather too low than too high. Zero where rounding hides all noise.
    """
    sigma = np.zeros(len(windows))
    for k, (x0, y0, x1, y1) in enumerate(windows):
        step = max(1, (y1 - y0) // _MOST_ROWS)
        part = image[y0:y1:step, x0:x1].astype(np.int16)
        if part.shape[1] < 4 or not len(part):
            continue
        second = np.abs(part[:, 2:] - 2 * part[:, 1:-1] + part[:, :-2]).ravel()
        place = int(_QUANTILE * len(second))
        sigma[k] = np.partition(second, place)[place] / (_OF_NORMAL * np.sqrt(6.0))
    return sigma
