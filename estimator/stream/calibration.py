"""How far calibration states have gone from their priors, and holding them where they are."""

import gtsam
import numpy as np
from numpy.typing import NDArray

from ...factors import keys
from ...factors.noise import sigmas
from ..calibration_rows import calibration_rows
from ..engine import Engine
from ..graph import Record, Update
from ..result import CalibrationEstimate
from .posterior import Posterior

Float = NDArray[np.float64]

FROZEN = "frozen"
HOLD = {"k": [1e-3, 1e-3, 1e-5, 1e-3, 1e-3, 1e-6, 1e-6, 1e-6, 1e-6], "e": [1e-6] * 6, "d": [1e-6] * 2, "g": [1e-6] * 3}
"""Sigmas with which a calibration is held: a hundredth of what matters."""


def departures(engine: Engine, posterior: Posterior) -> tuple[CalibrationEstimate, ...]:
    """Each calibration state against its prior."""

    def sigmas_of(key: int) -> Float:
        return np.sqrt(np.clip(np.diag(posterior.marginal(key)), 0.0, None))

    return calibration_rows(engine, posterior.values, sigmas_of)


def hold(engine: Engine) -> Update:
    """Factors that hold the calibration where it is now."""
    values, update = engine.state.values, Update()
    for key in values.keys():
        kind = keys.kind(key)
        if kind not in HOLD:
            continue
        noise = sigmas(HOLD[kind])
        if kind == "k":
            factor: gtsam.NonlinearFactor = gtsam.PriorFactorCal3DS2(key, values.atCal3DS2(key), noise)
        elif kind == "e":
            factor = gtsam.PriorFactorPose3(key, values.atPose3(key), noise)
        else:
            factor = gtsam.PriorFactorVector(key, values.atVector(key), noise)
        update.add(factor, Record(FROZEN, FROZEN, engine.end_ns, f"{keys.words(key)} held", rejectable=False))
    return update


def held(engine: Engine) -> list[int]:
    """Places of those factors in the log."""
    return [i for i, _, record in engine.solver.log.active() if record.family == FROZEN]
