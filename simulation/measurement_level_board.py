"""What can be wrong with the page of a run: scale, exchanged ids, a loose marker, a knock, a biased detector."""

from dataclasses import replace

import numpy as np

from .measurement_level_scenario import BoardFaults
from .measurement_level_truth import Float, TrueBoard, matrix, transform


def misprinted(board: TrueBoard, faults: BoardFaults) -> TrueBoard:
    """The page as it came out of the printer: everything on it scaled."""
    k = faults.page_scale
    return replace(
        board,
        corners_m=k * board.corners_m,
        centres_m=k * board.centres_m,
        side_m=k * board.side_m,
        print_scale=k * board.print_scale,
    )


def knocked(o_T_f: Float, faults: BoardFaults, seconds: float) -> Float:
    """The board's pose, shape (4, 4), so many seconds after the start."""
    if faults.knock_at_s is None or seconds < faults.knock_at_s:
        return o_T_f
    return o_T_f @ matrix(np.array(faults.knock_turn_rad), np.array(faults.knock_shift_m))


def corners_on_page(board: TrueBoard, faults: BoardFaults, seconds: float) -> dict[int, Float]:
    """Corners by printed id, shape (4, 3) each, in {f}."""
    corners = dict(zip(board.markers, board.corners_m, strict=True))
    loose = faults.loose
    if loose is not None and seconds >= faults.loose_at_s:
        middle = corners[loose].mean(axis=0)
        turned = transform(matrix(np.array([0.0, 0.0, faults.loose_turn_rad]), np.zeros(3)), corners[loose] - middle)
        corners[loose] = middle + turned + [*faults.loose_shift_m, 0.0]
    if faults.swapped is not None:
        a, b = faults.swapped
        corners[a], corners[b] = corners[b], corners[a]
    return corners


def inwards(px: Float, inset_px: float) -> Float:
    """Corners of one marker, shape (4, 2), as a detector with an inset finds them."""
    rays = px - px.mean(axis=0)
    return px - inset_px * rays / np.linalg.norm(rays, axis=1, keepdims=True)
