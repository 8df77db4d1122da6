"""Trust has an age: what nobody has looked at for a while is known less well, and a verdict on it expires."""

import numpy as np
from numpy.typing import NDArray

from ..decision import Decision
from .settings import S, StreamSettings

Float = NDArray[np.float64]

EXPIRED = "EXPIRED"
RANK = {"GO": 0, "MEASURE MORE": 1, "NO-GO": 2, EXPIRED: 3}
"""From good to bad."""


def grown(covariance_m2: Float, positions_m: Float, age_s: float, settings: StreamSettings) -> Float:
    """Joint covariance (3 n, 3 n) of n points in {b} when {b} was tied to a board so long ago.

    The machine may have crept and turned meanwhile: a random walk of its place, and of its attitude about its origin,
    which moves a point across the line of sight to it. All points move with it together.

    Args:
        covariance_m2: shape (3 n, 3 n), of then.
        positions_m: shape (n, 3), or (3,) of one.
    """
    age = max(age_s, 0.0)
    shift = settings.unseen_walk_m_per_root_s**2 * age
    turn = settings.unseen_turn_rad_per_root_s**2 * age
    x, y, z = np.asarray(positions_m, float).reshape(-1, 3).T
    nought = np.zeros_like(x)
    across = np.stack([nought, -z, y, z, nought, -x, -y, x, nought], axis=1).reshape(-1, 3)
    along = np.tile(np.eye(3), (len(x), 1))
    return covariance_m2 + shift * along @ along.T + turn * across @ across.T


def verdict_of(decision: Decision | None, now_ns: int) -> tuple[str, str]:
    """Verdict and its reason at a moment; none at all is no permission.

    Args:
        now_ns: of the stamps' clock.
    """
    if decision is None:
        return "MEASURE MORE", "the rig's cut_plan has no entry for this point"
    if decision.expires_ns is None or now_ns > decision.expires_ns:
        age = "never" if decision.expires_ns is None else f"{_age(decision, now_ns):.0f} s ago"
        return EXPIRED, f"Do not cut {decision.cut.point}: the board was seen {age}; show it to the camera again."
    return decision.verdict, decision.headline


def _age(decision: Decision, now_ns: int) -> float:
    assert decision.expires_ns is not None
    return decision.cut.board_age_limit_s + (now_ns - decision.expires_ns) / S
