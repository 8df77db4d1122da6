"""The marker front end of one camera: images in, corners with covariances out, at video rate."""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from ...factors.camera import CameraModel
from ...factors.measurements import CameraName, MarkerSighting, Rejection
from ...factors.rig import Board, Rig
from ..undistort import distort, undistort, undistorted_grid
from .board_layout import DOUBLED, IN_PLACE, apart_on_page, predict_missing
from .dictionaries import MarkerDictionary, marker_dictionary
from .independent_corners import independent_scale
from .pattern_fit import PatternFit, Warm, fit_patterns
from .search import Candidate, MarkerSearch
from .tracking import Followed, MarkerFlow

Float = NDArray[np.float64]

CORNER_FLOOR_PX = 0.004
"""What blur, sampling and the model leave on a corner where there is no noise at all (docs/corners.md)."""
_MIN_CORRELATION = 0.80
"""Pixels with the fitted pattern, for a marker that was read."""
_MIN_CORRELATION_PREDICTED = 0.90
"""The same for one that was only expected there."""
_UNEXPLAINED, _UNEXPLAINED_GROWTH = 0.02, 4.0
"""Share of the pixels' variance that the pattern may leave over, or how many times what it left in the last image, for
a marker that is followed and not read again."""
_MIN_CONTRAST = 8.0
"""Grey values between black and white."""
_MIN_SHARE = 0.5
"""Of the pattern's edges, what has to be seen as the model says."""
_SAME_PLACE = 0.2
"""Share of its side by which a marker that was read may lie off the place where it was followed to."""
_SETTLED_PX = 0.3
_MAX_SIGMA_CELLS = 0.5
"""A corner that is not known to half a cell is no measurement."""


@dataclass(frozen=True, slots=True)
class _Fitted:
    """A candidate after the fit."""

    candidate: Candidate
    corners: Float
    covariance: Float
    correlation: float
    contrast: float
    structure: float
    """Share of the covariance that is not the pixels' noise."""
    warm: Warm
    problem: tuple[str, float, float] | None
    """Reason, value and limit of a refusal."""


