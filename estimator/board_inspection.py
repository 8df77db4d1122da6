"""Does each image show the board that the rig describes? Exchanged, doubled, foreign and loose markers."""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from ..factors.board import page_corners
from ..factors.camera import CameraModel
from ..factors.chance import chi2_isf
from ..factors.errors import ObservabilityError
from ..factors.measurements import Event, MarkerSighting, Rejection
from ..factors.rig import Board, Rig
from ..frontends.board_check import Suspicion, suspicious_markers
from ..frontends.board_fit import board_corners, fit_board
from ..frontends.board_gross import without_gross_corners
from ..frontends.board_pose import apparent_side, board_pose_candidates
from ..frontends.fiducials.board_layout import DOUBLED, IN_PLACE, apart_on_page
from .board_start import relabelled
from .graph import State
from .sheet import Sheet

Float = NDArray[np.float64]

FAMILY = "marker corners"
FALSE_ALARM = 1e-5
"""Probability that a good image of a board is looked at twice."""
VIEWS_TO_EXCHANGE = 2
"""Images of different moments that have to agree that two ids are exchanged: a whole-board fit decides each."""
VIEWS_TO_RELEASE = 3
"""Images of different moments in a row that have to agree that a marker is off its place."""
SAME_SHIFT_SIGMA, SAME_SHIFT_SHARE = 4.0, 0.3
"""Two views show a marker in one place when their shifts agree within that: noise, and views share errors of lens and
print, which grow with the shift."""
SAME_PX = 1.0
"""Two sightings of an id that are nearer to each other than this are one."""
MEMORY = 25
"""Fits of accepted images by which a new one is judged: lens and print are never as perfect as the corners."""


@dataclass(slots=True)
class _Votes:
    """Successive moments at which one thing was wrong with a marker."""

    stamps: list[int] = field(default_factory=list)
    shifts_m: list[tuple[float, float]] = field(default_factory=list)
    sigmas_m: list[float] = field(default_factory=list)

    def add(self, stamp_ns: int, found: Suspicion) -> None:
        """One more moment; begins anew where it contradicts those before: what is loose lies in one place."""
        if stamp_ns not in self.stamps:
            if self.stamps and self._contradicts(found):
                self.stamps, self.shifts_m, self.sigmas_m = [], [], []
            self.stamps.append(stamp_ns)
            self.shifts_m.append(found.shift_m)
            self.sigmas_m.append(found.shift_sigma_m)

    def _contradicts(self, found: Suspicion) -> bool:
        weights = 1.0 / np.square(self.sigmas_m)
        mean = np.average(np.array(self.shifts_m), axis=0, weights=weights)
        off = float(np.linalg.norm(mean - found.shift_m))
        sigma = float(np.hypot(found.shift_sigma_m, min(self.sigmas_m)))
        return off > max(SAME_SHIFT_SIGMA * sigma, SAME_SHIFT_SHARE * float(np.linalg.norm(mean)))

    def length(self) -> tuple[float, float]:
        """Shift and its sigma, m: the views share most of their errors, so that they are no better than the best."""
        weights = 1.0 / np.square(self.sigmas_m)
        mean = np.average(np.array(self.shifts_m), axis=0, weights=weights)
        return float(np.linalg.norm(mean)), min(self.sigmas_m)


