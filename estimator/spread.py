"""A few of many tracks that still cover the image."""

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]


def spread(px: Float, rows: list[int], count: int) -> list[int]:
    """At most `count` rows, taken round robin from the cells of a coarse grid, so that they cover the image."""
    if len(rows) <= count:
        return rows
    cell = 1 + np.ptp(px[rows], axis=0) / 6
    bins: dict[tuple[int, int], list[int]] = {}
    for r in rows:
        u, v = (px[r] // cell).astype(int)
        bins.setdefault((int(u), int(v)), []).append(r)
    chosen: list[int] = []
    while len(chosen) < count:
        for members in bins.values():
            if members and len(chosen) < count:
                chosen.append(members.pop(0))
    return chosen
