"""Single corners of a board that are grossly wrong in one image, told from markers that are off their place.

A corner that the detector put elsewhere says nothing about its marker: the other three stay. A marker that has moved
on the page takes all of its corners with it, and one shift and turn explains them.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..factors.camera import CameraModel
from ..factors.chance import chi2_isf
from ..factors.measurements import MarkerSighting
from ..factors.rig import Board
from .board_fit import BoardCorners, BoardFit, board_corners, fit_board
from .board_pose import planar_poses

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]

FALSE_ALARM = 1e-5
"""Probability, per corner, that a good one is left out."""
FEWEST_CORNERS = 6
FEWEST_SHARE = 0.6
"""Corners that have to agree on one pose: with fewer, which of them are wrong is anybody's guess."""
FEWEST_LEFT = 2
"""A marker with fewer good corners is left out as a whole."""
MEDIAN_CHI2 = 1.386
"""Median of chi-square with two degrees of freedom."""
ROUNDS = 5
SIDE_FACTORS = (0.45, 0.67, 1.0, 1.5, 2.2)
"""Side lengths over the given one from which a page of unknown side starts."""


@dataclass(frozen=True, slots=True)
class Gross:
    """One thing that is left out."""

    sighting: MarkerSighting
    corner: int | None
    """None: the whole marker."""
    norm: float
    """Of the whitened residual."""
    limit: float


@dataclass(frozen=True, slots=True)
class _Majority:
    """What most corners agree on."""

    fit: BoardFit
    norms: Float
    """Shape (n,), of all corners' whitened residuals."""
    limit: float
    """Beyond it a corner is wrong: what chance allows, times how well the majority itself fits where that is worse."""

    @property
    def good(self) -> Bool:
        return self.norms < self.limit


def without_gross_corners(
    sightings: Sequence[MarkerSighting],
    board: Board,
    camera: CameraModel,
    side_m: float,
    common_px: float,
    side_free: bool = False,
) -> tuple[list[MarkerSighting], list[Gross]]:
    """The sightings with the corners named that contradict what the others agree on, and a list of these.

    Markers that are off their place stay whole. So does everything where no clear majority of corners agrees.

    Args:
        sightings: of `board`, from one image of `camera`.
        side_m: marker side; with `side_free` where to start from.
        common_px: as in `corner_covariance`.
    """
    corners = board_corners(sightings, board, common_px)
    found = _majority(corners, camera, side_m, side_free) if len(corners.px) >= FEWEST_CORNERS else None
    if found is None:
        return list(sightings), []
    side_m = float(found.fit.extra[0]) if side_free else side_m
    kept: list[MarkerSighting] = []
    left_out: list[Gross] = []
    for k, sighting in enumerate(sightings):
        own = np.flatnonzero(corners.marker == k)
        bad = np.flatnonzero(~found.good[own])
        if not len(bad) or (len(bad) > 1 and _is_moved(corners, found, k, camera, side_m)):
            kept.append(sighting)
        elif len(own) - len(bad) < FEWEST_LEFT:
            left_out.append(Gross(sighting, None, float(found.norms[own].max()), found.limit))
        else:
            names = [int(sighting.good[i]) for i in bad]
            kept.append(replace(sighting, gross=tuple(sorted((*sighting.gross, *names)))))
            norms = found.norms[own[bad]].tolist()
            left_out += [Gross(sighting, n, norm, found.limit) for n, norm in zip(names, norms, strict=True)]
    return kept, left_out


def _majority(corners: BoardCorners, camera: CameraModel, side_m: float, side_free: bool) -> _Majority | None:
    """The best of all starts: from all corners, else from those without one marker."""
    everything = np.ones(len(corners.px), dtype=bool)
    without_one = [corners.marker != k for k in range(int(corners.marker.max()) + 1)]
    for subsets in ([everything], without_one):
        found = [
            one
            for subset in subsets
            if subset.sum() >= 4
            for factor in (SIDE_FACTORS if side_free else (1.0,))
            for pose in planar_poses(corners.of(subset), camera, factor * side_m)
            if (one := _sharpened(corners, camera, pose, factor * side_m, side_free)) is not None
        ]
        best = min(found, key=lambda one: float(np.minimum(one.norms, one.limit).sum()), default=None)
        if best is not None and best.good.mean() >= FEWEST_SHARE:
            return best
    return None


def _sharpened(
    corners: BoardCorners, camera: CameraModel, pose: Float, side_m: float, side_free: bool
) -> _Majority | None:
    """Geman and McClure's loss, its scale halved from fit to fit down to the noise, then least squares of what agrees.

    Graduated non-convexity: Black and Rangarajan, On the unification of line processes, outlier rejection, and robust
    statistics, IJCV 19 (1996) 57.
    """
    least = float(np.sqrt(chi2_isf(FALSE_ALARM, 2)))
    fit = fit_board(corners, camera, pose, side_m)
    norms = _norms(corners, fit)
    scale = float(norms.max(initial=0.0))
    while np.isfinite(scale) and scale > least:
        weights = (scale**2 / (scale**2 + norms**2)) ** 2
        fit = fit_board(_weighted(corners, weights), camera, pose, side_m, side_free)
        pose, side_m = fit.camera_T_f, float(fit.extra[0]) if side_free else side_m
        norms, scale = _norms(corners, fit), scale / 2
    limit, before = least, np.zeros(len(norms), dtype=bool)
    for _ in range(ROUNDS):
        limit = least * float(np.sqrt(max(1.0, np.median(norms**2) / MEDIAN_CHI2)))
        good = norms < limit
        if good.sum() < FEWEST_CORNERS:
            return None
        if (good == before).all():
            break
        before = good
        fit = fit_board(_weighted(corners, np.where(good, 1.0, 1e-12)), camera, pose, side_m, side_free)
        pose, side_m = fit.camera_T_f, float(fit.extra[0]) if side_free else side_m
        norms = _norms(corners, fit)
    return _Majority(fit, norms, limit) if np.isfinite(norms).all() else None


def _weighted(corners: BoardCorners, weights: Float) -> BoardCorners:
    return replace(corners, covariance_px2=corners.covariance_px2 / np.maximum(weights, 1e-12)[:, None, None])


def _norms(corners: BoardCorners, fit: BoardFit) -> Float:
    """Whitened residuals (n,) by the corners' own covariance."""
    white = np.linalg.solve(np.linalg.cholesky(corners.covariance_px2), fit.residual_px[..., None])
    return np.asarray(np.linalg.norm(white[..., 0], axis=1))


def _is_moved(corners: BoardCorners, found: _Majority, k: int, camera: CameraModel, side_m: float) -> bool:
    """Does one shift and turn on the page explain all corners of a marker?"""
    own = corners.marker == k
    if own.sum() < 3:
        return False
    used = corners.of(own | found.good)
    fit = fit_board(used, camera, found.fit.camera_T_f, side_m, shifted=k)
    norms = _norms(used, fit)[used.marker == k]
    scale = found.limit**2 / chi2_isf(FALSE_ALARM, 2)
    return bool((norms**2).sum() < scale * chi2_isf(FALSE_ALARM, 2 * len(norms) - 3))
