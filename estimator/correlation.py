"""Errors of one track are alike in successive keyframes and in the two images of one, and a little like those of its
neighbours: how much, from the residuals.

All views of a track are found with one reference patch; where the patch looks different now, it does so in both images
and in the next keyframe too. Neighbours are on one surface, seen through one part of the lens. A landmark that is
fitted to a track takes most of what its errors share with it, so that residuals look smaller and less alike than the
errors are. So the correlation is not read off the residuals: errors of some kinds are drawn instead and sent through
the same adjustment, and the mixture is sought whose residuals look like those of the run (estimation of variance
components; Förstner 1979).
"""

from collections import defaultdict
from dataclasses import dataclass
from itertools import pairwise, product

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls
from scipy.sparse import csr_matrix

from ..factors import keys
from .graph import Record
from .linear import LinearSystem
from .motions import motion_blocks, windows

Float = NDArray[np.float64]
Int = NDArray[np.int64]
Bool = NDArray[np.bool_]
Active = list[tuple[int, gtsam.NonlinearFactor, Record]]
"""Factors with their index in the log and their record."""

LAGS, FEWEST_LAGS = 7, 2
"""Keyframes apart up to which residuals of one track are compared, where tracks are long enough; and at least."""
PERSISTENCE = (0.0, 0.5, 0.8)
"""Correlation of neighbours in the kinds of error: white, over two keyframes, over five."""
KINDS = tuple(product(PERSISTENCE, (False, True)))
"""Persistence, and whether left and right image share the error."""
DRAWS = 6
"""Draws per kind: each holds some ten thousand residuals."""
ENTRIES = 4_000_000
"""Of errors that are drawn at once: 32 MB."""
RANGE = 0.14
"""Distance over which errors of neighbours are alike, as a share of the image's diagonal."""
NEAR = (0.0, 0.07, 0.14, 0.28)
"""Distances of neighbours whose residuals are compared, likewise."""
MOTIONS = 12
"""Motions over a second that are looked at."""
PART = 0.6
"""Size of a part of the scene whose tracks may be wrong together, as a share of their typical distance."""
FEWEST_PAIRS = 300
"""Pairs of residuals, so many keyframes apart, that tell."""
SEGMENT = 16
"""Views of a track whose errors are taken to be correlated: longer tracks are several of them."""
CAMERAS = ("m_left", "m_right")


@dataclass(frozen=True, slots=True)
class Correlation:
    """What the errors of a family's tracks are like."""

    root: csr_matrix
    """Shape (rows, rows): times its transpose the covariance of the whitened errors of all factors."""
    inflation: float
    """Variance of the mean of a track's errors, on average, over that of white ones of the stated variance."""


def correlate(
    active: Active, values: gtsam.Values, system: LinearSystem, family: str, least: float = 1.0
) -> Correlation | None:
    """The errors of a family's tracks; None where too few tracks are long enough to tell.

    What neighbours share is not a matter of one track: it raises all of them by what it does to the camera's motion
    over a second.

    Args:
        active: all factors of a system.
        values: where it was linearised.
        system: the system.
        family: whose tracks are meant.
        least: what tracks must contribute to motions, over what their own covariance says, for the latter to hold.
    """
    tracks = Tracks(active, family)
    if tracks.lags < FEWEST_LAGS:
        return None
    variances = components(tracks, system)
    own, neighbours = variances[:-1], variances[-1]
    found, effect = root(tracks, system, own), 1.0
    influence = _influence_on_motions(tracks, values, system)
    if influence is not None:
        effect = _design_effect(tracks, system, influence, found, neighbours)
        effect *= _group_effect(tracks, values, system, influence, found * np.sqrt(effect), least)
    return Correlation(found * np.sqrt(effect), _inflation(tracks, own * effect))


def _influence_on_motions(tracks: "Tracks", values: gtsam.Values, system: LinearSystem) -> Float | None:
    """How motions over a second follow the whitened errors, shape (rows, 6 motions); None without any."""
    pairs = windows(tracks.stamps)
    pairs = [pairs[i] for i in np.linspace(0, len(pairs) - 1, min(len(pairs), MOTIONS)).round().astype(int)]
    right = [system.selector(motion_blocks(values, tracks.keyframes[a], tracks.keyframes[b])) for a, b in pairs]
    return np.asarray(system.A @ system.solve(np.hstack(right)), dtype=np.float64) if right else None


def _design_effect(
    tracks: "Tracks", system: LinearSystem, influence: Float, found: csr_matrix, neighbours: Float
) -> float:
    """Variance of motions with what neighbours share over that without (Kish 1965, design effect)."""
    if not neighbours.any():
        return 1.0
    alone = (np.asarray(found.T @ influence) ** 2).sum(axis=0)
    own = tracks.gather(system, influence).sum(axis=1)
    shared = np.zeros(len(alone))
    for image, kernel in zip(tracks.images, tracks.kernels, strict=True):
        for axis in range(2):
            shared += neighbours[axis] * (own[image, axis] * (kernel @ own[image, axis])).sum(axis=0)
    return 1.0 + float(np.median(shared / alone))


