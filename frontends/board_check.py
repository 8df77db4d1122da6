"""Does a board look as the rig file says? Markers that are off their place, exchanged, or there twice."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ..factors.camera import CameraModel
from ..factors.chance import chi2_isf
from ..factors.measurements import MarkerSighting
from ..factors.rig import Board, Noise
from .board_fit import BoardCorners, BoardFit, board_corners, fit_board
from .board_pose import board_pose_candidates

Float = NDArray[np.float64]

_FALSE_ALARM = 1e-5
"""Probability of naming a marker that is in its place, per marker and image."""
_SHIFT_DOF = 3
_MENDED = 0.02
"""Share of chi-square that an exchange of two ids may leave to be believed."""


@dataclass(frozen=True, slots=True)
class Suspicion:
    """A marker that does not stand where the rig says."""

    marker: int
    kind: Literal["moved", "swapped", "duplicate", "inconsistent"]
    """`moved`: off its place; `swapped`: the exchange of two ids explains the image; `duplicate`: the id was seen twice
    and this one does not fit; `inconsistent`: two markers contradict each other, and the image cannot tell which."""
    shift_m: tuple[float, float]
    """Where it is from where it should be, on the page."""
    shift_sigma_m: float
    """Of the shift's length, board tolerance included."""
    turn_rad: float
    turn_sigma_rad: float
    chi2: float
    """What letting this marker free takes off the sum of squares; three degrees of freedom."""
    limit: float
    other: int | None = None
    """The id that it was exchanged with."""
    explained: bool = True
    """False: shift and turn do not explain where its corners are, so that it is the corners that are wrong."""


def suspicious_markers(
    sightings: Sequence[MarkerSighting],
    board: Board,
    camera: CameraModel,
    side_m: float,
    common_px: float = Noise().marker_common_px,
) -> list[Suspicion]:
    """Markers of one board, in one image, that contradict the others.

    Each marker in turn may shift and turn on the page; the one whose freedom takes most off chi-square is named if that
    is more than chance and the board's tolerance do, and left out; then the rest is looked at again. With fewer than
    two markers nothing can be said.
    """
    rest = list(sightings)
    exchanged = _exchanged(rest, board, camera, side_m, common_px)
    if exchanged:
        return exchanged
    found: list[Suspicion] = []
    while len(rest) > 1:
        worst, index = _worst(rest, board, camera, side_m, common_px)
        if worst is None:
            break
        if sum(1 for s in rest if s.marker == worst.marker) > 1:
            worst = replace(worst, kind="duplicate")
        elif len(rest) == 2:
            found += [replace(worst, marker=s.marker, kind="inconsistent") for s in rest]
            break
        found.append(worst)
        rest = rest[:index] + rest[index + 1 :]
    # how well the rest fits is the measure for what stands out
    scale = 1.0
    if len(rest) > 1 and (fit := _fit(rest, board, camera, side_m, common_px)[0]) is not None and len(rest) > 2:
        scale = max(1.0, fit.chi2 / max(fit.dof, 1))
    return [s for s in found if s.chi2 > s.limit * scale]


def _worst(
    sightings: list[MarkerSighting], board: Board, camera: CameraModel, side_m: float, common_px: float
) -> tuple[Suspicion | None, int]:
    """The most suspicious marker and its place in the list; None when all are where they should be."""
    corners = board_corners(sightings, board, common_px)
    best: tuple[float, int, BoardFit] | None = None
    whole, _ = _fit(sightings, board, camera, side_m, common_px)
    if whole is None:
        return None, 0
    for k in range(len(sightings)):
        start, others = _fit([s for j, s in enumerate(sightings) if j != k], board, camera, side_m, common_px)
        starts = [whole.camera_T_f, *([] if start is None else [start.camera_T_f]), *others]
        freed = min((fit_board(corners, camera, pose, side_m, shifted=k) for pose in starts), key=lambda f: f.chi2)
        if np.isfinite(freed.chi2) and (best is None or freed.chi2 < best[0]):
            best = freed.chi2, k, freed
    if best is None:
        return None, 0
    _, k, fit = best
    suspicion = _suspicion(sightings[k].marker, fit, board, _explains(fit, corners, k))
    return (suspicion if suspicion.chi2 > suspicion.limit else None), k


