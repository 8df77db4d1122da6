"""How much correlated tracks understate an estimate's variance: white noise gives 1, a known correlation its factor."""

from types import SimpleNamespace

import numpy as np
import pytest

from surecut.estimator.correlation import track_inflation
from surecut.estimator.graph import Record

FAMILY = "stereo odometry"


def residuals_of_tracks(rho: float, tracks: int = 400, seed: int = 3):
    """What is left of first-order autoregressive errors when each track's point is fitted: u, v and disparity."""
    rng = np.random.default_rng(seed)
    records, rows = [], []
    for track in range(tracks):
        n = int(rng.integers(8, 20))
        noise = rng.normal(size=(n, 4))
        for t in range(1, n):
            noise[t] = rho * noise[t - 1] + np.sqrt(1 - rho**2) * noise[t]
        left, right = noise[:, :2], noise[:, 2:]
        row = 0.5 * (left[:, 1] + right[:, 1]).mean()
        for camera, pixels in (("m_left", left), ("m_right", right)):
            rest = np.c_[pixels[:, 0] - pixels[:, 0].mean(), pixels[:, 1] - row]
            for t in range(n):
                records.append(Record(FAMILY, camera, t, f"track {track} in {camera}", camera=camera))
                rows.append(rest[t])
    starts = 2 * np.arange(len(records) + 1)
    return records, SimpleNamespace(starts=starts, b=np.concatenate(rows))


def test_white_noise_is_not_inflated():
    records, system = residuals_of_tracks(0.0)
    assert track_inflation(records, system, FAMILY) == pytest.approx(1.0, abs=0.03)


def test_a_known_correlation_gives_about_bartletts_factor():
    rho = 0.3
    records, system = residuals_of_tracks(rho)
    # The points take more of a correlated error with them, so that short tracks show a part of it only.
    assert 1.3 < track_inflation(records, system, FAMILY) < 1.05 * (1 + rho) / (1 - rho)


def test_few_pairs_tell_nothing():
    records, system = residuals_of_tracks(0.5, tracks=5)
    assert track_inflation(records, system, FAMILY) == 1.0
