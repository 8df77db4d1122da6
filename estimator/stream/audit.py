"""From time to time: does the model agree with its own data, and how far do correlated tracks widen the answer?"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import gtsam
import numpy as np
from scipy.sparse import csr_matrix, diags

from ...factors import keys
from ..batch import without_factors
from ..consistency import family_tests, judge, prior_tests
from ..engine import Engine
from ..graph import FactorLog
from ..linearised import linearise, with_correlated_tracks
from ..marginal import FAMILY
from ..observability import Undetermined, determined
from ..odometry import FAMILY as ODOMETRY
from ..points_in_base import point_blocks
from ..result import Consistency

TESTED = ("mount", "known distances", "board geometry", "calibration priors")
NOT_TESTED = Consistency(0.0, 0.0, (), {}, True, ())


@dataclass(frozen=True, slots=True)
class Audit:
    """The outcome."""

    consistency: Consistency = NOT_TESTED
    widening: Mapping[str, float] = field(default_factory=dict)
    """By point: factor on its covariance, at least 1."""


def relinearised(log: FactorLog, values: gtsam.Values) -> tuple[gtsam.Values, set[int]]:
    """One Newton step on: residuals at an old linearisation are not the data's. The running estimate stays as it is,
    so that looking does not change what comes after.

    Returns:
        The values, and the places of factors that do not count: those of landmarks that nothing determines there.

    Raises:
        ObservabilityError: something else than a landmark is not determined.
    """
    off: set[int] = set()
    while True:
        try:
            with determined():
                return values.retract(without_factors(log, off).linearize(values).optimize()), off
        except Undetermined as error:
            views = {i for i, f, r in log.active() if error.key in f.keys() and r.family != FAMILY}
            if keys.kind(error.key) != "l" or views <= off:
                raise
            off |= views


def audit(engine: Engine) -> Audit:
    """Takes as long as a batch refinement's last step. What earlier keyframes left is widened like tracks are: it is
    mostly made of them, and cannot be told apart any more."""
    log = engine.solver.log
    values, off = relinearised(log, engine.solver.values())
    at = with_correlated_tracks(linearise(log, off, values, engine.rig.gates.robust_sigma), ODOMETRY)
    system = at.system
    if system.root is not None:
        earlier = np.array([record.family == FAMILY for _, _, record in at.active])
        wider = np.where(np.repeat(earlier, system.rows), np.sqrt(at.inflation), 1.0)
        system.root = csr_matrix(diags(wider) @ system.root)
    families = tuple(f for f in family_tests(at) if f.family != FAMILY)
    consistency = judge(families, prior_tests(at.active, system, TESTED), {})
    widening = {}
    if values.exists(keys.base(0)):
        for point in engine.pipes.points.values():
            if point.known:
                _, blocks = point_blocks(values, keys.base(0), keys.point(point.index))
                wide = np.trace(system.covariance(blocks))
                root, system.root = system.root, None
                plain = np.trace(system.covariance(blocks))
                system.root = root
                widening[point.id] = max(float(wide / plain), 1.0)
    return Audit(consistency, widening)
