"""Vertical disagreement of the two images with the nominal rig, learnt along the way.

A rig that is slightly turned shows every match some tenths of a pixel above or below its epipolar line. The front end
takes that out of its own residuals, so that they speak of the noise; what it delivers stays as measured.
"""

import numpy as np

from .geometry import Float, StereoGeometry, project

_PRIOR_PX = np.array([3.0, 3.0, 3.0, 3.0, 3.0])
"""Standard deviations of the five terms, each over half the image: what tolerances of a rig can do."""
_FORGETTING = 0.98


class VerticalCorrection:
    """Offset of right matches across the epipolar line: linear in place and disparity, and the keystone of a toe-in."""

    def __init__(self, rig: StereoGeometry) -> None:
        self._rig = rig
        self._prior = np.diag(1.0 / _PRIOR_PX**2)
        self._normal = np.zeros((5, 5))
        self._moment = np.zeros(5)
        self._terms = np.zeros(5)

    def residual(self, left_px: Float, right_px: Float) -> Float:
        """Vertical residuals (n,) of stereo matches after correction, in pixels; NaN without a match."""
        points = self._rig.triangulate(left_px, right_px)
        expected = project(self._rig.right_points(points), self._rig.right)[:, 1]
        # Half of the disagreement is taken up by the left image: the closest approach lies between the two rays.
        return right_px[:, 1] - expected - self._basis(left_px, right_px) @ self._terms

    def apply(self, left_px: Float, right_px: Float) -> Float:
        """Right pixels (n, 2) with the offset taken off."""
        corrected = right_px.copy()
        corrected[:, 1] -= self._basis(left_px, right_px) @ self._terms
        return corrected

    def learn(self, left_px: Float, right_px: Float, variance: Float) -> None:
        """Takes up the matches of one keyframe; `variance` (n,) is that of the vertical residual, px^2."""
        points = self._rig.triangulate(left_px, right_px)
        seen = np.isfinite(points).all(axis=1)
        if seen.sum() < 20:
            return
        basis = self._basis(left_px[seen], right_px[seen])
        residual = right_px[seen, 1] - project(self._rig.right_points(points[seen]), self._rig.right)[:, 1]
        remainder = residual - basis @ self._terms
        scale = max(1.4826 * float(np.median(np.abs(remainder - np.median(remainder)))), 0.02)
        weight = 1.0 / (1.0 + ((remainder - np.median(remainder)) / (3.0 * scale)) ** 2) / (variance[seen] + scale**2)
        self._normal = _FORGETTING * self._normal + (basis.T * weight) @ basis
        self._moment = _FORGETTING * self._moment + (basis.T * weight) @ residual
        self._terms = np.linalg.solve(self._normal + self._prior, self._moment)

    def _basis(self, left_px: Float, right_px: Float) -> Float:
        half = 0.5 * self._rig.left.width
        basis = np.ones((len(left_px), 5))
        basis[:, 1] = (right_px[:, 0] - self._rig.right.cx) / half
        basis[:, 2] = (right_px[:, 1] - self._rig.right.cy) / half
        basis[:, 3] = (left_px[:, 0] - right_px[:, 0]) / half
        basis[:, 4] = basis[:, 1] * basis[:, 2]
        return np.where(np.isfinite(basis), basis, 0.0)
