"""Does the model agree with its own data? Chi-square by family, and a test of every single prior and tape measure."""

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray

from ..factors.chance import chi2_cdf, chi2_ppf, normal_isf
from ..factors.measurements import Rejection
from .graph import Record
from .linear import LinearSystem, deviate
from .linearised import Linearised
from .marginal import FAMILY as EARLIER
from .result import Consistency, FamilyConsistency

Float = NDArray[np.float64]

FALSE_ALARM = 1e-3
"""Probability, per family, that a correct model is called inconsistent."""
SIGMA_TOLERANCE = 0.25
"""Noise levels are known to a quarter: a family is inconsistent when its residuals need sigmas larger than that."""
PRIOR_FALSE_ALARM = 1e-4
CONTRADICTING, FEWEST_CONTRADICTING = 1 / 3, 4
"""Share and number of a family's measurements beyond which those that were taken out as outliers are none: gross errors
are the fewer by far, and where they are not nobody knows which ones were right."""


@dataclass(frozen=True, slots=True)
class PriorTest:
    """How far one prior, distance or mount lies from what everything else says, in its own predicted spread."""

    record: Record
    chi2: float
    dof: int
    sigma: float
    """The normal deviate that is as improbable."""
    residual: Float
    """Whitened residual."""


def family_tests(at: Linearised) -> tuple[FamilyConsistency, ...]:
    """Chi-square of every family of measurements that has degrees of freedom to spare.

    What keyframes left that are gone is no measurement: its errors are those of many that were weighed before.
    """
    system = at.system
    families = sorted({r.family for _, _, r in at.active})
    group = np.array([families.index(r.family) for _, _, r in at.active])
    shares = system.leverage(group, len(families))
    tests = []
    for g, family in enumerate(families):
        if family == EARLIER:
            continue
        norms, rows = at.norms[group == g], system.rows[group == g]
        dof = max(float(rows.sum() - shares[g]), 0.0)
        soft = int((norms > 3.0 * np.sqrt(rows)).sum())
        lower, upper = limits(dof)
        tenths = tuple(int(n) for n in np.histogram(chi2_cdf(norms**2, rows), 10, (0.0, 1.0))[0])
        total = float((norms**2).sum())
        tests.append(FamilyConsistency(family, total, dof, lower, upper, len(norms), soft, tenths))
    return tuple(tests)


def limits(dof: float, tolerance: float = SIGMA_TOLERANCE) -> tuple[float, float]:
    """Acceptance limits of chi2 / dof: what chance allows, and how well sigmas are known."""
    if dof < 1.0:
        return 0.0, float("inf")
    lower = chi2_ppf(FALSE_ALARM / 2, dof) / dof / (1 + tolerance) ** 2
    upper = chi2_ppf(1 - FALSE_ALARM / 2, dof) / dof * (1 + tolerance) ** 2
    return lower, upper


def prior_tests(
    active: list[tuple[int, gtsam.NonlinearFactor, Record]], system: LinearSystem, families: tuple[str, ...]
) -> list[PriorTest]:
    """Each prior against the rest: its residual has covariance I - H, H its block of the hat matrix."""
    positions = [i for i, (_, _, r) in enumerate(active) if not r.rejectable and r.family in families]
    tests = []
    for position, (total, dof) in zip(positions, system.standardised(positions), strict=True):
        if dof:
            residual = -system.b[system.starts[position] : system.starts[position + 1]]
            tests.append(PriorTest(active[position][2], total, dof, deviate(total, dof), residual))
    return tests


def contradictions(families: Iterable[FamilyConsistency], rejected: Iterable[Rejection]) -> list[str]:
    """Families of which too much had to be taken out, in words: what is left agrees with itself because of that.

    Args:
        rejected: what the solution found to be outliers, as far as it had entered.
    """
    out = Counter(rejection.family for rejection in rejected)
    told = []
    for f in families:
        gone, all_of_them = out[f.family], out[f.family] + f.residuals
        if gone >= FEWEST_CONTRADICTING and gone > CONTRADICTING * all_of_them:
            told.append(f"{f.family}: {gone} of {all_of_them} measurements contradict the rest (limit a third)")
    return told


def contradicted_points(clicks: Mapping[str, int], rejected: Iterable[Rejection]) -> list[str]:
    """Points half of whose clicks were taken out, in words: the others may be the wrong ones.

    Args:
        clicks: how many there are, by point.
        rejected: see `contradictions`.
    """
    what = [rejection.what for rejection in rejected]
    out = {point: sum(text.startswith(f"pick {point} in ") for text in what) for point in clicks}
    return [
        f"{point}: {out[point]} of {number} clicks contradict the rest (limit half)"
        for point, number in clicks.items()
        if out[point] and 2 * out[point] >= number
    ]


def judge(
    families: tuple[FamilyConsistency, ...],
    priors: list[PriorTest],
    paths: dict[str, float],
    contradicted: Iterable[str] = (),
) -> Consistency:
    """The verdict with its reasons.

    Args:
        contradicted: reasons found before, see `contradictions` and `contradicted_points`.
    """
    reasons = [*contradicted]
    for f in families:
        if f.dof >= 1.0 and f.chi2 / f.dof > f.upper:
            factor = np.sqrt(f.chi2 / f.dof)
            reasons.append(
                f"{f.family}: residuals are {factor:.2f} times what their sigmas say (limit {np.sqrt(f.upper):.2f})"
            )
    limit = normal_isf(PRIOR_FALSE_ALARM / 2)
    for test in priors:
        if test.sigma > limit:
            reasons.append(
                f"{test.record.what}: {test.sigma:.1f} sigma from what everything else says (limit {limit:.1f})"
            )
    measured = [f for f in families if f.family not in ("gauge", "calibration priors", "mount", "board geometry")]
    return Consistency(
        float(sum(f.chi2 for f in measured)),
        float(sum(f.dof for f in measured)),
        families,
        paths,
        not reasons,
        tuple(reasons),
    )
