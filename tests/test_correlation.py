"""Correlated errors of tracks: a known mixture is found again, though the fit of the landmarks hides most of it."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.sparse import csr_matrix
from scipy.sparse.linalg import splu

from surecut.estimator.correlation import KINDS, SEGMENT, Tracks, components, correlate, mean_factor, root
from surecut.estimator.graph import Record
from surecut.factors import keys

FAMILY = "stereo odometry"


class Factor:
    """What the correlation asks of a projection factor."""

    def __init__(self, px, keyframe):
        self._px, self._keyframe = px, keyframe

    def measured(self):
        return self._px

    def keys(self):
        return [keys.keyframe(self._keyframe)]


def run(draw, tracks=400, seed=3, longest=20):
    """Tracks of 4 to `longest` views with drawn errors (views, camera, axis), each with its fitted point (u, v,
    disparity)."""
    rng = np.random.default_rng(seed)
    active, errors, i, j, data = [], [], [], [], []
    for track in range(tracks):
        n = int(rng.integers(4, longest))
        px, noise = rng.uniform(0, 300, 2), draw(n, rng)
        for t in range(n):
            for camera, name in enumerate(("m_left", "m_right")):
                record = Record(FAMILY, name, t, f"track {track} in {name}", camera=name)
                row = 2 * len(active)
                i += [row, row + 1] + [row] * camera
                j += [3 * track, 3 * track + 1] + [3 * track + 2] * camera
                data += [1.0, 1.0] + [-1.0] * camera
                active.append((len(active), Factor(px, t), record))
                errors.append(noise[t, camera])
    error = np.concatenate(errors)
    A = csr_matrix((data, (i, j)), shape=(len(error), 3 * tracks))
    solve = splu((A.T @ A).tocsc()).solve
    b = error - A @ solve(A.T @ error)
    rows = 2 * np.arange(len(active) + 1)
    return active, SimpleNamespace(starts=rows, b=b, residuals_of=lambda errors: errors - A @ solve(A.T @ errors))


def white(n, rng):
    return rng.normal(size=(n, 2, 2))


def mixed(n, rng):
    """0.6 white in each image, 0.4 shared by both and over about five views."""
    slow = rng.normal(size=(n, 1, 2))
    for t in range(1, n):
        slow[t] = 0.8 * slow[t - 1] + 0.6 * slow[t]
    return np.sqrt(0.6) * white(n, rng) + np.sqrt(0.4) * slow


def test_white_noise_is_found_white():
    active, system = run(white)
    found = components(Tracks(active, FAMILY), system)
    assert found[KINDS.index((0.0, False))] == pytest.approx(1.0, abs=0.1)
    assert found.sum(axis=0) == pytest.approx(1.0, abs=0.06)


def test_a_mixture_is_found_though_the_fit_takes_most_of_it():
    active, system = run(mixed)
    assert (system.b**2).mean() < 0.85
    found = components(Tracks(active, FAMILY), system)
    shared = sum(found[k] for k, (rho, both) in enumerate(KINDS) if both and rho > 0)
    assert shared == pytest.approx(0.4, abs=0.12)
    assert found[-1] == pytest.approx(0.0, abs=0.02)
    assert found.sum(axis=0) == pytest.approx(1.0, abs=0.12)


def test_the_root_makes_the_covariance_of_a_track():
    active, system = run(white, tracks=40)
    tracks = Tracks(active, FAMILY)
    variances = np.zeros((len(KINDS), 2))
    variances[KINDS.index((0.0, False))] = 0.6
    variances[KINDS.index((0.8, True))] = 0.4
    factor = root(tracks, system, variances)
    covariance = (factor @ factor.T).toarray()
    # Rows of a track are by view: left u, v, right u, v.
    assert covariance[0, [0, 1, 2, 3]] == pytest.approx([1.0, 0.0, 0.4, 0.0], abs=1e-5)
    assert covariance[0, [4, 6]] == pytest.approx([0.32, 0.32], abs=1e-5)
    other = 4 * int((tracks.track == 0).sum())
    assert not covariance[0, other:].any()


def test_mean_of_correlated_values():
    n, rho = 7, 0.5
    apart = np.abs(np.arange(n)[:, None] - np.arange(n))
    assert mean_factor(rho, np.array([n]))[0] == pytest.approx((rho**apart).sum() / n)
    assert mean_factor(0.0, np.array([SEGMENT]))[0] == 1.0


def test_tracks_of_few_keyframes_tell_too():
    """None is long enough to be compared over seven keyframes; what is alike over three tells."""
    active, system = run(mixed, tracks=1200, longest=6)
    tracks = Tracks(active, FAMILY)
    assert tracks.lags == 4
    assert correlate(active[:400], None, system, FAMILY) is None
    found = components(tracks, system)
    shared = sum(found[k] for k, (rho, both) in enumerate(KINDS) if both and rho > 0)
    assert shared == pytest.approx(0.4, abs=0.15)
    assert found.sum(axis=0) == pytest.approx(1.0, abs=0.15)


def test_few_pairs_tell_nothing():
    active, system = run(mixed, tracks=5)
    assert correlate(active, None, system, FAMILY) is None
