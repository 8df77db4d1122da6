"""How much larger the errors of marker corners are than stated, by their own residuals.

What a corner fit says of one image rests on that image alone; sampling, motion and print that it does not know show
over a whole recording. The a posteriori variance factor (Helmert; Förstner 1979) holds for all corners of a recording.
Whether it is more than chance and a little ignorance explain remains the consistency test's to say.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from .board_inspection import FAMILY
from .linearised import Linearised

FEWEST = 40.0
"""Degrees of freedom that tell a variance to a quarter."""
PROBES = 16


def corner_variance(at: Linearised) -> float:
    """Variance of corners over what is stated, at least 1."""
    mine = np.array([record.family == FAMILY for _, _, record in at.active], dtype=np.int64)
    if not mine.any():
        return 1.0
    system = at.system
    dof = float(system.rows[mine == 1].sum() - system.leverage(mine, 2, PROBES)[1])
    return max(1.0, float((at.norms[mine == 1] ** 2).sum()) / dof) if dof >= FEWEST else 1.0


def weights(at: Linearised, variance: float) -> Mapping[int, float]:
    """Information of every corner over what is stated, by the positions of factors."""
    if variance <= 1.0:
        return {}
    return {i: 1.0 / variance for i, (_, _, record) in enumerate(at.active) if record.family == FAMILY}


def as_stated(at: Linearised, variance: float) -> Linearised:
    """The same with norms of corners in units of what was stated: the consistency test judges that."""
    mine = np.array([record.family == FAMILY for _, _, record in at.active], dtype=bool)
    return replace(at, norms=np.where(mine, np.sqrt(variance) * at.norms, at.norms)) if variance > 1.0 else at