class Inspection:
    """Looks at every image of every board before anything enters the graph."""

    def __init__(self, rig: Rig, state: State, pinhole: Callable[[str], CameraModel]) -> None:
        self._rig = rig
        self._state = state
        self._pinhole = pinhole
        self._votes: dict[tuple[str, str, int], _Votes] = {}
        self._fits: dict[tuple[str, str], list[float]] = {}
        self._doubles: dict[tuple[str, int], list[tuple[int, float]]] = {}
        """Stamp, and how far apart the two places of an id were, m."""
        self.events: dict[tuple[str, str, int], Event] = {}
        """By kind, board and marker."""
        self.rejected: list[Rejection] = []

    def trusted(self, sheet: Sheet, seen: Sequence[MarkerSighting]) -> list[MarkerSighting]:
        """The sightings of one moment that may be used, under the ids whose places they have."""
        good: list[MarkerSighting] = []
        for camera in sorted({s.camera for s in seen}):
            mine = [relabelled(s, sheet.place(s.marker)) for s in seen if s.camera == camera]
            mine = self._without(mine, [s.marker in sheet.loose for s in mine], sheet, "is not on its place, markers")
            mine = self._once_each(sheet, mine)
            good += self._consistent(sheet, mine)
        return good

    @staticmethod
    def in_place(sheet: Sheet, seen: Sequence[MarkerSighting]) -> list[MarkerSighting]:
        """Sightings under the ids whose places they have, without markers that are known to be loose."""
        placed = [relabelled(s, sheet.place(s.marker)) for s in seen]
        return [s for s in placed if s.marker not in sheet.loose]

    # Twice in one image ---------------------------------------------------------------------------------------

    def _once_each(self, sheet: Sheet, seen: list[MarkerSighting]) -> list[MarkerSighting]:
        """Of an id that stands in an image twice the one that fits the rest of the board, or none."""
        seen = _distinct(seen)
        counts = Counter(s.marker for s in seen)
        double = sorted(m for m, n in counts.items() if n > 1)
        if not double:
            return seen
        rest = [s for s in seen if counts[s.marker] == 1]
        expected = self._expected(sheet, rest, double)
        keep = []
        for k, s in enumerate(seen):
            size = float(np.linalg.norm(s.corners_px[2] - s.corners_px[0]))
            place = expected.get(s.marker)
            if counts[s.marker] == 1 or (place is not None and np.abs(s.corners_px - place).max() < IN_PLACE * size):
                keep.append(k)
        refuse = [k not in keep for k in range(len(seen))]
        for s in [s for s, out in zip(seen, refuse, strict=True) if out]:
            # from where it belongs; from the other one, where neither fits
            others = [t.corners_px for t in seen if t.marker == s.marker and t is not s]
            place = expected.get(s.marker, others[0])
            self.doubled(sheet.board, s.marker, s.stamp_ns, apart_on_page(place, s.corners_px, self._side(sheet)))
        return self._without(seen, refuse, sheet, f"{DOUBLED}, places")

    def _expected(self, sheet: Sheet, rest: list[MarkerSighting], markers: list[int]) -> dict[int, Float]:
        """Where markers ought to be in an image, by the rest of their board; nothing where that is in doubt."""
        if not rest:
            return {}
        camera = self._pinhole(rest[0].camera)
        side = self._side(sheet)
        found = board_pose_candidates(rest, sheet.board, camera, side, self._rig.noise.marker_common_px)
        if len(found) != 1:
            return {}
        pose, places = found[0].camera_T_f, {}
        for marker in markers:
            c_p = page_corners(sheet.marker(marker), side) @ pose[:3, :3].T + pose[:3, 3]
            image = c_p @ camera.K.T
            places[marker] = image[:, :2] / image[:, 2:]
        return places

    def doubled_in_images(self, refused: Sequence[Rejection]) -> None:
        """Ids that a front end has refused already, because they stood twice in an image."""
        boards = {board.id: board for board in self._rig.boards}
        for r in refused:
            words = r.what.split()
            if r.reason.startswith(DOUBLED) and "marker" in words:
                at = words.index("marker")
                self.doubled(boards[words[at - 1]], int(words[at + 1]), r.stamp_ns, r.value)

    def doubled(self, board: Board, marker: int, stamp_ns: int, apart_m: float) -> None:
        """Says that an id is there twice, and how far apart: the median over all images so far.

        The second one may lie anywhere in space, so its distance in the page's plane changes from view to view: sigma
        is the spread of the views, and no less than what tells a marker in its place from one beside it.
        """
        seen = self._doubles.setdefault((board.id, marker), [])
        if np.isfinite(apart_m):
            seen.append((stamp_ns, apart_m))
        if not seen:
            return
        distances = np.array([apart for _, apart in seen])
        shift = float(np.median(distances))
        sigma = max(1.4826 * float(np.median(np.abs(distances - shift))), np.sqrt(2.0) * board.centre_sigma_m)
        if len(seen) < 3:
            sigma = max(sigma, IN_PLACE * board.side_m)
        text = (
            f"marker {marker} of board {board.id} is there twice, {1e3 * shift:.0f} +/- {1e3 * sigma:.1f} mm apart as "
            "seen on the page; what does not fit the rest of the board is left out"
        )
        values = {"marker": float(marker), "shift_m": shift, "sigma_m": float(sigma), "views": float(len(seen))}
        first = min(stamp for stamp, _ in seen)
        self.events["marker_duplicated", board.id, marker] = Event(first, "marker_duplicated", text, "warning", values)

    # Off their places -----------------------------------------------------------------------------------------

    def _consistent(self, sheet: Sheet, seen: list[MarkerSighting]) -> list[MarkerSighting]:
        """Leaves out what contradicts the rest of the board in the same image."""
        if len(seen) < 2:
            return seen
        key = (sheet.board.id, seen[0].camera)
        if self._holds_together(sheet, key, seen):
            return seen
        seen = self._without_gross(sheet, seen)
        if len(seen) < 2 or self._holds_together(sheet, key, seen):
            return seen
        judged = _judged_by_rig(seen)
        fit, past = self._fit(sheet, judged), self._fits.setdefault(key, [])
        board, common = sheet.board, self._rig.noise.marker_common_px
        side = self._side(sheet) if sheet.page_known else self._side_without_one(sheet, judged)
        found = suspicious_markers(judged, board, self._pinhole(seen[0].camera), side, common)
        if not found:
            if fit is not None:
                self._fits[key] = [*past, fit[0] / fit[1]][-MEMORY:]
            return seen
        return self._judged(sheet, seen, found)

    def _holds_together(self, sheet: Sheet, key: tuple[str, str], seen: list[MarkerSighting]) -> bool:
        """Do all corners of an image fit as well as those of other images do?"""
        fit = self._fit(sheet, _judged_by_rig(seen))
        past = self._fits.setdefault(key, [])
        scale = max(1.0, float(np.median(past))) if len(past) > 4 else 1.0
        if fit is None or fit[0] >= chi2_isf(FALSE_ALARM, fit[1]) * scale:
            return False
        self._fits[key] = [*past, fit[0] / fit[1]][-MEMORY:]
        self._clear(sheet, seen)
        return True

    def _without_gross(self, sheet: Sheet, seen: list[MarkerSighting]) -> list[MarkerSighting]:
        """Leaves out single corners, and markers of which nothing is left."""
        camera, common = self._pinhole(seen[0].camera), self._rig.noise.marker_common_px
        side = self._side(sheet)
        judged = _judged_by_rig(seen)
        kept, gross = without_gross_corners(judged, sheet.board, camera, side, common, side_free=not sheet.page_known)
        for one in gross:
            part = "" if one.corner is None else f" corner {one.corner}"
            what = f"marker {one.sighting.marker}{part} of board {sheet.board.id} in {one.sighting.camera}"
            reason = "gross against the rest of the image, whitened residual"
            self.rejected.append(Rejection(one.sighting.stamp_ns, FAMILY, what, reason, one.norm, one.limit))
        named = {s.marker: s.gross for s in kept}
        return [replace(s, gross=named[s.marker]) for s in seen if s.marker in named]

    def _fit(self, sheet: Sheet, seen: list[MarkerSighting]) -> tuple[float, int] | None:
        """Chi-square and degrees of freedom of one image, its side length free."""
        board, common, camera = sheet.board, self._rig.noise.marker_common_px, self._pinhole(seen[0].camera)
        try:
            side = self._side(sheet) if sheet.page_known else apparent_side(seen, board, camera, common)[0]
        except ObservabilityError:
            return None
        starts = board_pose_candidates(seen, board, camera, side, common)
        if not starts:
            return None
        corners = board_corners(seen, board, common)
        fit = fit_board(corners, camera, starts[0].camera_T_f, side, side_free=True)
        return (fit.chi2, fit.dof) if np.isfinite(fit.chi2) else None

    def _side_without_one(self, sheet: Sheet, seen: list[MarkerSighting]) -> float:
        """Side length of a page that holds together once one marker is left out; the rig's where none does."""
        for k in range(len(seen)):
            rest = seen[:k] + seen[k + 1 :]
            fit = self._fit(sheet, rest) if len({s.marker for s in rest}) > 1 else None
            if fit is not None and fit[0] < chi2_isf(FALSE_ALARM, fit[1]):
                camera, common = self._pinhole(rest[0].camera), self._rig.noise.marker_common_px
                return apparent_side(rest, sheet.board, camera, common)[0]
        return sheet.board.side_m

    def _side(self, sheet: Sheet) -> float:
        """Side length over print scale, as the rig or the estimate has it: an image does not know the scale."""
        if not sheet.page_known:
            return sheet.board.side_m
        side, scale = self._state.vector(sheet.page)
        return float(side / scale)

    def _judged(self, sheet: Sheet, seen: list[MarkerSighting], found: list[Suspicion]) -> list[MarkerSighting]:
        stamp_ns, board = seen[0].stamp_ns, sheet.board.id
        swapped = [s for s in found if s.kind == "swapped"]
        if swapped:
            a, b = sorted(s.marker for s in swapped)
            votes = self._votes.setdefault(("swapped", board, a * 10000 + b), _Votes())
            votes.add(stamp_ns, swapped[0])
            if len(votes.stamps) < VIEWS_TO_EXCHANGE:
                return self._without(seen, [True] * len(seen), sheet, "of two exchanged ids, views so far")
            self._exchange(sheet, a, b, votes)
            return [relabelled(s, {a: b, b: a}.get(s.marker, s.marker)) for s in seen]
        off = {s.marker for s in found}
        self._clear(sheet, [s for s in seen if s.marker not in off])
        for suspicion in found:
            if suspicion.explained:
                self._vote(sheet, stamp_ns, suspicion)
        refused = [s.marker in off for s in seen]
        return self._without(seen, refused, sheet, "off its place against the rest of the image, markers")

    def _exchange(self, sheet: Sheet, a: int, b: int, votes: _Votes) -> None:
        sheet.exchanged[a], sheet.exchanged[b] = sheet.place(b), sheet.place(a)
        length, sigma = votes.length()
        text = (
            f"board {sheet.board.id}: markers {a} and {b} stand in each other's place, {1e3 * length:.1f} +/- "
            f"{1e3 * sigma:.1f} mm from where the rig has them; used the log's"
        )
        values = {"other": float(b), "shift_m": length, "sigma_m": sigma}
        self._say("markers_swapped", sheet.board.id, a, votes.stamps[0], text, "warning", **values)

    def _vote(self, sheet: Sheet, stamp_ns: int, found: Suspicion) -> None:
        """A marker that is off its place at one moment after another is left out for good."""
        board, marker = sheet.board, found.marker
        votes = self._votes.setdefault(("moved", board.id, marker), _Votes())
        votes.add(stamp_ns, found)
        if len(votes.stamps) < VIEWS_TO_RELEASE:
            return
        length, sigma = votes.length()
        page_m = max(
            float(np.linalg.norm(np.subtract(m.centre_m, n.centre_m))) for m in board.markers for n in board.markers
        )
        if length > page_m + board.side_m:
            self.doubled(board, marker, votes.stamps[0], length)
            return
        since = "it came loose" if marker in sheet.slots else "from the start"
        what = f"marker {marker} is {1e3 * length:.1f} +/- {1e3 * sigma:.1f} mm off its place, {since}"
        if found.kind == "inconsistent":
            off = f"{1e3 * length:.1f} +/- {1e3 * sigma:.1f} mm"
            what = f"marker {marker} and the other one contradict each other by {off}"
        sheet.loose.add(marker)
        values = {"shift_m": length, "sigma_m": sigma}
        text = f"board {board.id}: {what}; left out"
        self._say("marker_loose", board.id, marker, votes.stamps[0], text, "warning", **values)

    def _clear(self, sheet: Sheet, seen: list[MarkerSighting]) -> None:
        """Markers that are in their places again were the detector's fault."""
        for s in seen:
            self._votes.pop(("moved", sheet.board.id, s.marker), None)

    # Book-keeping ---------------------------------------------------------------------------------------------

    def _without(
        self, seen: list[MarkerSighting], refused: list[bool], sheet: Sheet, reason: str
    ) -> list[MarkerSighting]:
        for s, refuse in zip(seen, refused, strict=True):
            if refuse:
                what = f"marker {s.marker} of board {sheet.board.id} in {s.camera}"
                self.rejected.append(Rejection(s.stamp_ns, FAMILY, what, reason, float(sum(refused)), 0.0))
        return [s for s, refuse in zip(seen, refused, strict=True) if not refuse]

    def _say(
        self, kind: str, board: str, marker: int, stamp_ns: int, text: str, severity: str, **values: float
    ) -> None:
        named = {"marker": float(marker), **values}
        event = Event(stamp_ns, kind, text, severity, named)  # type: ignore[arg-type]
        self.events.setdefault((kind, board, marker), event)


def _judged_by_rig(seen: list[MarkerSighting]) -> list[MarkerSighting]:
    """The page's tolerance is no contradiction: with what the rig allows on top of the corners' own noise."""
    return [replace(s, common_px=None) for s in seen]


def _distinct(seen: list[MarkerSighting]) -> list[MarkerSighting]:
    """One of several sightings at one place: an image that was recorded twice."""
    kept: list[MarkerSighting] = []
    for s in seen:
        same = (k for k in kept if k.marker == s.marker)
        if all(float(np.abs(k.corners_px - s.corners_px).max()) > SAME_PX for k in same):
            kept.append(s)
    return kept
