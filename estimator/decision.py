"""May we cut here? The decision rule of JCGM 106 with a guard band, on the joint distribution of the cut.

The tool is sent to the estimate, so what counts is the error e = truth - estimate + tool, e ~ N(0, C + sigma_tool^2 I).
GO needs P(every requirement holds) >= 1 - wrong_go_probability. Requirements: the error stays in the tolerance region,
and the blade keeps its clearance from each keep-out box, pipe and surface. Their failures add up (Boole), so the
stated probability is never more than the true one. NO-GO where no further measurement can help: the tool alone is too
coarse, or the place itself is forbidden. All else is MEASURE MORE, and so is every doubt about the estimate as such.
"""

import re
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri

from ..factors.rig import Cut, Rig
from .clearance import SweptDisc, box_gap, pipe_gap
from .region_probability import ball_probability, cylinder_probability
from .result import PipeEstimate, PointEstimate, Result
from .validated_range import ValidatedRange

Float = NDArray[np.float64]
Verdict = Literal["GO", "NO-GO", "MEASURE MORE"]

SINGULAR = 1e-10
"""Smallest permitted ratio of least to largest principal variance: 1 to 100,000 in length."""
SCALES = (1e-3, 1e3)
"""Where the margin is sought: the measurement a thousand times better or worse."""


@dataclass(frozen=True, slots=True)
class Requirement:
    """One thing that has to hold for a cut."""

    name: str
    probability: float
    """That it holds, measurement and tool included."""
    possible: float
    """Tolerance: that it would hold if the measurement were perfect. Clearance: chance that a perfect measurement
    would find the place permitted."""
    text: str


@dataclass(frozen=True, slots=True)
class Obstacle:
    """Something to keep clear of, seen from the cut."""

    name: str
    gap_m: float
    """From the swept disc to the obstacle, negative where they overlap."""
    direction: Float
    """Shape (3,), unit, from the cut to the obstacle."""
    sigma_m: float
    """Of the obstacle's own place, along the direction; 0 for a box that is given in {b}."""
    includes_point: bool = False
    """True where `sigma_m` is of the distance, so that the point's own share is in it."""


@dataclass(frozen=True, slots=True)
class Decision:
    """The verdict on one entry of the cut plan."""

    cut: Cut
    verdict: Verdict
    headline: str
    """One sentence: what to do, with the number that decided."""
    probability: float | None
    """That all requirements hold, tool included; None where it cannot be said."""
    required: float
    tool_only: float
    """The same if the measurement were perfect, clearances left out."""
    requirements: tuple[Requirement, ...]
    blockers: tuple[str, ...]
    """Why a GO is out of the question whatever the numbers say."""
    margin: float | None
    """Factor on the measurement's standard uncertainty at which the probability equals the required one: above 1 is
    reserve, below 1 is what is lacking. None where no factor in `SCALES` does it."""
    expires_ns: int | None
    """When trust in the board's place ends, in the log's time."""
    notes: tuple[str, ...] = ()


def decide(result: Result, rig: Rig, validated: ValidatedRange | None) -> tuple[Decision, ...]:
    """One decision for each entry of the cut plan, in its order."""
    points = {point.id: point for point in result.points}
    return tuple(decide_cut(cut, points.get(cut.point), result, validated) for cut in rig.cut_plan)


