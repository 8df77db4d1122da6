"""Pixel covariances of tracks: what structure and residual of a patch say, scaled by what this log's residuals show."""

import numpy as np
from numpy.typing import NDArray

from .alignment import Alignment, Patches
from .geometry import Float, median
from .left_motion import MEDIAN_2
from .stereo_motion import MEDIAN_4

Bool = NDArray[np.bool_]

_FLOOR_PX = 0.04
"""What remains on sharp noise-free views: sampling and slant; scaled by the log's residuals like the rest."""
_REFERENCE = 1.5
_RATE = 0.4
"""Weight of the newest keyframe in running averages."""


class NoiseModel:
    """Covariance of aligned patches: `gain * (structural + floor^2 I)`.

    The structural part is that of least squares: residual variance over squared gradients. The gain follows the
    residuals of the motion between keyframes, whose points and pixels carry these covariances: a view whose
    residuals are larger than they should be gets larger covariances, whatever the reason.
    """

    def __init__(self) -> None:
        self._gain = 1.0
        self._flow_gain = 1.0
        self._mismatch = np.nan

    @property
    def flow_variance(self) -> float:
        """Variance of a pixel that plain flow delivers, px^2."""
        return 0.2**2 * self._flow_gain

    def mismatch(self, noise: float) -> float:
        """Expected variance between a patch and its reference, in squared grey values."""
        return 2.0 * (0.4 * noise) ** 2 if np.isnan(self._mismatch) else self._mismatch

    def aligned(self, structural: Float) -> Float:
        """Covariances (n, 2, 2) of aligned positions from the alignment's own ones."""
        return self._gain * (structural + _FLOOR_PX**2 * np.eye(2))

    def reference(self, structural: Float) -> Float:
        """Covariances (n, 2, 2) of the places where references were taken.

        Later views share more with each other than with the first one, from which all their patches come; measured
        on rendered walks its residual has 1.5 times the variance of theirs.
        """
        return _REFERENCE * self.aligned(structural)

    def learn_motion(self, chi2: Float, stereo: Bool) -> float:
        """Follows the squared residuals (n,) in sigmas of a keyframe's motion; `stereo`: of 4 components, else 2.

        Returns by how much the gain grew: the keyframe that taught it deserves it too.
        """
        before = self._gain
        self._gain = float(np.clip(before * _median_ratio(chi2, stereo) ** _RATE, 0.2, 400.0))
        return self._gain / before

    def learn_flow(self, chi2: Float) -> None:
        """Follows the squared residuals (n,) in sigmas of plain flow."""
        ratio = _median_ratio(chi2, np.zeros(len(chi2), dtype=bool))
        self._flow_gain = float(np.clip(self._flow_gain * ratio**_RATE, 0.25, 400.0))

    def learn_mismatch(self, alignment: Alignment, patches: Patches, seen: Bool) -> None:
        """Follows how much tracked patches differ from their reference, in squared grey values."""
        if seen.sum() < 10:
            return
        typical = float(np.median(_mismatch(alignment, patches)[seen]))
        self._mismatch = typical if np.isnan(self._mismatch) else (1 - _RATE) * self._mismatch + _RATE * typical

    def reference_variance(self, right: Alignment, patches: Patches) -> Float:
        """Grey-value variance (n,) that the place of a new reference deserves.

        Its mismatch with the right image is that of a single small change of view, so it counts at least as much
        as a typical track's.
        """
        own = _mismatch(right, patches)
        good = right.converged & (right.correlation > 0.8)
        typical = self._mismatch
        if np.isnan(typical):
            typical = float(np.median(own[good])) if good.any() else 25.0
        return np.where(good, np.maximum(own, typical), typical)


def _mismatch(alignment: Alignment, patches: Patches) -> Float:
    return 2.0 * (1.0 - alignment.correlation) * patches.contrast**2


def _median_ratio(chi2: Float, stereo: Bool) -> float:
    """Median of the squared residuals over that of their distribution; one where there are too few."""
    if len(chi2) < 20:
        return 1.0
    return min(max(median(chi2 / np.where(stereo, MEDIAN_4, MEDIAN_2)), 0.25), 4.0)
