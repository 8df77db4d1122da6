"""From time to time: does the model agree with its own data, and how far do correlated tracks widen the answer?"""

from collections.abc import Mapping
from copy import copy
from dataclasses import dataclass, field, replace

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix, diags

from ...factors import keys
from ..batch import cleaned, outliers, without_factors
from ..board_inspection import FAMILY as CORNERS
from ..consistency import family_tests, judge, prior_tests
from ..corner_variance import as_stated, corner_variance, weights
from ..engine import Engine
from ..graph import FactorLog
from ..linear import LinearSystem
from ..linearised import Linearised, linearise, residual_norms, settled, with_correlated_tracks
from ..marginal import FAMILY
from ..newton import Elimination
from ..observability import Undetermined, determined
from ..odometry import FAMILY as ODOMETRY
from ..points_in_base import point_blocks
from ..result import Consistency, FamilyConsistency
from ..run_away import blamed
from ..track_weights import track_weights

Float = NDArray[np.float64]

TESTED = ("mount", "known distances", "board geometry", "calibration priors")
OUTLIER_ROUNDS = 2
NOT_TESTED = Consistency(0.0, 0.0, (), {}, True, ())


@dataclass(frozen=True, slots=True)
class Audit:
    """The outcome."""

    consistency: Consistency = NOT_TESTED
    widening: Mapping[str, float] = field(default_factory=dict)
    """By point, and by pose (`m` of the newest keyframe, `b`, boards): factor on its covariance, at least 1."""


def relinearised(log: FactorLog, values: gtsam.Values) -> tuple[gtsam.Values, set[int]]:
    """One Newton step on: residuals at an old linearisation are not the data's. The running estimate stays as it is,
    so that looking does not change what comes after.

    Returns:
        The values, and the places of factors that do not count: those of landmarks that nothing determines there.

    Raises:
        ObservabilityError: something else than a landmark is not determined.
    """
    off: set[int] = set()
    marks: set[int] = set()
    while True:
        try:
            with determined():
                return values.retract(without_factors(log, off).linearize(values).optimize()), off
        except Undetermined as error:
            key = blamed(error.key, values, marks)
            views = {i for i, f, r in log.active() if key in f.keys() and r.family != FAMILY}
            if keys.kind(key) != "l" or (key in marks and views <= off):
                raise
            marks.add(key)
            off |= views


def audit(engine: Engine) -> Audit:
    """Takes as long as a batch refinement after its first optimum. Corners are widened by what their residuals show.

    The running estimate has outliers in it, with little weight; whether the model holds is for the others to say.
    """
    log, robust_sigma = engine.solver.log, engine.rig.gates.robust_sigma
    values, off = relinearised(log, engine.solver.values())
    plain = linearise(log, off, values, robust_sigma)
    at = with_correlated_tracks(plain, ODOMETRY)
    system = at.system
    corners = np.sqrt(corner_variance(at))
    wider = np.repeat([corners if record.family == CORNERS else 1.0 for _, _, record in at.active], system.rows)
    system.root = csr_matrix(diags(wider) if system.root is None else diags(wider) @ system.root)
    priors = prior_tests(at.active, system, TESTED)
    widening = _widening(engine, system, values)
    consistency = judge(_families(log, off, plain, robust_sigma), priors, {})
    return Audit(consistency, widening)


def _families(log: FactorLog, off: set[int], at: Linearised, robust_sigma: float) -> tuple[FamilyConsistency, ...]:
    """Tests of the families as at the end of a recording: without outliers, with tracks weighed."""
    at = cleaned(log, off, at, robust_sigma, ((outliers, OUTLIER_ROUNDS),), Elimination())[0]
    at = settled(at, robust_sigma)[0]
    variance = corner_variance(at)
    at = _weighed(
        at, {**track_weights(at.active, at.system, ODOMETRY).by_position, **weights(at, variance)}, robust_sigma
    )
    return family_tests(as_stated(at, variance))


def _weighed(at: Linearised, by_position: Mapping[int, float], robust_sigma: float) -> Linearised:
    """With other weights of some factors, nothing linearised anew: as the tests want to know it, that changes nothing.

    Args:
        by_position: information over what is stated.
    """
    if not by_position:
        return at
    root = np.ones(len(at.active))
    root[list(by_position)] = np.sqrt(list(by_position.values()))
    system, step = at.system.weighed_rows(np.repeat(root, at.system.rows))
    stated = copy(system)
    stated.b = system.b / np.repeat(root, at.system.rows)  # as the robust loss has softened it
    norms = root * residual_norms(stated, at.rejectable, robust_sigma)
    return replace(at, values=system.moved(at.values, step), system=system, norms=norms)


def _widening(engine: Engine, system: LinearSystem, values: gtsam.Values) -> dict[str, float]:
    """What correlated tracks do to the covariances of points in {b} and of poses, as one factor each."""
    asked: dict[str, list[tuple[int, Float]]] = {}
    if values.exists(keys.base(0)):
        for point in engine.pipes.points.values():
            if point.known:
                asked[point.id] = point_blocks(values, keys.base(0), keys.point(point.index))[1]
    newest = keys.keyframe(engine.odometry.last_keyframe)
    poses = {"m": newest, "b": keys.base(0), **{b.id: engine.boards.key(b.id) for b in engine.rig.boards}}
    asked |= {name: [(key, np.eye(6))] for name, key in poses.items() if key in system.columns}
    wide = {name: system.covariance(blocks) for name, blocks in asked.items()}
    system.root = None
    return {name: _factor(wide[name], system.covariance(blocks)) for name, blocks in asked.items()}


def _factor(wide: Float, plain: Float) -> float:
    """How much wider, on average over the directions."""
    return max(float(np.trace(np.linalg.solve(plain, wide)) / len(plain)), 1.0)