def decide_cut(cut: Cut, point: PointEstimate | None, result: Result, validated: ValidatedRange | None) -> Decision:
    """The verdict for one cut; `point` is None where the recording holds no pick of it."""
    required = 1 - cut.wrong_go_probability
    tool_only = tolerance_probability(cut, np.zeros((3, 3)), None if point is None else _axis(point))
    age_limit_ns = int(cut.board_age_limit_s * 1e9)
    last = result.last_board_view_ns
    blockers = _blockers(cut, point, result, validated)
    usable = point is not None and not _covariance_fault(point)
    obstacles = _obstacles(cut, point, result) if point is not None and usable else ()
    requirements = _requirements(cut, point, obstacles) if point is not None and usable else ()
    probability = _all_hold(requirements) if requirements else None
    if cut.clearance_m > 0 and not obstacles and usable:
        blockers += (
            "a clearance is asked for, but neither a keep-out box nor a mapped surface is known to keep it from",
        )
    verdict, headline = _verdict(cut, required, tool_only, requirements, blockers, probability)
    return Decision(
        cut=cut,
        verdict=verdict,
        headline=headline,
        probability=probability,
        required=required,
        tool_only=tool_only,
        requirements=requirements,
        blockers=blockers,
        margin=_margin(cut, point, obstacles, required) if point is not None and usable else None,
        expires_ns=None if last is None else last + age_limit_ns,
        notes=_notes(cut, point, obstacles),
    )


def tolerance_probability(cut: Cut, covariance_m2: Float, axis: Float | None) -> float:
    """P(the cut stays within its tolerance) for the measurement's covariance, shape (3, 3), the tool added here.

    Both faces of the cut have to stay within the tolerance along the axis, so half the blade's width is taken off.
    Where no axis is known, the ball that fits into the region in every direction takes the region's place.
    """
    along, across = along_room_m(cut), cut.tolerance_across_m
    total = covariance_m2 + cut.tool_sigma_m**2 * np.eye(3)
    if along <= 0:
        return 0.0
    if not total.any():
        return 1.0
    if axis is None:
        return ball_probability(total, min(along, across))
    return cylinder_probability(total, axis, along, across)


def along_room_m(cut: Cut) -> float:
    """What the blade's width leaves of the tolerance along the axis [m]."""
    return cut.tolerance_along_m - cut.blade_width_m / 2


def percent(probability: float) -> str:
    """A probability as a reader may rely on it: cut off, never rounded up, never 100 %."""
    if probability >= 0.99995:
        return "above 99.99 %"
    if probability < 0.0001:
        return "below 0.01 %"
    digits = 2 if probability > 0.99 or probability < 0.01 else 1
    step = 10.0 ** (digits + 2)
    return f"{np.floor(probability * step + 1e-9) / step * 100:.{digits}f} %"


def _verdict(
    cut: Cut,
    required: float,
    tool_only: float,
    requirements: tuple[Requirement, ...],
    blockers: tuple[str, ...],
    probability: float | None,
) -> tuple[Verdict, str]:
    if tool_only < required:
        return "NO-GO", (
            f"Do not cut {cut.point}: tool and robot alone hold the tolerance with {percent(tool_only)} only, "
            f"{percent(required)} is required. No measurement mends that."
        )
    if blockers:
        more = "" if len(blockers) == 1 else f" ({len(blockers) - 1} more below)"
        return "MEASURE MORE", f"Do not cut {cut.point} yet: {blockers[0]}{more}."
    forbidden = next((r for r in requirements if r.possible < cut.wrong_go_probability), None)
    if forbidden is not None:
        return "NO-GO", (
            f"Do not cut {cut.point} here: {forbidden.text}. The chance that a better measurement would permit it is "
            f"{percent(forbidden.possible)}."
        )
    assert probability is not None
    if probability >= required:
        return "GO", (
            f"Cut {cut.point}: the cut stays within its limits with a probability of {percent(probability)}, "
            f"{percent(required)} is required."
        )
    worst = min(requirements, key=lambda r: r.probability)
    return "MEASURE MORE", (
        f"Do not cut {cut.point} yet: the cut stays within its limits with a probability of {percent(probability)} "
        f"only, {percent(required)} is required. What fails first is the {worst.name}."
    )