def _fit(
    sightings: list[MarkerSighting], board: Board, camera: CameraModel, side_m: float, common_px: float
) -> tuple[BoardFit | None, list[Float]]:
    """The best fit, and the poses of all candidates."""
    starts = board_pose_candidates(sightings, board, camera, side_m, common_px)
    if not starts:
        # contradictions can leave no pose for all together: start from each marker's own
        singles = [board_pose_candidates([s], board, camera, side_m, common_px) for s in sightings]
        starts = [candidate for single in singles for candidate in single]
    poses = [candidate.camera_T_f for candidate in starts]
    corners = board_corners(sightings, board, common_px)
    fits = [fit_board(corners, camera, pose, side_m) for pose in poses]
    fits = [fit for fit in fits if np.isfinite(fit.chi2)]
    return (min(fits, key=lambda fit: fit.chi2) if fits else None), poses


def _explains(fit: BoardFit, corners: BoardCorners, k: int) -> bool:
    """Are the corners of the marker that was let free as near to the fit as the others are?"""
    white = np.linalg.solve(np.linalg.cholesky(corners.covariance_px2), fit.residual_px[..., None])[..., 0]
    squares, own = (white**2).sum(axis=1), corners.marker == k
    rest = 2 * int((~own).sum()) - 6
    scale = max(1.0, float(squares[~own].sum()) / rest) if rest > 0 else 1.0
    dof = 2 * int(own.sum()) - _SHIFT_DOF
    return dof > 0 and float(squares[own].sum()) < scale * chi2_isf(_FALSE_ALARM, dof)


def _suspicion(marker: int, fit: BoardFit, board: Board, explained: bool) -> Suspicion:
    """The shift against its covariance, to which the board's own tolerance is added."""
    tolerance = np.diag([board.centre_sigma_m**2] * 2 + [(board.centre_sigma_m / board.side_m) ** 2])
    covariance = fit.covariance[6:, 6:] + 2 * tolerance
    shift, turn = fit.extra[:2], float(fit.extra[2])
    length = float(np.linalg.norm(shift))
    along = shift / length if length > 0 else np.array([1.0, 0.0])
    return Suspicion(
        marker,
        "moved",
        (float(shift[0]), float(shift[1])),
        float(np.sqrt(along @ covariance[:2, :2] @ along)),
        turn,
        float(np.sqrt(covariance[2, 2])),
        float(fit.extra @ np.linalg.solve(covariance, fit.extra)),
        chi2_isf(_FALSE_ALARM, _SHIFT_DOF),
        explained=explained,
    )


def _exchanged(
    sightings: list[MarkerSighting], board: Board, camera: CameraModel, side_m: float, common_px: float
) -> list[Suspicion]:
    """The pair of ids whose exchange mends a board that does not fit, as two suspicions; else none."""
    ids = [s.marker for s in sightings]
    before = _fit(sightings, board, camera, side_m, common_px)[0]
    if before is None or len(ids) < 2 or len(set(ids)) < len(ids):
        return []
    if before.chi2 < chi2_isf(_FALSE_ALARM, before.dof):
        return []
    best: tuple[float, int, int] | None = None
    for a, b in combinations(range(len(ids)), 2):
        other = {a: ids[b], b: ids[a]}
        trial = [replace(s, marker=other.get(k, s.marker)) for k, s in enumerate(sightings)]
        after = _fit(trial, board, camera, side_m, common_px)[0]
        if after is not None and (best is None or after.chi2 < best[0]):
            best = after.chi2, a, b
    # an exchange moves markers by their whole distance: what it leaves is far below what was there
    if best is None or best[0] > _MENDED * before.chi2:
        return []
    places = {m.id: np.array(m.centre_m) for m in board.markers}
    pair = ids[best[1]], ids[best[2]]
    gain = before.chi2 - best[0]
    limit = chi2_isf(_FALSE_ALARM, before.dof)
    sigma = float(np.sqrt(2.0) * board.centre_sigma_m)
    result = []
    for marker, other_id in (pair, pair[::-1]):
        x, y = places[other_id] - places[marker]
        result.append(Suspicion(marker, "swapped", (float(x), float(y)), sigma, 0.0, 0.0, gain, limit, other_id))
    return result
