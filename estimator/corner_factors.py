"""Corners of boards in the graph: their variables, where their page puts them, and what each image says of them."""

import gtsam
import numpy as np
from numpy.typing import NDArray

from ..factors import keys
from ..factors.board import page_corners, page_factor
from ..factors.measurements import MarkerSighting
from ..factors.noise import gaussian, robust
from ..factors.projection import machine_projection, mobile_projection
from ..factors.rig import Rig
from ..frontends.board_fit import corner_covariance, independent_common_px
from .board_inspection import FAMILY
from .board_news import GEOMETRY, BoardNews
from .board_start import inset_sigma_px
from .graph import Record, State, Update
from .sheet import PageFactor, Sheet
from .view_cells import ViewCells, added_covariance

Float = NDArray[np.float64]

LASTING = 0.5
"""Share of the common part of a corner's error that stays on the page in all views, whatever their place; the rest is
another one at each place. Nothing tells: print and paper last, what the sampling by pixels does to an edge does not."""
LASTING_PX = 0.014
"""Least sigma of what stays on the page, where half of a corner's variance holds so much: 0.009 to 0.034 px over eight
rendered recordings, by the mean over a corner's views against the truth (docs/corners.md)."""
MOST_LASTING = 0.5
"""Of a corner's variance: views differ by the rest at least."""
STILL_VIEWS = 40
"""Views of a board from one place after which further ones are left out: they would count one part in so many."""


class CornerFactors:
    """Makes the factors of sightings that are trusted."""

    def __init__(self, rig: Rig, state: State, news: BoardNews) -> None:
        self._rig = rig
        self._state = state
        self._news = news
        self._next_slot = 0
        self._cells: dict[tuple[str, str], ViewCells] = {}
        self._shared: dict[tuple[str, bool], tuple[float, int]] = {}
        """By board, and whether the machine's camera saw it: squares of what its sightings say of their common part,
        summed, and how many these were."""
        self.inset_sigma_px: dict[tuple[str, str], float] = {}
        """By camera and board: how far its corners may all lie inside (or outside) of the true ones."""

    def add(self, sheet: Sheet, keyframe: int, sighting: MarkerSighting, update: Update) -> bool:
        """The corners of a marker in one image; False where its place has been seen from often enough."""
        least = self._least_common_px(sighting)
        covariance = self._with_common_part(sheet, keyframe, sighting, least, update)
        if covariance is None:
            return False
        self._note_source(sighting)
        slot = self._slot(sheet, sighting, least, update)
        source = f"corners {sighting.camera} {sheet.board.id}"
        for i in map(int, sighting.good):
            model = robust(gaussian(covariance[i]), self._rig.gates.robust_sigma)
            point = keys.corner(slot, i)
            if sighting.camera == "b_rgb":
                factor = machine_projection(sighting.corners_px[i], model, keyframe, point)
            else:
                factor = mobile_projection(sighting.camera, sighting.corners_px[i], model, keyframe, point)
            what = f"marker {sighting.marker} corner {i} in {sighting.camera}"
            update.add(factor, Record(FAMILY, source, sighting.stamp_ns, what, camera=sighting.camera))
        return True

    def _note_source(self, sighting: MarkerSighting) -> None:
        """How far the detector of these corners may be biased."""
        key = (sighting.camera, sighting.board)
        sigma = inset_sigma_px(sighting, self._rig.noise)
        self.inset_sigma_px[key] = max(sigma, self.inset_sigma_px.get(key, 0.0))

    def _least_common_px(self, sighting: MarkerSighting) -> float:
        """One image of a few markers tells the common part to half of itself: at least what all of them say counts."""
        key = sighting.board, sighting.camera == "b_rgb"
        total, count = self._shared.get(key, (0.0, 0))
        total, count = total + independent_common_px(sighting) ** 2, count + 1
        self._shared[key] = total, count
        return max(self._rig.noise.marker_common_px, float(np.sqrt(total / count)))

    def _slot(self, sheet: Sheet, sighting: MarkerSighting, least_px: float, update: Update) -> int:
        """The marker's corner variables, made on its first sighting."""
        if sighting.marker in sheet.slots:
            return sheet.slots[sighting.marker]
        slot = sheet.slots[sighting.marker] = self._next_slot
        self._next_slot += 1
        marker = sheet.marker(sighting.marker)
        o_T_f = self._pose_of(sheet.key, update)
        page = sheet.page
        side, scale = update.values.atVector(page) if update.values.exists(page) else self._state.vector(page)
        for i, corner in enumerate(page_corners(marker, side, scale)):
            update.guess(keys.corner(slot, i), o_T_f.transformFrom(corner))
        after = f" after knock {sheet.epoch}" if sheet.epoch else ""
        what = f"marker {sighting.marker} lies on page {sheet.board.id}{after}"
        detection_m = _lasting_px(sighting, least_px) * side * float(np.sqrt(2.0)) / max(sighting.diagonal_px, 1.0)
        factor = page_factor(sheet.board, marker, sheet.key, page, slot, detection_m)
        update.add(factor, Record(GEOMETRY, f"page {sheet.board.id}", sighting.stamp_ns, what, rejectable=False))
        sheet.pages[what] = PageFactor(sighting.marker, slot, sheet.epoch, detection_m)
        return slot

    def _pose_of(self, key: int, update: Update) -> gtsam.Pose3:
        return update.values.atPose3(key) if update.values.exists(key) else self._state.pose(key)

    def _with_common_part(
        self, sheet: Sheet, keyframe: int, sighting: MarkerSighting, least_px: float, update: Update
    ) -> Float | None:
        """Adds the part of a corner's error that views from the same place share; None where they are plenty.

        Views are counted per cell of viewing position; the n-th one of a cell gets what it adds to those before it.
        """
        cells = self._cells.setdefault((sheet.board.id, sighting.camera), ViewCells())
        if cells.last != keyframe:
            view = self._pose_of(sheet.key, update).between(self._pose_of(keyframe, update))
            cells.count(keyframe, view.matrix())
        if cells.views > STILL_VIEWS and sighting.marker in sheet.slots:
            self._news.refuse(sheet, [sighting], "one more view from the same place, views", cells.views, STILL_VIEWS)
            return None
        total = corner_covariance(sighting, least_px)
        lasting = _lasting_px(sighting, least_px)
        on_page = lasting**2 / _mean_variance(total)
        fleeting = float(np.sqrt(1.0 - LASTING)) * max(least_px, independent_common_px(sighting))
        return added_covariance((1.0 - on_page) * total, fleeting, cells.views)


def _lasting_px(sighting: MarkerSighting, least_px: float) -> float:
    """Sigma of what stays on the page of a corner's error."""
    common = max(least_px, independent_common_px(sighting))
    most = MOST_LASTING * _mean_variance(corner_covariance(sighting, least_px))
    return float(np.sqrt(min(max(LASTING * common**2, LASTING_PX**2), most)))


def _mean_variance(covariance: Float) -> float:
    """Of a coordinate, from (k, 2, 2)."""
    return float(np.einsum("kii->k", covariance).mean() / 2)
