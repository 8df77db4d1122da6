"""Noise models: covariance in, robust loss around it. Rotation comes first in Pose3 tangents."""

import gtsam
import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]
Model = gtsam.noiseModel.Base


def gaussian(covariance: Float) -> Model:
    """Full covariance, shape (n, n)."""
    return gtsam.noiseModel.Gaussian.Covariance(covariance)


def sigmas(values: Float | list[float]) -> Model:
    """Independent components."""
    return gtsam.noiseModel.Diagonal.Sigmas(np.asarray(values, float))


def pose_sigmas(rotation_rad: float, translation_m: float) -> Model:
    """Isotropic in rotation and in translation."""
    return sigmas([rotation_rad] * 3 + [translation_m] * 3)


def huber(model: Model, scale: float) -> Model:
    """Residuals beyond `scale` sigmas pull with constant force."""
    return gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Huber.Create(scale), model)
