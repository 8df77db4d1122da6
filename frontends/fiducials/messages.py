"""Markers that were detected elsewhere: arrays of ids and corners to sightings."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ...factors.camera import CameraModel
from ...factors.measurements import CameraName, MarkerSighting, Rejection
from ...factors.rig import Board, Rig
from ..undistort import undistort
from .board_layout import DOUBLED, IN_PLACE, apart_on_page
from .dictionaries import canonical_name

Float = NDArray[np.float64]

UNKNOWN_IDS = "ids that the rig does not know"
_TO_OURS = {"opencv": [3, 2, 1, 0], "apriltag": [0, 1, 2, 3]}


def sightings_from_messages(
    rig: Rig,
    camera: CameraModel,
    camera_name: CameraName,
    stamp_ns: int,
    families: Sequence[str],
    ids: Sequence[int],
    corners_raw_px: Float,
) -> tuple[list[MarkerSighting], list[Rejection]]:
    """Sightings from corners that arrived as messages, with no image to judge them by.

    Args:
        rig: boards; `message_corner_order` of a board says how its corners are ordered (`apriltag`: ours; `opencv`:
            upper left, upper right, lower right, lower left of the upright printed marker), and
            `noise.marker_message_sigma_px` how well they are known.
        camera: of the image in which they were detected.
        families: family or dictionary name of each, `tag36h11` and `DICT_APRILTAG_36h11` alike; an empty name fits any
            board with that id.
        ids: of each.
        corners_raw_px: shape (n, 4, 2), pixels of the raw image.

    Returns:
        Sightings, and one rejection for each that cannot be used. Ids that the rig does not know share one.
    """
    corners = np.asarray(corners_raw_px, float).reshape(-1, 4, 2)
    noise = np.broadcast_to(rig.noise.marker_message_sigma_px**2 * np.eye(2), (*corners.shape[:2], 2, 2))
    ideal, covariance = undistort(camera, corners, noise)
    assert covariance is not None
    boards = _by_marker(rig)
    keys = [(canonical_name(family) if family else "", int(i)) for family, i in zip(families, ids, strict=True)]
    sightings, rejections, unknown = [], [], set()
    for k, key in enumerate(keys):
        board = _board(boards, *key)
        if board is None:
            unknown.add(key)
            continue
        what = f"{camera_name} {board.id} marker {key[1]}"
        lost = int((~np.isfinite(ideal[k]).all(-1) | ~np.isfinite(covariance[k]).all((1, 2))).sum())
        if lost:
            reason = "corners beyond the lens model, number"
            rejections.append(Rejection(stamp_ns, "markers", what, reason, float(lost), 0.0))
        elif keys.count(key) > 1:
            places = [ideal[j][_TO_OURS[board.message_corner_order]] for j, same in enumerate(keys) if same == key]
            mine = ideal[k][_TO_OURS[board.message_corner_order]]
            apart = max(apart_on_page(mine, other, board.side_m) for other in places)
            reason = f"{DOUBLED}, m from the other place"
            rejections.append(Rejection(stamp_ns, "markers", what, reason, apart, IN_PLACE * board.side_m))
        else:
            order = _TO_OURS[board.message_corner_order]
            found = ideal[k][order], covariance[k][order], corners[k][order]
            sightings.append(MarkerSighting(stamp_ns, camera_name, board.id, key[1], *found))
    if unknown:
        names = ", ".join(f"{family}:{i}" for family, i in sorted(unknown))
        reason = f"{UNKNOWN_IDS}, number"
        rejections.append(
            Rejection(stamp_ns, "markers", f"{camera_name} ids {names}", reason, float(len(unknown)), 0.0)
        )
    return sightings, rejections


def _by_marker(rig: Rig) -> dict[tuple[str, int], Board]:
    return {(canonical_name(board.dictionary), m.id): board for board in rig.boards for m in board.markers}


def _board(boards: dict[tuple[str, int], Board], family: str, marker: int) -> Board | None:
    if family:
        return boards.get((canonical_name(family), marker))
    fitting = [board for (_, i), board in boards.items() if i == marker]
    return fitting[0] if len(fitting) == 1 else None
