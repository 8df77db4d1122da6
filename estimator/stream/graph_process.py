"""The graph's process: GTSAM holds the interpreter while it solves, so it has one of its own."""

import queue
import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ...factors.errors import SurecutError
from ...factors.measurements import Pick
from ..sensing import Sensed
from .glances import Glance
from .graph_loop import GraphLoop
from .memory import load
from .parent import GRAPH_NICE, end_with_parent, give_way, keep_loaded
from .wire import Died, Done, GraphTask, LateClick, Order, Ready

BUSY = 20
"""Stamps that wait from which on answers come by the computer's clock."""


def solve(task: GraphTask, inbox: Any, out: Any) -> None:
    """The process."""
    end_with_parent()
    keep_loaded()
    if not task.patient:
        give_way(GRAPH_NICE)
    try:
        try:
            loop = _started(task, out, task.prior)
        except SurecutError as error:
            out.put(Died("graph", str(error), refusal=True))
            return
        out.put(Ready("graph"))
        while True:
            try:
                item = inbox.get(timeout=0.5)
            except queue.Empty:
                loop.checkpoint_when_due()
                continue
            if isinstance(item, Sensed):
                loop.take(item, _waiting(inbox) > BUSY)
                _refuse(loop.unplaced(item), out)
            elif isinstance(item, Glance):
                loop.glance(item)
            elif isinstance(item, LateClick):
                _look_back(loop, item, out)
            elif isinstance(item, Order):
                if item.what == "finish":
                    _finish(loop, out)
                    return
                loop = _obeyed(loop, item, task, out)
            loop.checkpoint_when_due()
    except Exception:
        out.put(Died("graph", traceback.format_exc()))


def _started(task: GraphTask, out: Any, prior: Path | None) -> GraphLoop:
    memory = load(prior) if prior is not None and prior.exists() else None
    loop = GraphLoop(task.rig, task.settings, out.put, memory, task.checkpoint, task.validated, not task.patient)
    if memory is not None:
        loop.answer(memory.stamp_ns)
    return loop


def _waiting(inbox: Any) -> int:
    try:
        return inbox.qsize()
    except NotImplementedError:  # macOS cannot tell
        return 0


def _look_back(loop: GraphLoop, item: LateClick, out: Any) -> None:
    if not loop.look_back(item.sensed):
        _refuse(item.sensed.bundle.picks[:1], out)


def _refuse(picks: Sequence[Pick], out: Any) -> None:
    for pick in picks:
        text = f"pick {pick.point_id} at {pick.stamp_ns} ns: its frame cannot be placed any more; pick in a newer image"
        out.put(Done("pick", text, failed=True))


def _obeyed(loop: GraphLoop, order: Order, task: GraphTask, out: Any) -> GraphLoop:
    try:
        if order.what == "reset":
            loop.close()
            loop = _started(task, out, None)
            out.put(Done("reset", "map, poses and points are forgotten"))
        elif order.what == "save":
            out.put(Done("save", loop.save()))
        else:
            out.put(Done(order.what, loop.freeze(order.what == "freeze")))
    except SurecutError as error:
        out.put(Done(order.what, str(error), failed=True))
    return loop


def _finish(loop: GraphLoop, out: Any) -> None:
    """The last answer, with everything that waited."""
    loop.close()
    loop.pipeline.complete()
    loop.settle()
    loop.answer(loop.engine.end_ns)
    try:
        text = loop.save()
    except SurecutError as error:
        text = str(error)
    out.put(Done("finish", text))
