"""From what the processes say to what the world gets: poses at frame rate, points, verdicts, their age."""

import numpy as np
from numpy.typing import NDArray

from ...factors.geometry import pose3, ros_covariance
from ...io.live.interfaces import Health, LivePoint, LivePose, LiveUpdate
from .follower import Followed
from .settings import S, StreamSettings
from .trust import RANK, grown, verdict_of
from .wire import Answer, Place

Float = NDArray[np.float64]

NOTHING = "MEASURE MORE: nothing is known yet"


def update_of(
    answer: Answer | None,
    followed: Followed | None,
    stamp_ns: int,
    sent_ns: int,
    health: Health,
    counters: dict[str, int],
    settings: StreamSettings,
) -> LiveUpdate:
    """One state of the estimate."""
    poses = {} if answer is None else {n: _pose(p) for n, p in answer.places.items() if n != "m"}
    if followed is not None:
        poses["m"] = _pose(Place(followed.matrix, followed.covariance))
    points, verdict = _points(answer, stamp_ns, health, settings)
    age_s = max((point.age_s for point in points), default=0.0)
    joint = None
    if answer is not None and answer.joint_m2 is not None:
        positions = np.array([point.xyz_m for point in points])
        joint = grown(answer.joint_m2, positions, min(age_s, 1e6), settings)
    until_ns = 0 if answer is None else answer.stamp_ns
    return LiveUpdate(
        stamp_ns, sent_ns, poses, points, verdict, age_s, health, counters,
        points_stamp_ns=until_ns, points_covariance_m2=joint,
    )  # fmt: skip


def _pose(place: Place) -> LivePose:
    covariance = None if place.covariance is None else ros_covariance(pose3(place.matrix), place.covariance)
    return LivePose(place.matrix, covariance)


def _points(
    answer: Answer | None, stamp_ns: int, health: Health, settings: StreamSettings
) -> tuple[tuple[LivePoint, ...], str]:
    """Points with the covariance of this moment, and the worst verdict in one line."""
    if answer is None:
        return (), NOTHING
    decisions = {decision.cut.point: decision for decision in answer.decisions}
    radii = {pipe.id: pipe.radius_m for pipe in answer.pipes}
    age_s = float("inf") if answer.last_tie_ns is None else max(stamp_ns - answer.last_tie_ns, 0) / S
    broken = next((fault for fault in health.faults if fault.severity == "error"), None)
    found, lines = [], []
    for point in answer.points:
        verdict, line = verdict_of(decisions.get(point.id), stamp_ns)
        if broken is not None and verdict == "GO":
            verdict, line = "MEASURE MORE", f"Do not cut {point.id} yet: {broken.text}"
        if point.id in decisions:
            lines.append((RANK[verdict], f"{verdict}: {line}"))
        covariance = grown(point.covariance_m2, point.position_m, min(age_s, 1e6), settings)
        radius = radii.get(point.pipe_id or "")
        found.append(LivePoint(point.id, point.role, point.position_m, covariance, verdict, age_s, point.axis, radius))
    missing = [cut for cut in decisions if cut not in {p.id for p in answer.points}]
    lines += [(RANK["MEASURE MORE"], f"MEASURE MORE: {decisions[cut].headline}") for cut in missing]
    worst = max(lines, key=lambda line: line[0])[1] if lines else "MEASURE MORE: the rig's cut_plan is empty"
    return tuple(found), worst
