"""All measurements of a run that did not enter the graph, with reasons."""

from ..factors import keys
from ..factors.measurements import Rejection
from .engine import Engine
from .odometry import FAMILY as ODOMETRY
from .open_views import UNPLACED


def everything_rejected(engine: Engine) -> list[Rejection]:
    """What was refused, what is still held back, and what waited in vain."""
    return [
        *engine.rejected,
        *_given_up(engine),
        *engine.boards.rejected,
        *engine.boards.held_back(),
        *engine.pipes.rejected,
        *engine.pipes.held_back(),
        *engine.depth_pipes.refused.values(),
        *engine.surfaces.refused.values(),
        *_waited_in_vain(engine),
    ]


def lists_of_rejections(engine: Engine) -> list[list[Rejection]]:
    """Where refusals gather; whoever runs for hours shortens them."""
    return [engine.rejected, *engine.boards.lists_of_rejections(), engine.pipes.rejected]


def _given_up(engine: Engine) -> list[Rejection]:
    reason = "undetermined where its matches put it; views"
    return [Rejection(engine.end_ns, ODOMETRY, keys.words(key), reason, 0.0, 1.0) for key in engine.solver.dropped]


def _waited_in_vain(engine: Engine) -> list[Rejection]:
    waiting = []
    for bundle in engine.waiting:
        what = f"{len(bundle.sightings)} markers of a frame"
        waiting.append(Rejection(bundle.stamp_ns, "marker corners", what, "no known board; boards", 0.0, 1.0))
    for pick in engine.lost_picks():
        what = f"pick {pick.point_id} in {pick.camera}"
        lost = pick.camera != "b_rgb" and pick.stamp_ns in engine.keyframe_at
        reason = UNPLACED if lost else "no frame of its stamp, frames"
        waiting.append(Rejection(pick.stamp_ns, "picks", what, reason, 0.0, 1.0))
    return waiting
