"""Which variables live as long as the process."""

import gtsam

from ...factors import keys

LONG_LIVED = "kedgbfhqpuvrw"
"""Calibration, depth, machine, boards with page and corners, points, and pipes, by the letter of their key."""


def long_lived(values: gtsam.Values) -> list[int]:
    """Keys of those that there are."""
    return [key for key in values.keys() if keys.kind(key) in LONG_LIVED]
