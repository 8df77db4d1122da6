"""What the graph says now about the variables that are asked for: one elimination, no iteration.

The answer is the optimum of the problem linearised at the running estimate: a full Newton step beyond what iSAM2 has
relinearised, and the joint covariance of everything that is asked for.
"""

from collections.abc import Sequence

import gtsam
import numpy as np
from numpy.typing import NDArray

from ...factors import keys
from ...factors.errors import ObservabilityError
from ..marginal import GaussianPrior

Float = NDArray[np.float64]


PIPES = "puvr"
"""Points, and ends and radii of pipes: they begin from rough guesses, all else near its place."""


class Posterior:
    """Joint mean and covariance of some variables.

    Raises:
        ObservabilityError: they are not determined.
    """

    def __init__(self, prior: GaussianPrior) -> None:
        starts = np.concatenate([[0], np.cumsum(prior.widths)]).astype(int)
        self.columns = {k: slice(a, b) for k, a, b in zip(prior.keys, starts[:-1], starts[1:], strict=True)}
        scale = 1.0 / np.sqrt(np.maximum(np.diag(prior.H), 1e-300))
        try:
            root = np.linalg.cholesky(prior.H * np.outer(scale, scale))
        except np.linalg.LinAlgError as error:
            raise ObservabilityError(
                "the measurements do not determine the state; show a board to the camera"
            ) from error
        inverse = np.linalg.inv(root) * scale[None, :]
        self.joint: Float = inverse.T @ inverse
        """Shape (n, n)."""
        step = gtsam.VectorValues()
        delta = self.joint @ prior.g
        moved = np.abs(delta / np.sqrt(np.diag(self.joint)))
        pipes = [moved[columns].max() for key, columns in self.columns.items() if keys.kind(key) in PIPES]
        self.step_sigma = float(max(pipes, default=0.0))
        """The Newton step of pipes and points, in standard deviations: how far from its optimum the estimate was."""
        for key, columns in self.columns.items():
            step.insert(key, delta[columns])
        self.values: gtsam.Values = prior.at.retract(step)

    def covariance(self, blocks: Sequence[tuple[int, Float]]) -> Float:
        """Covariance of `J x`, J given by blocks (key, columns of the key)."""
        J = np.zeros((blocks[0][1].shape[0], len(self.joint)))
        for key, block in blocks:
            J[:, self.columns[key]] += block
        return J @ self.joint @ J.T

    def marginal(self, key: int) -> Float:
        """One variable's own covariance, in its tangent."""
        return self.joint[self.columns[key], self.columns[key]]
