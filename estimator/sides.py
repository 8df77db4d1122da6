"""Are left and right exchanged? What both cameras see at one moment then lies behind them."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from ..factors.camera import CameraModel
from ..factors.errors import LogError
from ..factors.measurements import MarkerSighting
from ..factors.rig import Rig

Float = NDArray[np.float64]

CLEAR_PARALLAX_RAD = 0.01
"""Three pixels at a focal length of 300: no noise of a corner turns the sign of that."""
ENOUGH = 16
"""Corners that have to agree before anything is said: a marker misread at one moment gives four."""


class Sides:
    """Counts corners before and behind a stereo camera; wrong sides stop the run early, with the cure."""

    def __init__(self, rig: Rig) -> None:
        self._rig = rig
        self._before = 0
        self._behind = 0

    def look(
        self, sightings: Sequence[MarkerSighting], cameras: Mapping[str, CameraModel], left_T_right: Float
    ) -> None:
        """Markers of one stamp.

        Args:
            left_T_right: nominal pose of the right camera in the left one, (4, 4).

        Raises:
            LogError: left and right are swapped.
        """
        pairs = _in_both(sightings)
        if not pairs:
            return
        left = np.concatenate([a.corners_px for a, _ in pairs])
        right = np.concatenate([b.corners_px for _, b in pairs])
        depth, parallax = depths(left, right, cameras["m_left"].K, cameras["m_right"].K, left_T_right)
        clear = parallax > CLEAR_PARALLAX_RAD
        self._before += int((clear & (depth > 0)).sum())
        self._behind += int((clear & (depth < 0)).sum())
        if self._behind >= ENOUGH and self._behind > 4 * self._before:
            raise swapped(self._rig, f"at {pairs[0][0].stamp_ns} ns: {self._behind} corners lie behind the camera")


def swapped(rig: Rig, evidence: str) -> LogError:
    """The one line that says so."""
    topics = f"{rig.cameras.m_left.image_topic} and {rig.cameras.m_right.image_topic}"
    return LogError(
        f"{topics} {evidence}: left and right are swapped; exchange the topics of m_left and m_right in the rig file"
    )


def depths(left_px: Float, right_px: Float, K_left: Float, K_right: Float, left_T_right: Float) -> tuple[Float, Float]:
    """Where two rays pass each other nearest: depth in the left camera (n,), m; the angle between them (n,), rad."""
    a = _rays(left_px, K_left)
    b = _rays(right_px, K_right) @ left_T_right[:3, :3].T
    t = left_T_right[:3, 3]
    aa, bb, ab = (a * a).sum(1), (b * b).sum(1), (a * b).sum(1)
    determinant = np.maximum(aa * bb - ab * ab, 1e-12)
    depth = (bb * (a @ t) - ab * (b @ t)) / determinant
    return depth, np.arctan2(np.sqrt(determinant), ab)


def _rays(px: Float, K: Float) -> Float:
    return np.column_stack([px, np.ones(len(px))]) @ np.linalg.inv(K).T


def _in_both(sightings: Sequence[MarkerSighting]) -> list[tuple[MarkerSighting, MarkerSighting]]:
    right = {(s.board, s.marker): s for s in sightings if s.camera == "m_right"}
    return [(s, right[s.board, s.marker]) for s in sightings if s.camera == "m_left" and (s.board, s.marker) in right]