def _blockers(
    cut: Cut, point: PointEstimate | None, result: Result, validated: ValidatedRange | None
) -> tuple[str, ...]:
    if point is None:
        return (f"the recording holds no pick of {cut.point}",)
    found: list[str] = []
    fault = _covariance_fault(point)
    if fault:
        found.append(fault)
    if not result.consistency.passed:
        reasons = result.consistency.reasons
        found.append(f"the data contradict the model ({reasons[0] if reasons else 'consistency check failed'})")
    found += [
        f"the record holds an error ({event.text.rstrip('.')})" for event in result.events if event.severity == "error"
    ]
    found += _trust_expired(cut, result)
    newest = _newest_station(result)
    if newest is not None and re.fullmatch(r"b\d+", point.frame) and point.frame != newest:
        found.append(
            f"the machine has been moved since: {point.id} is given in {point.frame}, it now stands at {newest}"
        )
    if validated is None:
        found.append("the stated uncertainty has not been validated against truth (no validated range is installed)")
    else:
        found += validated.outside(result, point)
    return tuple(found)


def _newest_station(result: Result) -> str | None:
    """The last of the stations `b0`, `b1`, ... where the machine has been moved."""
    numbers = [int(pose.name[1:]) for pose in result.poses if re.fullmatch(r"b\d+", pose.name)]
    return f"b{max(numbers)}" if numbers else None


def _trust_expired(cut: Cut, result: Result) -> list[str]:
    if result.last_board_view_ns is None:
        return ["no board was seen, so nothing ties the camera to the machine"]
    age_s = (result.end_ns - result.last_board_view_ns) * 1e-9
    if age_s <= cut.board_age_limit_s:
        return []
    limit = f"{cut.board_age_limit_s:.4g} s"
    return [f"the board was last seen {age_s:.0f} s before the end, trust in its place expires after {limit}"]


def _covariance_fault(point: PointEstimate) -> str | None:
    covariance = point.covariance_m2
    if not (np.isfinite(covariance).all() and np.isfinite(point.position_m).all()):
        return f"the estimate of {point.id} holds numbers that are not finite"
    values = np.linalg.eigvalsh((covariance + covariance.T) / 2)
    if np.abs(covariance - covariance.T).max() > 1e-6 * np.abs(covariance).max():
        return f"the covariance of {point.id} is not symmetric"
    if values[0] <= SINGULAR * values[-1] or values[-1] <= 0:
        return f"the covariance of {point.id} is singular: one direction was never measured or is claimed to be exact"
    if point.axis is not None and _axis(point) is None:
        return f"the axis of the pipe at {point.id} is no direction"
    return None


def _obstacles(cut: Cut, point: PointEstimate, result: Result) -> tuple[Obstacle, ...]:
    own = _own_pipe(point, result)
    disc = SweptDisc(point.position_m, _axis(point), own.radius_m if own else 0.0, cut.blade_width_m / 2)
    found: list[Obstacle] = []
    for index, box in enumerate(cut.keep_out):
        gap, direction = box_gap(disc, np.array(box.minimum_m), np.array(box.maximum_m))
        found.append(Obstacle(f"keep-out box {index + 1}", gap, direction, 0.0))
    for pipe in result.pipes:
        if pipe is not own and pipe.frame == point.frame:
            gap, direction = pipe_gap(disc, pipe.point_m, pipe.axis, pipe.radius_m)
            # Place and radius may err together: their deviations add.
            sigma = np.sqrt(direction @ pipe.covariance[:3, :3] @ direction) + np.sqrt(pipe.covariance[6, 6])
            found.append(Obstacle(f"pipe {pipe.id}", gap, direction, float(sigma)))
    surface = point.nearest_surface
    if surface is not None:
        gap = surface.distance_m - float(disc.reach(surface.direction[None])[0])
        found.append(Obstacle(surface.what, gap, surface.direction, surface.sigma_m, includes_point=True))
    return tuple(found)


def _axis(point: PointEstimate) -> Float | None:
    """The pipe's direction at the point, unit length; None where it is unknown or no direction."""
    axis = point.axis
    if axis is None or not np.isfinite(axis).all() or abs(np.linalg.norm(axis) - 1) > 1e-3:
        return None
    return axis / np.linalg.norm(axis)