def _group_effect(
    tracks: "Tracks", values: gtsam.Values, system: LinearSystem, influence: Float, found: csr_matrix, least: float
) -> float:
    """Variance of motions by what whole groups of tracks contribute to them over what the errors' covariance says.

    What a track contributes is a sum over its views, whatever makes them alike, and however much tracks differ in how
    wrong they are; tracks of one part of the scene may be wrong together (cluster-robust variance; Liang and Zeger
    1986). Residuals are smaller than errors: those of errors that are drawn from the covariance tell by how much. The
    worse of the two accounts counts, and `least` at least.
    """
    errors = found @ np.random.default_rng(1).normal(size=(len(system.b), DRAWS))
    whole = tracks.contributed(system, np.column_stack([system.b, system.residuals_of(errors)]), influence)
    ratios = [_contributed(whole)]
    ratios.append(float(np.mean([_contributed(_summed(whole, group)) for group in _parts(tracks, values)])))
    return max(*ratios, least)


def _contributed(groups: Float) -> float:
    """Squares of what groups contribute, shape (groups, 1 + draws, motions): the first over the mean of the draws."""
    squares = (groups**2).sum(axis=0)
    return float(np.mean(squares[0] / np.mean(squares[1:], axis=0)))


def _summed(whole: Float, group: Int) -> Float:
    """Sums over the members of each group, of which there are 0, 1, ..."""
    order = np.argsort(group, kind="stable")
    return np.add.reduceat(whole[order], np.flatnonzero(np.r_[True, np.diff(group[order]) > 0]))


def _parts(tracks: "Tracks", values: gtsam.Values) -> list[Int]:
    """Tracks (n,) by the part of the scene that they are in: cells of space, for two grids."""
    points = np.array([values.atPoint3(_key(first, "l")) for first in tracks.firsts])
    seen_from = np.array([values.atPose3(_key(first, "x")).translation() for first in tracks.firsts])
    size = PART * float(np.median(np.linalg.norm(points - seen_from, axis=1)))
    cells = [np.floor((points - points.min(axis=0)) / size + shift).astype(np.int64) for shift in (0.0, 0.5)]
    return [np.unique(cell, axis=0, return_inverse=True)[1].ravel() for cell in cells]


