"""The paper's chain on the measurements of a drawn run: the same corners, odometry and clicks as the estimate gets."""

from ..estimator.baseline import BoardView, ChainPoint, behind_surface, paper_chain
from ..estimator.compare import board_view, mount_board, pipe_radius_m
from ..factors.measurements import MarkerSighting, StereoFrame
from .measurement_level import Run


def chain_of_run(run: Run) -> tuple[ChainPoint, ...]:
    """Position in {b} for every click, by the paper's method.

    Raises:
        ObservabilityError: the board was never seen.
    """
    frames = [measurement for measurement in run.measurements if isinstance(measurement, StereoFrame)]
    clicks = [behind_surface(click, pipe_radius_m(run.rig, click.pick.point_id)) for click in run.stereo_clicks]
    return paper_chain(first_view(run), frames, clicks, run.rig)


def first_view(run: Run) -> BoardView | None:
    """The first image of the left camera that shows the mount's board."""
    board = mount_board(run.rig)
    seen = [
        measurement
        for measurement in run.measurements
        if isinstance(measurement, MarkerSighting) and measurement.camera == "m_left" and measurement.board == board.id
    ]
    if not seen:
        return None
    stamp_ns = min(sighting.stamp_ns for sighting in seen)
    first = [sighting for sighting in seen if sighting.stamp_ns == stamp_ns]
    return board_view(first, board, run.cameras["m_left"], stamp_ns)
