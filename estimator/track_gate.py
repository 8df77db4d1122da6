"""Which tracks of a keyframe are still the landmarks that they are named after."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray

from ..factors import keys
from ..factors.errors import ObservabilityError
from ..factors.measurements import Rejection, StereoFrame
from .graph import State

Float = NDArray[np.float64]

FAMILY = "stereo odometry"

AWAY = 3
"""Keyframes without a view after which a landmark counts as having come back."""
DRIFT_SAMPLE = 5
"""Landmarks that tell how large a drift the graph thinks possible."""


@dataclass(frozen=True, slots=True)
class Gate:
    """A track off by more than both of these from where the map says is not that landmark any more."""

    sigma: float = 6.0
    px: float = 2.0


@dataclass(frozen=True, slots=True)
class Newest:
    """Where the map stands when a keyframe comes."""

    keyframe: int
    """Index of the one that the motion counts from."""
    seen_in: Mapping[int, int]
    """The last keyframe that saw each landmark."""
    lost: bool
    """Did the tracks break since?"""


class TrackGate:
    """Compares tracks with the map."""

    def __init__(self, state: State, gate: Gate) -> None:
        self._state, self._gate = state, gate
        self.joint_covariance: Callable[[Sequence[int]], Float] | None = None
        """Of the running solver; None refuses every landmark that comes back from far away."""

    def gated(
        self, frame: StereoFrame, rows: list[int], pose: gtsam.Pose3, newest: Newest
    ) -> tuple[list[int], list[Rejection]]:
        """Leaves out tracks that are far from where the map and the common shift of all tracks put them.

        Landmarks that come back into view after a time show the drift since, which the living ones do not: they have
        their own shift, and it has to be one that the drift can be.
        """
        last, ids = newest.keyframe, frame.track_ids
        back = [r for r in rows if last - newest.seen_in.get(int(ids[r]), last) >= AWAY]
        living = sorted(set(rows) - set(back))
        kept, rejected, shift = self._gated_together(frame, living, pose)
        again, more, drift = self._gated_together(frame, back, pose)
        excess = float(np.linalg.norm(drift - shift))
        if again and not newest.lost and excess > self._gate.px:
            sigmas = self._drift_sigmas(frame, again, pose, shift, last)
            if sigmas > self._gate.sigma:
                reason = "seen again, beyond what drift explains, sigmas"
                more += [self._refused(frame, r, reason, sigmas, self._gate.sigma) for r in again]
                again = []
        return kept + again, rejected + more

    @staticmethod
    def _refused(frame: StereoFrame, row: int, reason: str, value: float, limit: float) -> Rejection:
        what = f"track {int(frame.track_ids[row])} in m_left"
        return Rejection(frame.stamp_ns, FAMILY, what, reason, value, limit)

    def _gated_together(
        self, frame: StereoFrame, rows: list[int], pose: gtsam.Pose3
    ) -> tuple[list[int], list[Rejection], Float]:
        """Rows that have about the same residual, what does not, and that residual, px."""
        if not rows:
            return rows, [], np.zeros(2)
        residual, front = self._residuals(frame, rows, pose)
        shift = np.median(residual[front], axis=0) if front.any() else np.zeros(2)
        distance = np.linalg.norm(residual - shift, axis=1)
        spread = np.maximum(1.4826 * float(np.median(distance)), 0.0)
        sigma = np.sqrt(np.trace(frame.left_covariance_px2[rows], axis1=1, axis2=2) / 2)
        limit = np.maximum(self._gate.sigma * np.hypot(sigma, spread), self._gate.px)
        good = front & (distance < limit)
        rejected = [
            self._refused(frame, r, "off its landmark by px", float(distance[i]), float(limit[i]))
            for i, r in enumerate(rows)
            if not good[i]
        ]
        return [r for i, r in enumerate(rows) if good[i]], rejected, shift

    def _residuals(self, frame: StereoFrame, rows: list[int], pose: gtsam.Pose3) -> tuple[Float, NDArray[np.bool_]]:
        """Left pixels less those of the landmarks seen from a pose, (n, 2), and which are ahead of the camera."""
        points = np.array([self._state.point(keys.landmark(int(frame.track_ids[r]))) for r in rows])
        return residuals(self._state, frame, rows, points, pose)

    def _drift_sigmas(
        self, frame: StereoFrame, rows: list[int], pose: gtsam.Pose3, shift: Float, keyframe: int
    ) -> float:
        """How far landmarks that came back are from where they should be, in sigmas of the graph's own joint.

        The median over a few of them: they share the drift. What the living tracks show too is the pose's guess.
        """
        last = keys.keyframe(keyframe)
        if self.joint_covariance is None or not self._state.has(last):
            return float("inf")
        to_last = self._state.pose(last).between(pose).inverse().AdjointMap()
        K = self._state.intrinsics(keys.intrinsics("m_left")).K()
        chosen = rows[:: max(len(rows) // DRIFT_SAMPLE, 1)]
        residual = self._residuals(frame, chosen, pose)[0] - shift
        landmarks = [keys.landmark(int(frame.track_ids[r])) for r in chosen]
        found = []
        for r, off, landmark, joint in zip(chosen, residual, landmarks, self._joints(last, landmarks), strict=True):
            if joint is None:  # a landmark that nothing determines explains nothing
                found.append(float("inf"))
                continue
            x, y, z = c_p = pose.transformTo(self._state.point(landmark))
            by_point = K[:2, :2] @ np.array([[1 / z, 0, -x / z**2], [0, 1 / z, -y / z**2]])
            by_pose = np.hstack([by_point @ gtsam.Rot3.Hat(c_p), -by_point]) @ to_last
            J = np.hstack([by_pose, by_point @ pose.rotation().matrix().T])
            covariance = J @ joint @ J.T + frame.left_covariance_px2[r]
            found.append(float(np.sqrt(off @ np.linalg.solve(covariance, off))))
        return float(np.median(found))

    def _joints(self, pose: int, landmarks: list[int]) -> list[Float | None]:
        """Joint covariance (9, 9) of a pose with each landmark; None of those that nothing determines.

        All of them take one elimination of the graph, each alone takes one.
        """
        assert self.joint_covariance is not None
        try:
            joint = self.joint_covariance([pose, *landmarks])
        except ObservabilityError:
            if len(landmarks) == 1:
                return [None]
            return [self._joints(pose, [landmark])[0] for landmark in landmarks]
        own = [[*range(6), *range(6 + 3 * i, 9 + 3 * i)] for i in range(len(landmarks))]
        return [joint[np.ix_(part, part)] for part in own]


def residuals(
    state: State, frame: StereoFrame, rows: list[int], points: Float, pose: gtsam.Pose3
) -> tuple[Float, NDArray[np.bool_]]:
    """Left pixels less those of points (n, 3) in {o} seen from a pose, (n, 2), and which are ahead of the camera."""
    K = state.intrinsics(keys.intrinsics("m_left")).K()
    c_p = (points - pose.translation()) @ pose.rotation().matrix()
    front = c_p[:, 2] > 0.05
    px = (c_p @ K.T)[:, :2] / np.where(front, c_p[:, 2], 1.0)[:, None]
    return frame.left_px[rows] - px, front
