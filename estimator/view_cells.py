"""Views of a board that share their sub-pixel error, because they are from the same place."""

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]

SAME_PLACE_M = 0.02
SAME_DIRECTION_RAD = 0.035


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
