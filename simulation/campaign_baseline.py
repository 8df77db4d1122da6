"""The paper's chain on the measurements of a drawn run: the same corners, odometry and clicks as the estimate gets."""

from collections.abc import Sequence

import numpy as np

from ..estimator.baseline import (
    BoardView,
    ChainPoint,
    behind_surface,
    click_from_tracks,
    paper_chain,
)
from ..factors.measurements import MarkerSighting, Pick, StereoFrame
from ..factors.rig import Board, Rig
from ..frontends.paper_chain import marker_pose
from .measurement_level import Measurement, Run

NEAR_TRACKS = 3
"""A click rests on the disparity of this many tracks near it: the pipe is narrow."""


def chain_of_run(run: Run) -> tuple[ChainPoint, ...]:
    """Position in {b} for every click in the left camera, by the paper's method.

    Raises:
        ObservabilityError: the board was never seen.
    """
    frames = [measurement for measurement in run.measurements if isinstance(measurement, StereoFrame)]
    frame_at = {frame.stamp_ns: frame for frame in frames}
    right = run.cameras["m_right"]
    radius_m = 0.5 * (run.rig.pipes[0].nominal_diameter_m or 0.0) if run.rig.pipes else 0.0
    clicks = [
        behind_surface(
            click_from_tracks(
                pick, frame_at[pick.stamp_ns], run.cameras["m_left"].K, right.baseline_m or 0.0, NEAR_TRACKS
            ),
            radius_m,
        )
        for pick in run.measurements
        if isinstance(pick, Pick) and pick.camera == "m_left" and pick.stamp_ns in frame_at
    ]
    return paper_chain(first_view(run.measurements, run), frames, clicks, run.rig)


def first_view(measurements: Sequence[Measurement], run: Run) -> BoardView | None:
    """The first image of the left camera that shows the mount's board, every marker with its own pose."""
    board = _mount_board(run.rig)
    if board is None:
        return None
    seen = [
        sighting
        for sighting in measurements
        if isinstance(sighting, MarkerSighting) and sighting.camera == "m_left" and sighting.board == board.id
    ]
    if not seen:
        return None
    stamp_ns = min(sighting.stamp_ns for sighting in seen)
    poses = {
        sighting.marker: marker_pose(sighting, run.cameras["m_left"], board.side_m)
        for sighting in seen
        if sighting.stamp_ns == stamp_ns
    }
    solved = {marker: pose for marker, pose in poses.items() if pose is not None}
    return BoardView(stamp_ns, board.id, tuple(solved), np.array(list(solved.values()))) if solved else None


def _mount_board(rig: Rig) -> Board | None:
    if rig.mount is None:
        return None
    return next(board for board in rig.boards if rig.mount is not None and board.id == rig.mount.board)