class MarkerFrontEnd:
    """Finds the rig's markers in the images of one camera.

    Follows the markers of the last image; looks where the boards were last when one of them is in doubt, and at the
    whole image in a slower rhythm or when something is missing. Markers that were not read although their board was are
    looked for where they must be.
    """

    def __init__(self, rig: Rig, camera: CameraModel, camera_name: CameraName) -> None:
        """
        Raises:
            RigError: a board's dictionary is not one that OpenCV can find in images.
            SurecutError: the camera's distortion model is unknown.
        """
        self._camera = camera
        self._name: CameraName = camera_name
        self._boards: dict[tuple[str, int], Board] = {}
        self._dictionaries: dict[str, MarkerDictionary] = {}
        self._patterns: dict[tuple[str, int], Float] = {}
        for board in rig.boards:
            dictionary = marker_dictionary(board.dictionary)
            self._dictionaries[dictionary.name] = dictionary
            for marker in board.markers:
                self._boards[dictionary.name, marker.id] = board
                if marker.id < dictionary.size:
                    self._patterns[dictionary.name, marker.id] = dictionary.pattern(marker.id)
        self._search = MarkerSearch(tuple(self._dictionaries.values()))
        self._flow = MarkerFlow()
        self._positions: Float | None = None
        if not _is_pinhole(camera):
            self._positions = undistorted_grid(camera)

    def process(self, stamp_ns: int, image: NDArray[np.uint8]) -> tuple[list[MarkerSighting], list[Rejection]]:
        """The markers in one image, and what was refused.

        Args:
            stamp_ns: the sensor's time.
            image: shape (height, width) grey or (height, width, 3) BGR.
        """
        grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
        grey = np.ascontiguousarray(grey, np.uint8)
        good, rejections = self._followed(grey), []
        if good is not None and not self._search.due():
            self._search.passed()
        else:
            good, rejections = self._searched(stamp_ns, grey, good or [])
        good += self._expected(grey, good)
        sightings = self._sightings(stamp_ns, good)
        self._search.remember([s.raw_px for s in sightings], grey.shape)
        followed = zip(good, sightings, strict=True)
        self._flow.remember(
            grey.copy() if grey is image else grey,
            [Followed(*f.candidate.key, s.raw_px, f.correlation, f.warm) for f, s in followed],
        )
        return sightings, rejections

    def _followed(self, grey: NDArray[np.uint8]) -> list[_Fitted] | None:
        """The markers of the last image, all of them, where their corners have gone; None when any is in doubt."""
        raw = self._flow.follow(grey)
        if raw is None:
            return None
        before = self._flow.markers
        result: list[_Fitted] = []
        for cells in sorted({self._dictionaries[m.dictionary].cells for m in before}):
            index = [k for k, m in enumerate(before) if self._dictionaries[m.dictionary].cells == cells]
            ideal = self._ideal(raw[index])
            if not np.isfinite(ideal).all():
                return None
            group = [before[k] for k in index]
            candidates = [Candidate(m.dictionary, m.marker, c) for m, c in zip(group, ideal, strict=True)]
            patterns = [self._patterns[c.key] for c in candidates]
            warm = Warm.together([m.warm for m in group])
            fit = fit_patterns(grey, ideal, patterns, self._positions, raw[index], warm)
            for k, m in enumerate(group):
                unexplained = max(_UNEXPLAINED_GROWTH * (1.0 - m.correlation**2), _UNEXPLAINED)
                limit = max(_MIN_CORRELATION, float(np.sqrt(max(1.0 - unexplained, 0.0))))
                result.append(_judged(candidates[k], ideal[k], fit, k, cells, limit))
        return result if all(f.problem is None for f in result) else None

    def _searched(
        self, stamp_ns: int, grey: NDArray[np.uint8], followed: list[_Fitted]
    ) -> tuple[list[_Fitted], list[Rejection]]:
        """Markers that are read in the image, and what was refused.

        Where nothing was read but the markers that were followed here, their fits stand.
        """
        found = self._search.find(grey)
        known = [c for c in found if (c.dictionary, c.marker) in self._patterns]
        unknown = [c for c in found if (c.dictionary, c.marker) not in self._patterns]
        rejections = [] if not unknown else [self._unknown(stamp_ns, unknown)]
        if self._confirmed(followed, known):
            return followed, rejections
        fitted = self._fit(grey, known, _MIN_CORRELATION)
        good, refused = self._one_per_marker([f for f in fitted if f.problem is None])
        refused += [f for f in fitted if f.problem is not None]
        return good, [*rejections, *(self._rejection(stamp_ns, f) for f in refused)]

    def _confirmed(self, followed: list[_Fitted], read: list[Candidate]) -> bool:
        """Do the markers that were followed stand by what was read: each once, where it was followed to, none beside
        them, and those that were not read on a board that was, and as plain as one that is only expected must be?"""
        places = {f.candidate.key: f.corners for f in followed}
        keys = {c.key for c in read}
        if not keys or len(keys) < len(read) or not keys <= set(places):
            return False
        boards = {self._boards[key].id for key in keys}
        for f in followed:
            known = self._boards[f.candidate.key].id in boards and f.correlation >= _MIN_CORRELATION_PREDICTED
            if f.candidate.key not in keys and not known:
                return False
        off = [np.abs(self._ours(c, False) - places[c.key]).max() for c in read]
        sides = [np.sqrt(cv2.contourArea(places[c.key].astype(np.float32))) for c in read]
        return bool(np.all(np.array(off) < _SAME_PLACE * np.array(sides)))

    def _expected(self, grey: NDArray[np.uint8], good: list[_Fitted]) -> list[_Fitted]:
        """Markers of the boards in view that were not read, where they fit the image."""
        seen = {f.candidate.key: f.corners for f in good}
        missing = []
        for (dictionary, marker), corners in predict_missing(self._boards, seen).items():
            if (dictionary, marker) in self._patterns and self._in_view(corners, grey.shape):
                missing.append(Candidate(dictionary, marker, corners))
        fitted = self._fit(grey, missing, _MIN_CORRELATION_PREDICTED, ideal=True)
        contrast = np.median([f.contrast for f in good]) if good else 0.0
        return [f for f in fitted if f.problem is None and f.contrast > 0.4 * contrast]

    def _in_view(self, ideal: Float, shape: tuple[int, ...]) -> bool:
        raw = distort(self._camera, ideal)
        inside = (raw > 2) & (raw < [shape[1] - 3, shape[0] - 3])
        area = cv2.contourArea(ideal.astype(np.float32))
        return bool(inside.all()) and area > 60.0

    def _fit(
        self, grey: NDArray[np.uint8], candidates: list[Candidate], min_correlation: float, ideal: bool = False
    ) -> list[_Fitted]:
        """Fits of the candidates, markers with the same number of cells together."""
        result = []
        for cells in sorted({self._dictionaries[c.dictionary].cells for c in candidates}):
            group = [c for c in candidates if self._dictionaries[c.dictionary].cells == cells]
            starts = np.stack([self._ours(c, ideal) for c in group])
            keep = np.flatnonzero(np.isfinite(starts).all((1, 2)))
            group, starts = [group[k] for k in keep], starts[keep]
            if group:
                patterns = [self._patterns[c.key] for c in group]
                raw = None if self._positions is None else distort(self._camera, starts)
                fit = fit_patterns(grey, starts, patterns, self._positions, raw)
                result += [_judged(c, starts[k], fit, k, cells, min_correlation) for k, c in enumerate(group)]
        return result

    def _ours(self, candidate: Candidate, ideal: bool) -> Float:
        if ideal:
            return candidate.corners
        order = self._dictionaries[candidate.dictionary].from_opencv
        return self._ideal(candidate.corners[list(order)])

    def _ideal(self, raw: Float) -> Float:
        """Where a fit begins, shape (..., 2): between the pixels as the lens bends the pixels round it."""
        if self._positions is None:
            return undistort(self._camera, raw)[0]
        height, width = self._positions.shape[:2]
        x, y = raw[..., 0], raw[..., 1]
        if not ((x >= 0) & (y >= 0) & (x <= width - 1) & (y <= height - 1)).all():
            return undistort(self._camera, raw)[0]
        left, top = np.minimum(x.astype(int), width - 2), np.minimum(y.astype(int), height - 2)
        s, t = (x - left)[..., None], (y - top)[..., None]
        grid = self._positions
        upper = (1 - s) * grid[top, left] + s * grid[top, left + 1]
        lower = (1 - s) * grid[top + 1, left] + s * grid[top + 1, left + 1]
        return (1 - t) * upper + t * lower

    def _one_per_marker(self, fitted: list[_Fitted]) -> tuple[list[_Fitted], list[_Fitted]]:
        """One place per marker. Where a marker stands twice in the image, the rest of its board decides, or none."""
        good, refused = [], []
        by_marker: dict[tuple[str, int], list[_Fitted]] = {}
        for f in fitted:
            by_marker.setdefault(f.candidate.key, []).append(f)
        single = {key: fs[0].corners for key, fs in by_marker.items() if len(fs) == 1}
        for key, fs in by_marker.items():
            if len(fs) == 1:
                good.append(fs[0])
                continue
            distinct = _distinct(fs)
            if len(distinct) == 1:
                good.append(distinct[0])
                continue
            expected = predict_missing(self._boards, single).get(key)
            size = np.linalg.norm(distinct[0].corners[2] - distinct[0].corners[0])
            off = [np.inf if expected is None else float(np.abs(f.corners - expected).max()) for f in distinct]
            fits = [f for f, o in zip(distinct, off, strict=True) if o < IN_PLACE * size]
            good += fits
            side = self._boards[key].side_m
            for f in distinct:
                if not any(f is g for g in fits):
                    from_others = [g for g in fits or distinct if g is not f]
                    apart = min(apart_on_page(g.corners, f.corners, side) for g in from_others)
                    refused.append(_refused(f, f"{DOUBLED}, m from the other place", apart, IN_PLACE * side))
        return good, refused

    def _sightings(self, stamp_ns: int, good: list[_Fitted]) -> list[MarkerSighting]:
        if not good:
            return []
        corners = np.stack([f.corners for f in good])
        covariance = np.stack([f.covariance for f in good]) + CORNER_FLOOR_PX**2 * np.eye(8)
        raw, scale = distort(self._camera, corners), independent_scale(covariance, corners)
        blocks = np.stack([covariance[:, k : k + 2, k : k + 2] for k in range(0, 8, 2)], 1)
        common = np.sqrt([f.structure for f in good] * np.einsum("mkii->m", blocks) / 8)
        return [
            MarkerSighting(
                stamp_ns,
                self._name,
                self._boards[f.candidate.key].id,
                f.candidate.marker,
                f.corners,
                blocks[k],
                raw[k],
                float(common[k]),
                float(scale[k]),
            )
            for k, f in enumerate(good)
        ]

    def _rejection(self, stamp_ns: int, fitted: _Fitted) -> Rejection:
        assert fitted.problem is not None
        reason, value, limit = fitted.problem
        board = self._boards[fitted.candidate.key].id
        return Rejection(
            stamp_ns, "markers", f"{self._name} {board} marker {fitted.candidate.marker}", reason, value, limit
        )

    def _unknown(self, stamp_ns: int, unknown: list[Candidate]) -> Rejection:
        ids = ", ".join(f"{d.removeprefix('DICT_')}:{i}" for d, i in sorted({c.key for c in unknown}))
        return Rejection(
            stamp_ns, "markers", f"{self._name} ids {ids}", "ids that the rig does not know, number", len(unknown), 0
        )