def root(tracks: "Tracks", system: LinearSystem, variances: Float) -> csr_matrix:
    """Cholesky factor of the covariance of all whitened errors: blocks of tracks, one elsewhere.

    Args:
        tracks: whose errors are correlated.
        system: tells the rows.
        variances: shape (kinds, 2), of every kind of error.
    """
    segment = tracks.track * (int(tracks.place.max()) // SEGMENT + 1) + tracks.place // SEGMENT
    starts = np.flatnonzero(np.r_[True, segment[1:] != segment[:-1]])
    covariance, first = _segment_covariance(variances), tracks.first_rows(system)
    known: dict[bytes, Float] = {}
    i, j, data = [], [], []
    for a, b in zip(starts, np.r_[starts[1:], len(segment)], strict=True):
        seen = tracks.seen[a:b].ravel()
        rows = first[a:b].ravel()[seen]
        if seen.tobytes() not in known:
            at = np.flatnonzero(seen)
            own = covariance[:, at[:, None], at]
            known[seen.tobytes()] = np.asarray(np.linalg.cholesky(own), dtype=np.float64)
        for axis, factor in enumerate(known[seen.tobytes()]):
            i.append(np.repeat(rows + axis, len(rows)))
            j.append(np.tile(rows + axis, len(rows)))
            data.append(factor.ravel())
    others = np.setdiff1d(np.arange(len(system.b)), np.concatenate(i))
    entries = np.concatenate([*data, np.ones(len(others))])
    place = np.concatenate([*i, others]), np.concatenate([*j, others])
    found = csr_matrix((entries, place), shape=(len(system.b), len(system.b)))
    found.eliminate_zeros()
    return found


def _segment_covariance(variances: Float) -> Float:
    """Covariance (2, 2 SEGMENT, 2 SEGMENT) by axis of the errors in successive keyframes, left and right by turns."""
    place = np.repeat(np.arange(SEGMENT), 2)
    same = (np.arange(2 * SEGMENT)[:, None] - np.arange(2 * SEGMENT)) % 2 == 0
    total = np.zeros((2, 2 * SEGMENT, 2 * SEGMENT))
    for variance, (rho, shared) in zip(variances, KINDS, strict=True):
        apart = np.abs(place[:, None] - place)
        kind = np.where(apart == 0, 1.0, rho**apart) * (same | shared)
        total += variance[:, None, None] * kind
    return total + 1e-6 * np.eye(2 * SEGMENT)


def _inflation(tracks: "Tracks", variances: Float) -> float:
    """Of the mean over each track's views in both images, on average."""
    length = np.bincount(tracks.track)
    factor = np.zeros(len(length))
    for variance, (rho, shared) in zip(variances, KINDS, strict=True):
        factor += (2.0 if shared else 1.0) * float(variance.mean()) * mean_factor(rho, length)
    return max(float((factor * length).sum() / length.sum()), 1.0)


def mean_factor(rho: float, count: Int) -> Float:
    """Variance of the mean of `count` values of an AR(1) process over that of independent ones."""
    if rho == 0.0:
        return np.ones(len(count))
    return (1 + rho) / (1 - rho) - 2 * rho * (1 - rho**count) / (count * (1 - rho) ** 2)


def components(tracks: "Tracks", system: LinearSystem) -> Float:
    """Variance of every kind of error in u and v, in units of what the whitening says; shape (kinds + 1, 2).

    The last one is what neighbours share.
    """
    rng = np.random.default_rng(0)
    seen, counts = tracks.products(tracks.gather(system, system.b[:, None]))
    drawn = [tracks.draw(rho, shared, DRAWS, rng) for rho, shared in KINDS]
    drawn.append(tracks.draw_neighbours(DRAWS, rng))
    together = max(1, ENTRIES // (4 * DRAWS * len(tracks.track)))
    expected = []
    for start in range(0, len(drawn), together):
        errors = np.concatenate(drawn[start : start + together], axis=-1)
        whole = np.zeros((len(system.b), errors.shape[-1]))
        for camera in range(2):
            whole[tracks.rows(system, camera)] = errors[tracks.seen[:, camera], camera]
        products = tracks.products(tracks.gather(system, system.residuals_of(whole)))[0]
        expected.append(products.reshape(len(counts), 2, -1, DRAWS).mean(axis=-1))
    weight = np.sqrt(counts)
    design = np.concatenate(expected, axis=-1) * weight[:, None, None]
    return np.stack([nnls(design[:, axis], seen[:, axis, 0] * weight)[0] for axis in range(2)], axis=1)


class Tracks:
    """A family's factors in the order of tracks, of time within each, and of the two cameras.

    Args:
        active: all factors of a system.
        family: the one that is meant.
    """

    def __init__(self, active: Active, family: str) -> None:
        views: dict[str, dict[int, list[int]]] = defaultdict(dict)
        for position, (_, _, record) in enumerate(active):
            if record.family == family and record.camera in CAMERAS:
                track = record.what.split(" in ")[0]
                views[track].setdefault(record.stamp_ns, [-1, -1])[CAMERAS.index(record.camera)] = position
        self.track: Int = np.repeat(np.arange(len(views)), [len(seen) for seen in views.values()])
        """Shape (n,), one entry for every keyframe of every track."""
        self.place: Int = np.array([i for seen in views.values() for i in range(len(seen))], dtype=np.int64)
        """Shape (n,), number of the keyframe in its track."""
        pairs = [int((self.track[lag:] == self.track[:-lag]).sum()) for lag in range(1, LAGS + 1)]
        self.lags = sum(n >= FEWEST_PAIRS for n in pairs)
        """Keyframes apart up to which there are residuals enough to compare."""
        factor = [seen[stamp] for seen in views.values() for stamp in sorted(seen)]
        self._factor: Int = np.array(factor, dtype=np.int64).reshape(-1, 2)
        self.seen: Bool = self._factor >= 0
        """Shape (n, 2), in which of the two images."""
        stamps = np.array([stamp for seen in views.values() for stamp in sorted(seen)], dtype=np.int64)
        order = np.argsort(stamps, kind="stable")
        self.images = np.split(order, np.flatnonzero(np.diff(stamps[order])) + 1) if len(order) else []
        """Entries of one keyframe each, in the order of time."""
        self.firsts = [active[self._factor[i].max()][1] for i in np.flatnonzero(self.place == 0)]
        """By track, a factor of its first keyframe."""
        self.stamps: list[int] = [int(stamps[i[0]]) for i in self.images]
        self.keyframes = [_key(active[self._factor[i[0]].max()][1], "x") for i in self.images]
        px = self._pixels(active)
        diagonal = float(np.linalg.norm(np.ptp(px, axis=0))) if len(px) else 1.0
        self._apart = [np.linalg.norm(px[i][:, None] - px[i], axis=2) / diagonal for i in self.images]
        self.kernels = [np.exp(-apart / RANGE) for apart in self._apart]
        """By keyframe: correlation of what neighbours share, shape (m, m)."""

    def _pixels(self, active: Active) -> Float:
        """Shape (n, 2), in one of the two images."""
        measured = [active[max(pair)][1].measured() for pair in self._factor]
        return np.array(measured, dtype=np.float64).reshape(-1, 2)

    def rows(self, system: LinearSystem, camera: int) -> Int:
        """Rows (m, 2) of what one camera saw."""
        return self.first_rows(system)[self.seen[:, camera], camera][:, None] + np.arange(2)

    def first_rows(self, system: LinearSystem) -> Int:
        """First row (n, 2) of every factor; meaningless where the camera saw nothing."""
        return system.starts[self._factor]

    def gather(self, system: LinearSystem, residuals: Float) -> Float:
        """Residuals (rows, k) as (n, camera, axis, k), zero where the camera saw nothing."""
        own = np.zeros((len(self.track), 2, 2, residuals.shape[1]))
        for camera in range(2):
            own[self.seen[:, camera], camera] = residuals[self.rows(system, camera)]
        return own

    def contributed(self, system: LinearSystem, residuals: Float, influence: Float) -> Float:
        """What each whole track contributes to some quantities: shape (tracks, k, m).

        Args:
            residuals: (rows, k).
            influence: how the quantities follow the whitened errors, (rows, m).
        """
        seen, moves = self.gather(system, residuals), self.gather(system, influence)
        length = np.bincount(self.track)
        first = np.cumsum(length) - length
        found = np.empty((len(length), residuals.shape[1], influence.shape[1]))
        for n in np.unique(length).tolist():
            alike = np.flatnonzero(length == n)
            entries = first[alike][:, None] + np.arange(n)
            left = seen[entries].reshape(len(alike), 4 * n, -1).transpose(0, 2, 1)
            found[alike] = left @ moves[entries].reshape(len(alike), 4 * n, -1)
        return found

    def products(self, own: Float) -> tuple[Float, Float]:
        """Mean products of residuals (n, camera, axis, k) of one track, and of how many.

        Returns:
            shape (s, axis, k) and (s,): 0, 1, ... keyframes apart in one camera, then in different cameras; then
            neighbours in one image.
        """
        means, counts = [], []
        for other in (False, True):
            for lag in range(self.lags + 1):
                last = len(own) - lag
                late, seen = (own[lag:, ::-1], self.seen[lag:, ::-1]) if other else (own[lag:], self.seen[lag:])
                both = (self.track[lag:] == self.track[:last])[:, None] & seen & self.seen[:last]
                counts.append(max(int(both.sum()), 1))
                means.append(np.einsum("icak,icak,ic->ak", late, own[:last], both.astype(float)) / counts[-1])
        for low, high in pairwise(NEAR):
            total, count = self._neighbours(own, low, high)
            means.append(total / max(count, 1))
            counts.append(max(count, 1))
        return np.array(means, dtype=np.float64), np.array(counts, dtype=np.float64)

    def _neighbours(self, own: Float, low: float, high: float) -> tuple[Float, int]:
        """Sum (axis, k) over pairs of one image that are so far apart, and their number."""
        total, count = np.zeros(own.shape[2:]), 0
        for image, apart in zip(self.images, self._apart, strict=True):
            near = ((apart > low) & (apart <= high)).astype(np.float64)
            values = own[image]
            others = (near @ values.reshape(len(image), -1)).reshape(values.shape)
            total += (others * values).sum(axis=(0, 1))
            seen = self.seen[image].astype(np.float64)
            count += int((near @ seen * seen).sum())
        return total, count

    def draw(self, rho: float, shared: bool, count: int, rng: np.random.Generator) -> Float:
        """Errors (n, camera, axis, count) of unit variance that persist along each track."""
        errors = rng.normal(size=(len(self.track), 1 if shared else 2, 2, count))
        if rho > 0.0:
            errors[self.place > 0] *= np.sqrt(1 - rho**2)
            for place in range(1, int(self.place.max()) + 1):
                at = np.flatnonzero(self.place == place)
                errors[at] += rho * errors[at - 1]
        return np.broadcast_to(errors, (len(self.track), 2, 2, count))

    def draw_neighbours(self, count: int, rng: np.random.Generator) -> Float:
        """Errors (n, camera, axis, count) of unit variance that neighbours and both images of a keyframe share."""
        errors = np.zeros((len(self.track), 1, 2, count))
        for image, kernel in zip(self.images, self.kernels, strict=True):
            factor = np.linalg.cholesky(kernel + 1e-6 * np.eye(len(image)))
            errors[image, 0] = np.einsum("ij,jak->iak", factor, rng.normal(size=(len(image), 2, count)))
        return np.broadcast_to(errors, (len(self.track), 2, 2, count))


def _key(factor: gtsam.NonlinearFactor, kind: str) -> int:
    return next(key for key in factor.keys() if keys.kind(key) == kind)
