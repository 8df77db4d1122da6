"""Does a board still stand where it stood? Knocks, found while they happen."""

from collections.abc import Callable, Mapping, Sequence

import gtsam
import numpy as np
from numpy.typing import NDArray

from ..factors import keys
from ..factors.camera import CameraModel
from ..factors.chance import chi2_isf
from ..factors.geometry import pose3
from ..factors.measurements import MarkerSighting
from ..factors.rig import Rig
from ..frontends.board_pose import board_pose_candidates
from .graph import State
from .sheet import Displaced, Sheet

Float = NDArray[np.float64]
Joint = Callable[[Sequence[int]], Float]
"""Joint covariance of variables, in the order of their keys."""

DISAGREE = 1e-6
"""Probability that two views of one place are taken for views of two."""
VIEWS_TO_BELIEVE = 3
"""Keyframes in a row that have to agree on a new place."""


def displacement(
    sheet: Sheet,
    keyframe: int,
    camera_poses: Mapping[str, gtsam.Pose3],
    seen: list[MarkerSighting],
    state: State,
    rig: Rig,
    pinhole: Callable[[str], CameraModel],
    joint: Joint,
) -> Displaced | None:
    """A view that contradicts the board's place, by more than fit, camera and place are uncertain; else None.

    The running solver takes errors of tracks for independent, and is too sure of the camera where they are not: a new
    place is on trial until the end of the run.
    """
    stamp_ns = seen[0].stamp_ns
    camera = max(sorted(camera_poses), key=lambda c: len({s.marker for s in seen if s.camera == c}))
    mine = [s for s in seen if s.camera == camera]
    if len({s.marker for s in mine}) < min(2, len(sheet.board.markers)):
        return Displaced(keyframe, stamp_ns, seen, None, None)
    side, scale = state.vector(sheet.page)
    found = board_pose_candidates(mine, sheet.board, pinhole(camera), float(side / scale), rig.noise.marker_common_px)
    if not found:
        return Displaced(keyframe, stamp_ns, seen, None, None)
    expected = state.pose(sheet.key)
    spread = joint([keyframe, sheet.key])
    best: tuple[float, gtsam.Pose3, Float] | None = None
    for candidate in found:
        own = candidate.covariance.copy()
        own[3:] *= scale
        own[:, 3:] *= scale
        o_T_f = camera_poses[camera].compose(scaled_pose(candidate.camera_T_f, float(scale)))
        delta = gtsam.Pose3.Logmap(expected.between(o_T_f))
        to_camera = state.pose(keyframe).between(o_T_f)
        J = np.hstack([to_camera.inverse().AdjointMap(), -np.eye(6)])
        distance = float(delta @ np.linalg.solve(own + J @ spread @ J.T, delta))
        if best is None or distance < best[0]:
            best = distance, o_T_f, own + J[:, :6] @ spread[:6, :6] @ J[:, :6].T
    assert best is not None
    if best[0] < chi2_isf(rig.gates.gate_probability, 6):
        return None
    return Displaced(keyframe, stamp_ns, seen, best[1], best[2])


def scaled_pose(camera_T_f: Float, scale: float) -> gtsam.Pose3:
    """A pose that was found with the page as the rig has it, for the page as it is printed."""
    scaled = np.array(camera_T_f)
    scaled[:3, 3] *= scale
    return pose3(scaled)


def new_place(displaced: list[Displaced]) -> gtsam.Pose3 | None:
    """Where a board stands now, when the last views agree on it; None while they do not."""
    told = [(d.o_T_f, d.covariance) for d in displaced if d.o_T_f is not None and d.covariance is not None]
    if len(told) < VIEWS_TO_BELIEVE:
        return None
    last, own = told[-1]
    for other, covariance in told[-VIEWS_TO_BELIEVE:-1]:
        delta = gtsam.Pose3.Logmap(last.between(other))
        if delta @ np.linalg.solve(own + covariance, delta) > chi2_isf(DISAGREE, 6):
            return None
    return last


def still_moving(displaced: list[Displaced]) -> list[Displaced]:
    """The views that disagree with the last one on where the board is."""
    last = displaced[-1]
    if last.o_T_f is None or last.covariance is None:
        return []
    gone = []
    for view in displaced[:-1]:
        if view.o_T_f is None or view.covariance is None:
            continue
        delta = gtsam.Pose3.Logmap(last.o_T_f.between(view.o_T_f))
        if delta @ np.linalg.solve(last.covariance + view.covariance, delta) > chi2_isf(DISAGREE, 6):
            gone.append(view)
    return gone


def may_be_the_board(sheet: Sheet, keyframe: int) -> bool:
    """Is it the board that moved, when a camera on `keyframe` sees it displaced? The machine's camera may have."""
    return keys.kind(keyframe) == "x" or sheet.board.attached_to == "b"
