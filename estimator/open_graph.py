"""The graph while it grows: what is believed, what waits for the solver, and the solver."""

from collections.abc import Collection, Mapping, Sequence

import gtsam
import numpy as np
from numpy.typing import NDArray

from .graph import State, Update
from .incremental import Incremental


class OpenGraph:
    """New factors wait here for the next iSAM2 update; their first guesses count from now on."""

    def __init__(self) -> None:
        self.state = State()
        self.solver = Incremental()
        self._pending = Update()

    @property
    def unsolved(self) -> bool:
        """Are there factors that have not been through the solver?"""
        return not self._pending.empty()

    def take(self, update: Update) -> None:
        """Takes new factors and guesses."""
        if update.empty():
            return
        self.state.values.insert(update.values)
        self._pending.extend(update)

    def flush(self) -> bool:
        """One iSAM2 update with what has gathered; False where there was nothing."""
        if self._pending.empty():
            return False
        update, self._pending = self._pending, Update()
        self.state.values = self.solver.update(update)
        return True

    def relocate(self, values: gtsam.Values, moved: Collection[int], correction: gtsam.Pose3) -> None:
        """Other values, from which the solver begins anew at the next update; nothing may be waiting.

        Args:
            values: with `correction` from the left on the variables `moved`.
        """
        self.state.values = self.solver.relocate(values, moved, correction)

    def give_up(self, gone: Collection[int], places: Mapping[int, NDArray[np.float64]]) -> None:
        """Variables leave with all that was said of them, and points begin again elsewhere; nothing may be waiting.

        Args:
            places: in {o}, shape (3,), by key.
        """
        self.state.values = self.solver.give_up(gone, places)

    def joint_covariance(self, keys: Sequence[int]) -> NDArray[np.float64]:
        """Joint covariance of some variables with all that has gathered, in the order of `keys`.

        Raises:
            ObservabilityError: one of them is not determined.
        """
        self.flush()
        return self.solver.joint_covariance(keys)
