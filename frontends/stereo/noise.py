"""Pixel covariances of tracks: what structure and residual of a patch say, scaled by what this log's residuals show."""

import numpy as np

from .alignment import Alignment, Patches
from .geometry import Float
from .motion import MEDIAN_4


class NoiseModel:
    """Covariance of aligned patches: `scale * structural + floor^2 I`."""

    def __init__(self) -> None:
        self.scale = 1.0
        self.floor_px = 0.06
        self.flow_variance = 0.3**2
        self._gain = 1.0

    def aligned(self, structural: Float) -> Float:
        """Covariances (n, 2, 2) of aligned positions."""
        return self._gain * (self.scale * structural + self.floor_px**2 * np.eye(2))

    def learn_motion(self, chi2: Float) -> None:
        """Follows the median squared residual (in sigmas, 4 degrees of freedom) of a keyframe's motion."""
        if len(chi2) >= 20:
            ratio = float(np.median(chi2)) / MEDIAN_4
            self._gain = float(np.clip(self._gain * np.clip(ratio, 0.25, 4.0) ** 0.3, 0.2, 400.0))

    def residual_variance(self, right: Alignment, patches: Patches) -> Float:
        """Grey-value variance (n,) of new patches: their own mismatch with the right image, or the median of it."""
        mismatch = 2.0 * (1.0 - right.correlation) * patches.contrast**2
        good = right.converged & (right.correlation > 0.8)
        typical = float(np.median(mismatch[good])) if good.any() else 25.0
        return np.where(good, mismatch, typical)
