"""Errors of one track are alike in successive keyframes, and in the two images of one: how much, from the residuals.

All views of a track are found with one reference patch; where the patch looks different now, it does so in both images
and in the next keyframe too. A landmark that is fitted to a track takes most of what its errors share with it, so that
residuals look smaller and less alike than the errors are. So the correlation is not read off the residuals: errors of
some kinds are drawn instead and sent through the same adjustment, and the mixture is sought whose residuals look like
those of the run (estimation of variance components; Förstner 1979).
"""

from collections import defaultdict
from itertools import product

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls

from .graph import Record
from .linear import LinearSystem

Float = NDArray[np.float64]
Int = NDArray[np.int64]
Bool = NDArray[np.bool_]
Active = list[tuple[int, gtsam.NonlinearFactor, Record]]
"""Factors with their index in the log and their record."""

LAGS = 7
"""Keyframes apart up to which residuals of one track are compared."""
PERSISTENCE = (0.0, 0.5, 0.8)
"""Correlation of neighbours in the kinds of error: white, over two keyframes, over five."""
KINDS = tuple(product(PERSISTENCE, (False, True)))
"""Persistence, and whether left and right image share the error."""
DRAWS = 6
"""Draws per kind: each holds some ten thousand residuals."""
FEWEST_PAIRS = 300
"""Pairs of residuals, `LAGS` apart, that tell."""
LARGEST = 10.0
CAMERAS = ("m_left", "m_right")


def track_inflation(records: list[Record], system: LinearSystem, family: str) -> Float:
    """Per row, by how much white-noise variances understate what the correlated errors of its track leave.

    An error that persists with correlation rho leaves in a mean over n views the variance of n independent ones times
    sum_ik rho^|i - k| / n; one that both images share leaves twice that of independent ones. (It leaves nothing in the
    disparity, whose covariance is therefore on the safe side.)

    Returns:
        Shape (rows,), at least 1; exactly 1 where too few tracks are long enough to tell.
    """
    factors = np.ones(len(system.b))
    tracks = Tracks(records, family)
    if len(tracks.track) == 0 or int((tracks.track[LAGS:] == tracks.track[:-LAGS]).sum()) < FEWEST_PAIRS:
        return factors
    variances = components(tracks, system)
    length = np.bincount(tracks.track)[tracks.track]
    inflation = np.zeros((len(length), 2))
    for variance, (rho, shared) in zip(variances, KINDS, strict=True):
        inflation += (2.0 if shared else 1.0) * mean_factor(rho, length)[:, None] * variance
    for camera in range(2):
        rows = tracks.rows(system, camera)
        factors[rows] = np.clip(inflation[tracks.seen[:, camera]], 1.0, LARGEST)
    return factors


def mean_factor(rho: float, count: Int) -> Float:
    """Variance of the mean of `count` values of an AR(1) process over that of independent ones."""
    if rho == 0.0:
        return np.ones(len(count))
    return (1 + rho) / (1 - rho) - 2 * rho * (1 - rho**count) / (count * (1 - rho) ** 2)


def components(tracks: "Tracks", system: LinearSystem) -> Float:
    """Variance of every kind of error in u and v, in units of what the whitening says; shape (kinds, 2)."""
    rng = np.random.default_rng(0)
    seen, counts = tracks.products(tracks.gather(system, system.b[:, None]))
    expected = []
    for rho, shared in KINDS:
        errors = np.zeros((len(system.b), DRAWS))
        drawn = tracks.draw(rho, shared, DRAWS, rng)
        for camera in range(2):
            errors[tracks.rows(system, camera)] = drawn[tracks.seen[:, camera], camera]
        residuals = errors - system.A @ system.solve(system.A.T @ errors)
        expected.append(tracks.products(tracks.gather(system, residuals))[0])
    weight = np.sqrt(counts)
    design = np.stack(expected, axis=-1) * weight[:, None, None]
    return np.stack([nnls(design[:, axis], seen[:, axis] * weight)[0] for axis in range(2)], axis=1)


class Tracks:
    """A family's factors in the order of tracks, of time within each, and of the two cameras.

    Args:
        records: of all factors of a system.
        family: the one that is meant.
    """

    def __init__(self, records: list[Record], family: str) -> None:
        views: dict[str, dict[int, list[int]]] = defaultdict(dict)
        for position, record in enumerate(records):
            if record.family == family and record.camera in CAMERAS:
                track = record.what.split(" in ")[0]
                views[track].setdefault(record.stamp_ns, [-1, -1])[CAMERAS.index(record.camera)] = position
        self.track: Int = np.repeat(np.arange(len(views)), [len(seen) for seen in views.values()])
        """Shape (n,), one entry for every keyframe of every track."""
        self.place: Int = np.array([i for seen in views.values() for i in range(len(seen))], dtype=np.int64)
        """Shape (n,), number of the keyframe in its track."""
        factor = [seen[stamp] for seen in views.values() for stamp in sorted(seen)]
        self._factor: Int = np.array(factor, dtype=np.int64).reshape(-1, 2)
        self.seen: Bool = self._factor >= 0
        """Shape (n, 2), in which of the two images."""

    def rows(self, system: LinearSystem, camera: int) -> Int:
        """Rows (m, 2) of what one camera saw."""
        return system.starts[self._factor[self.seen[:, camera], camera]][:, None] + np.arange(2)

    def gather(self, system: LinearSystem, residuals: Float) -> Float:
        """Residuals (rows, k) as (n, camera, axis, k), zero where the camera saw nothing."""
        own = np.zeros((len(self.track), 2, 2, residuals.shape[1]))
        for camera in range(2):
            own[self.seen[:, camera], camera] = residuals[self.rows(system, camera)]
        return own

    def products(self, own: Float) -> tuple[Float, Float]:
        """Mean products of residuals (n, camera, axis, k) of one track, and of how many.

        Returns:
            shape (s, axis) and (s,): 0, 1, ... keyframes apart in one camera, then in different cameras.
        """
        means, counts = [], []
        for other in (False, True):
            for lag in range(LAGS + 1):
                last = len(own) - lag
                late, seen = (own[lag:, ::-1], self.seen[lag:, ::-1]) if other else (own[lag:], self.seen[lag:])
                both = (self.track[lag:] == self.track[:last])[:, None] & seen & self.seen[:last]
                counts.append(max(int(both.sum()), 1))
                means.append((late * own[:last]).sum(axis=(0, 1)).mean(axis=-1) / counts[-1] if both.any() else [0, 0])
        return np.array(means, dtype=np.float64), np.array(counts, dtype=np.float64)

    def draw(self, rho: float, shared: bool, count: int, rng: np.random.Generator) -> Float:
        """Errors (n, camera, axis, count) of unit variance that persist along each track."""
        errors = rng.normal(size=(len(self.track), 1 if shared else 2, 2, count))
        if rho > 0.0:
            errors[self.place > 0] *= np.sqrt(1 - rho**2)
            for place in range(1, int(self.place.max()) + 1):
                at = np.flatnonzero(self.place == place)
                errors[at] += rho * errors[at - 1]
        return np.broadcast_to(errors, (len(self.track), 2, 2, count))
