"""Where a keyframe without tracks stands: from corners of known boards in either mobile camera, or from landmarks."""

from collections.abc import Container, Sequence

import gtsam
import numpy as np
from numpy.typing import NDArray

from ..factors import keys
from ..factors.geometry import pose3
from ..factors.measurements import MarkerSighting, StereoFrame
from ..frontends.resection import camera_pose
from .boards import Boards
from .graph import State

Float = NDArray[np.float64]

PLACED_PX = 5.0
"""Largest median reprojection error of a placement."""
FREE_POINTS = 8
"""Corners from which a pose is found without help; one marker alone allows two."""
RECENT_NS = 300_000_000
"""A camera in the hand has not gone far since: of two poses the nearer one is right."""
FEWEST_LANDMARKS = 12
LANDMARKS_PX = 2.0
"""Largest median reprojection error of landmarks seen again."""
SAME_RAD, SAME_M = 0.05, 0.1
"""Poses nearer to each other than this are one."""


def place(
    boards: Boards, state: State, sightings: Sequence[MarkerSighting], near: tuple[gtsam.Pose3, int]
) -> gtsam.Pose3 | None:
    """`o_T_m`, None where no board is known or two poses fit alike.

    Args:
        near: the keyframe that is nearest in time: its pose, and how far it is in ns.
    """
    views = _views(boards, state, sightings)
    scored = [(_chi2(state, views, pose), pose) for pose in _candidates(boards, state, views, near[0])]
    scored = sorted((s for s in scored if s[0][1] <= PLACED_PX), key=lambda s: s[0][0])
    if not scored:
        return None
    best = scored[0][1]
    rivals = [p for (chi2, _), p in scored[1:] if chi2 - scored[0][0][0] < boards.gate() and _apart(p, best)]
    if not rivals:
        return best
    if near[1] > RECENT_NS:
        return None
    return min([best, *rivals], key=lambda pose: float(np.linalg.norm(gtsam.Pose3.Logmap(near[0].between(pose)))))


def place_again(
    boards: Boards, state: State, mobile: Sequence[MarkerSighting], frame: StereoFrame, wanted: Container[int]
) -> gtsam.Pose3 | None:
    """`o_T_m` in the map of an earlier run, by the boards that are seen, or by landmarks that have been found again.

    Args:
        mobile: sightings in the mobile cameras.
        wanted: tracks that are landmarks of that map.
    """
    found = place(boards, state, mobile, (gtsam.Pose3(), 1 << 62)) if mobile else None
    return found or place_by_landmarks(state, frame, wanted)


def place_by_landmarks(state: State, frame: StereoFrame, wanted: Container[int]) -> gtsam.Pose3 | None:
    """`o_T_m` from where a frame shows landmarks again; None where these are too few, or do not agree.

    Args:
        wanted: tracks that count.
    """
    old = [
        (row, state.point(keys.landmark(track)))
        for row, track in enumerate(frame.track_ids.tolist())
        if track in wanted and state.has(keys.landmark(track))
    ]
    if len(old) < FEWEST_LANDMARKS:
        return None
    px = frame.left_px[[row for row, _ in old]]
    K = state.intrinsics(keys.intrinsics("m_left")).K()
    found = camera_pose(np.array([point for _, point in old]), px, K)
    return None if found is None or found[1] > LANDMARKS_PX else pose3(found[0])


def _views(
    boards: Boards, state: State, sightings: Sequence[MarkerSighting]
) -> list[tuple[str, list[MarkerSighting], Float, Float]]:
    """Camera, sightings of known boards, their corners in {o}; the camera that sees most first."""
    views = []
    for camera in ("m_left", "m_right"):
        mine = [s for s in sightings if s.camera == camera]
        seen = boards.usable(mine)
        if seen and state.has(keys.intrinsics(camera)):
            views.append((camera, seen, *boards.known_corners(mine)))
    return sorted(views, key=lambda view: -len(view[1]))


def _candidates(
    boards: Boards, state: State, views: list[tuple[str, list[MarkerSighting], Float, Float]], near: gtsam.Pose3
) -> list[gtsam.Pose3]:
    found = []
    for camera, seen, points, px in views:
        K = state.intrinsics(keys.intrinsics(camera)).K()
        own = near.compose(_m_T_c(state, camera)).matrix()
        tries = [camera_pose(points, px, K, None if len(points) >= FREE_POINTS else own)]
        poses = [pose3(t[0]) for t in tries if t is not None]
        if len(points) < FREE_POINTS:
            poses += boards.o_T_camera(seen)
        found += [pose.compose(_m_T_c(state, camera).inverse()) for pose in poses]
    return found


def _chi2(
    state: State, views: list[tuple[str, list[MarkerSighting], Float, Float]], o_T_m: gtsam.Pose3
) -> tuple[float, float]:
    """Chi-square over all views, and the median error in pixels."""
    total, errors = 0.0, []
    for camera, seen, points, px in views:
        o_T_c = o_T_m.compose(_m_T_c(state, camera))
        local = (points - o_T_c.translation()) @ o_T_c.rotation().matrix()
        if (local[:, 2] <= 0).any():
            return float("inf"), float("inf")
        image = local @ state.intrinsics(keys.intrinsics(camera)).K().T
        residual = image[:, :2] / image[:, 2:] - px
        information = np.linalg.inv(np.concatenate([s.covariance_px2[s.good] for s in seen]))
        total += float(np.einsum("ni,nij,nj->", residual, information, residual))
        errors.append(np.linalg.norm(residual, axis=1))
    return total, float(np.median(np.concatenate(errors)))


def _m_T_c(state: State, camera: str) -> gtsam.Pose3:
    return gtsam.Pose3() if camera == "m_left" else state.pose(keys.extrinsics(camera))


def _apart(a: gtsam.Pose3, b: gtsam.Pose3) -> bool:
    step = gtsam.Pose3.Logmap(a.between(b))
    return bool(np.linalg.norm(step[:3]) > SAME_RAD or np.linalg.norm(step[3:]) > SAME_M)
