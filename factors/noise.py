"""Noise models: covariance in, robust loss around it. Rotation comes first in Pose3 tangents."""

from functools import cache

import gtsam
import numpy as np
from numpy.typing import NDArray

from .chance import chi2_ppf, normal_cdf

Float = NDArray[np.float64]
Model = gtsam.noiseModel.Base


def gaussian(covariance: Float) -> Model:
    """Full covariance, shape (n, n)."""
    return gtsam.noiseModel.Gaussian.Covariance(covariance)


def floored(covariance: Float, sigma: float) -> Float:
    """A covariance, shape (n, n), that is no better than `sigma` in any direction; what is worse stays as it is."""
    variances, directions = np.linalg.eigh(covariance)
    return np.asarray((directions * np.maximum(variances, sigma**2)) @ directions.T, np.float64)


def sigmas(values: Float | list[float]) -> Model:
    """Independent components."""
    return gtsam.noiseModel.Diagonal.Sigmas(np.asarray(values, float))


def pose_sigmas(rotation_rad: float, translation_m: float) -> Model:
    """Isotropic in rotation and in translation."""
    return sigmas([rotation_rad] * 3 + [translation_m] * 3)


def huber(model: Model, scale: float) -> Model:
    """Residuals beyond `scale` sigmas pull with constant force."""
    return gtsam.noiseModel.Robust.Create(_huber_loss(scale), model)


@cache
def _huber_loss(scale: float) -> gtsam.noiseModel.mEstimator.Base:
    """It has no state: all models share it."""
    return gtsam.noiseModel.mEstimator.Huber.Create(scale)


@cache
def robust_scale(robust_sigma: float, dimension: int) -> float:
    """Norm of a whitened residual beyond which it is softened: as rare as `robust_sigma` is for one dimension."""
    return float(np.sqrt(chi2_ppf(2.0 * normal_cdf(robust_sigma) - 1.0, dimension)))


def robust(model: Model, robust_sigma: float) -> Model:
    """Huber around a model, with the scale that suits its dimension."""
    return huber(model, robust_scale(robust_sigma, model.dim()))
