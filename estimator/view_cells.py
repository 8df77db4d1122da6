"""Views of a board that share their sub-pixel error, because they are from the same place."""

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]

SAME_PLACE_M = 0.02
SAME_DIRECTION_RAD = 0.035
LEAST_OWN_SHARE = 0.1
"""Part of a variance that is the view's own at least: two images of one place differ by their noise."""


def added_covariance(total: Float, common: float, views: int) -> Float:
    """What the n-th of equal views adds to those before it, written as the covariance of an independent view.

    With the own part S = total - C of each view and the common part C = common^2 I, the mean of n views has the
    information n (S + n C)^-1. The n-th view brings the n-th increase of that, V^-1 = n (S + n C)^-1 -
    (n - 1) (S + (n - 1) C)^-1, so V = (S + n C) S^-1 (S + (n - 1) C): views from one place never know more than C^-1.

    Args:
        total: of one view, shape (..., 2, 2).
        common: sigma of the common part; at most what leaves a tenth of every variance to the view's own part.
        views: n, this view included.
    """
    least = np.linalg.eigvalsh(total)[..., :1, None]
    C = np.minimum(common**2, (1.0 - LEAST_OWN_SHARE) * least) * np.eye(2)
    S = total - C
    return np.asarray((S + views * C) @ np.linalg.solve(S, S + (views - 1) * C), float)


class ViewCells:
    """Counts one camera's views of one board by the place that they are from."""

    def __init__(self) -> None:
        self.last: int | None = None
        """The view that was counted last."""
        self.views = 0
        """Number of views from its place so far, it included."""
        self.cell = -1
        """The place that it is from, numbered in the order of their first views."""
        self._poses = np.empty((16, 12))
        self._counts: list[int] = []

    def count(self, view: int, board_T_camera: Float) -> None:
        """One more view, pose (4, 4)."""
        pose = np.concatenate([board_T_camera[:3, 3], board_T_camera[:3, :3].ravel()])
        known = self._poses[: len(self._counts)]
        near = ((known[:, :3] - pose[:3]) ** 2).sum(axis=1) < SAME_PLACE_M**2
        # trace(A^T B) = 1 + 2 cos(angle between A and B)
        near &= known[:, 3:] @ pose[3:] > 1 + 2 * np.cos(SAME_DIRECTION_RAD)
        if near.any():
            cell = int(np.argmax(near))
            self._counts[cell] += 1
        else:
            cell = len(self._counts)
            if cell == len(self._poses):
                self._poses = np.concatenate([self._poses, np.empty_like(self._poses)])
            self._poses[cell] = pose
            self._counts.append(1)
        self.last, self.cell, self.views = view, cell, self._counts[cell]