def _own_pipe(point: PointEstimate, result: Result) -> PipeEstimate | None:
    """The pipe that the point names; where it names none, the pipe that it lies in."""
    for pipe in result.pipes:
        if pipe.id == point.pipe_id:
            return pipe
        apart = np.linalg.norm(np.cross(point.position_m - pipe.point_m, pipe.axis))
        if point.pipe_id is None and pipe.frame == point.frame and apart < pipe.radius_m:
            return pipe
    return None


def _requirements(cut: Cut, point: PointEstimate, obstacles: tuple[Obstacle, ...]) -> tuple[Requirement, ...]:
    along, across = along_room_m(cut) * 1e3, cut.tolerance_across_m * 1e3
    tolerance = Requirement(
        name="tolerance",
        probability=tolerance_probability(cut, point.covariance_m2, point.axis),
        possible=1.0,
        text=f"cut within ±{along:.3g} mm along and {across:.3g} mm across the axis",
    )
    return (tolerance, *(_clearance(cut, point.covariance_m2, obstacle) for obstacle in obstacles))


def _clearance(cut: Cut, covariance_m2: Float, obstacle: Obstacle) -> Requirement:
    """One-sided: the gap less the demanded clearance against its standard deviation along the shortest way.

    The point's and the obstacle's errors may be correlated in a way that the result does not tell: deviations add.
    """
    measured = _obstacle_sigma(covariance_m2, obstacle)
    spare = obstacle.gap_m - cut.clearance_m
    # A perfect measurement permits the place where it still leaves the tool's own guard band.
    guard = float(ndtri(1 - cut.wrong_go_probability)) * cut.tool_sigma_m
    gap = f"{obstacle.gap_m * 1e3:.1f} mm" if obstacle.gap_m >= 0 else f"{-obstacle.gap_m * 1e3:.1f} mm inside"
    return Requirement(
        name=f"clearance to {obstacle.name}",
        probability=_phi(spare, float(np.hypot(measured, cut.tool_sigma_m))),
        possible=_phi(spare - guard, measured),
        text=f"blade to {obstacle.name}: {gap}, {cut.clearance_m * 1e3:.3g} mm demanded",
    )


def _obstacle_sigma(covariance_m2: Float, obstacle: Obstacle) -> float:
    own = float(np.sqrt(obstacle.direction @ covariance_m2 @ obstacle.direction))
    return max(own, obstacle.sigma_m) if obstacle.includes_point else own + obstacle.sigma_m


def _phi(distance: float, sigma: float) -> float:
    if sigma == 0:
        return 1.0 if distance >= 0 else 0.0
    return float(ndtr(distance / sigma))


def _all_hold(requirements: tuple[Requirement, ...]) -> float:
    return max(0.0, 1.0 - sum(1.0 - r.probability for r in requirements))


def _margin(cut: Cut, point: PointEstimate, obstacles: tuple[Obstacle, ...], required: float) -> float | None:
    """Bisection over the logarithm of the factor; the probability falls as the factor grows."""

    def holds(logarithm: float) -> bool:
        covariance = np.exp(2 * logarithm) * point.covariance_m2
        rows = (_clearance(cut, covariance, obstacle).probability for obstacle in obstacles)
        return tolerance_probability(cut, covariance, point.axis) - sum(1 - row for row in rows) >= required

    low, high = np.log(SCALES)
    if not holds(low) or holds(high):
        return None
    while high - low > 1e-4:
        middle = (low + high) / 2
        low, high = (middle, high) if holds(middle) else (low, middle)
    return float(np.exp(low))


def _notes(cut: Cut, point: PointEstimate | None, obstacles: tuple[Obstacle, ...]) -> tuple[str, ...]:
    notes: list[str] = []
    if point is not None and point.axis is None:
        notes.append("No axis is known here: the tolerance is the ball that fits into the region in every direction.")
    if cut.clearance_m > 0 and obstacles and not any(not o.name.startswith("keep-out") for o in obstacles):
        notes.append("The clearance is checked against the keep-out boxes; the map names no other surface nearby.")
    return tuple(notes)
