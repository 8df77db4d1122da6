"""Where the markers of a board are on its page, and in an image in which some of them were found."""

import cv2
import numpy as np
from numpy.typing import NDArray

from ...factors.rig import Board, Marker

Float = NDArray[np.float64]

DOUBLED = "stands in the image more than once"
"""Why a sighting is refused of whose id there is another one in the same image."""
IN_PLACE = 0.25
"""Share of its diagonal, or side, by which a sighting may be off the place of its marker and still be this one."""
_SQUARE = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])


def marker_on_page(marker: Marker, side_m: float) -> Float:
    """Corners of a marker in the page frame, shape (4, 2), order 0..3 = (-,-), (+,-), (+,+), (-,+)."""
    c, s = np.cos(marker.rotation_rad), np.sin(marker.rotation_rad)
    return side_m * _SQUARE @ np.array([[c, s], [-s, c]]) + np.array(marker.centre_m)


def apart_on_page(place: Float, other: Float, side_m: float) -> float:
    """How far two quadrilaterals of an image, (4, 2) each, lie apart in the plane of the first, m.

    The first is a marker with a side of `side_m`; what is not in its plane is taken where its ray meets it. NaN where
    it does not.
    """
    H, _ = cv2.findHomography(place, side_m * _SQUARE, 0)
    if H is None:
        return float("nan")
    q = np.append(other.mean(0), 1.0) @ H.T
    middle = np.append(place.mean(0), 1.0) @ H.T
    if q[2] * middle[2] <= 0:
        return float("nan")
    return float(np.linalg.norm(q[:2] / q[2] - middle[:2] / middle[2]))


def predict_missing(
    boards: dict[tuple[str, int], Board], seen: dict[tuple[str, int], Float]
) -> dict[tuple[str, int], Float]:
    """Corners (4, 2) in the image of the markers that were not seen, by each board's homography from those that were.

    `boards` gives the board of each (dictionary, id), `seen` the ideal pixels of the corners.
    """
    predicted: dict[tuple[str, int], Float] = {}
    for board in {board.id: board for board in boards.values()}.values():
        keys = {marker.id: key for key, other in boards.items() if other is board for marker in [_of(board, key[1])]}
        have = [m for m in board.markers if keys[m.id] in seen]
        if not have or len(have) == len(board.markers):
            continue
        page = np.concatenate([marker_on_page(m, board.side_m) for m in have])
        image = np.concatenate([seen[keys[m.id]] for m in have])
        H, _ = cv2.findHomography(page, image, 0)
        if H is None:
            continue
        for marker in board.markers:
            if keys[marker.id] not in seen:
                q = np.column_stack([marker_on_page(marker, board.side_m), np.ones(4)]) @ H.T
                if (q[:, 2] * H[2, 2] > 0).all():
                    predicted[keys[marker.id]] = q[:, :2] / q[:, 2:]
    return predicted


def _of(board: Board, marker: int) -> Marker:
    return next(m for m in board.markers if m.id == marker)