def _is_pinhole(camera: CameraModel) -> bool:
    fisheye = camera.distortion_model in ("equidistant", "fisheye")
    return not fisheye and (camera.distortion_model in ("none", "") or not np.any(camera.D))


def _judged(candidate: Candidate, start: Float, fit: PatternFit, k: int, cells: int, min_correlation: float) -> _Fitted:
    corners, covariance = fit.corners[k], fit.covariance[k]
    cell = np.sqrt(max(cv2.contourArea(start.astype(np.float32)), 1.0)) / cells
    sigma = float(np.sqrt(max(np.diag(covariance).max(), 0.0))) / cell
    moved = float(np.abs(corners - start).max()) / cell
    problem: tuple[str, float, float] | None = None
    if not np.isfinite(corners).all() or not np.isfinite(covariance).all() or sigma > _MAX_SIGMA_CELLS:
        problem = ("corner sigma in cells", sigma, _MAX_SIGMA_CELLS)
    elif fit.contrast[k] < _MIN_CONTRAST:
        problem = ("contrast in grey values", float(fit.contrast[k]), _MIN_CONTRAST)
    elif fit.correlation[k] < min_correlation:
        problem = ("correlation with the pattern", float(fit.correlation[k]), min_correlation)
    elif fit.share[k] < _MIN_SHARE:
        problem = ("share of the edges that fit", float(fit.share[k]), _MIN_SHARE)
    elif fit.last_step_px[k] > _SETTLED_PX:
        problem = ("the fit did not settle, last step in px", float(fit.last_step_px[k]), _SETTLED_PX)
    elif moved > 1.5:
        problem = ("the fit left the marker, move in cells", moved, 1.5)
    correlation, contrast, structure = (float(x[k]) for x in (fit.correlation, fit.contrast, fit.structure))
    return _Fitted(candidate, corners, covariance, correlation, contrast, structure, fit.warm.of(k), problem)


def _refused(fitted: _Fitted, reason: str, value: float, limit: float) -> _Fitted:
    return replace(fitted, problem=(reason, float(value), float(limit)))


def _distinct(fitted: list[_Fitted]) -> list[_Fitted]:
    """Fits at different places; of those that ended at the same one, the best."""
    result: list[_Fitted] = []
    for f in sorted(fitted, key=lambda f: -f.correlation):
        if all(np.abs(f.corners.mean(0) - g.corners.mean(0)).max() > 2.0 for g in result):
            result.append(f)
    return result
