"""Four corners that err independently of each other, in place of four that do not.

The edges of a marker hold all of its corners: where one corner is off, so are the others, mostly the other way. The
marker as a whole is therefore known better, by a quarter of its variance, than four independent corners with the same
covariances say; what is known worse is how it is stretched and bent. The graph takes corners for independent (a factor
each, so that one that is wrong can go alone). Their covariances are scaled so that they know as much as the fit does of
what the pose of a board hangs on, which is where and how large its markers are, how they are turned and foreshortened:
with J the effect of an affine motion of the marker on its corners,

    s = (det J' B^-1 J / det J' C^-1 J)^(1/6),    B: the blocks of C on the diagonal.
"""

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]

_OWN = np.kron(np.eye(4), np.ones((2, 2)))
"""Which entries of the covariance belong to one corner each."""


def independent_scale(covariance: Float, corners: Float) -> Float:
    """Factor on the covariances of single corners where they are used as independent ones, shape (...).

    Args:
        covariance: of (x0, y0, x1, y1, ...), shape (..., 8, 8), positive definite.
        corners: shape (..., 4, 2).
    """
    J = _affine(corners)
    apart = covariance * _OWN
    of_both = J.swapaxes(-1, -2)[..., None, :, :] @ np.linalg.solve(
        np.stack([apart, covariance], -3), J[..., None, :, :]
    )
    logarithm = np.linalg.slogdet(of_both)[1]
    return np.exp((logarithm[..., 0] - logarithm[..., 1]) / 6.0)


def _affine(corners: Float) -> Float:
    """Change of the corners by a shift and a linear map of the marker about its middle, shape (..., 8, 6)."""
    away = corners - corners.mean(-2, keepdims=True)
    away = away / np.sqrt((away**2).mean((-2, -1), keepdims=True))
    J = np.zeros((*corners.shape[:-2], 8, 6))
    J[..., 0::2, 0] = J[..., 1::2, 3] = 1.0
    J[..., 0::2, 1:3] = J[..., 1::2, 4:6] = away
    return J
