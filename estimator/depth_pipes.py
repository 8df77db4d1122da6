"""Pipes in the Kinect's cloud: where to look for them, and what was found as one summarised factor per station."""

from dataclasses import dataclass, replace

import gtsam
import numpy as np
from numpy.typing import NDArray

from ..factors import keys
from ..factors.cloud import corrected, depth_moves
from ..factors.measurements import CylinderSighting, Rejection
from ..factors.noise import gaussian, robust
from ..factors.pipe import cylinder_covariance, cylinder_factor
from ..factors.rig import Rig
from ..frontends.pipe.depth_cylinder import PredictedPipe
from .graph import Record, State, Update
from .incremental import Incremental
from .linear import deviate
from .pipes import Pipes

Float = NDArray[np.float64]

FAMILY = "pipe cylinder"
HALF_LENGTH_M = 0.4
"""A pipe is taken to go on so far beyond its picks; what does not is left out by the fit."""
MOST_SIGMA_M = 0.04
"""A pipe known worse than this is not looked for: the search would reach its neighbours."""
GATE_SIGMA = 6.0
"""A cylinder farther off the predicted one is another thing, or {b} is wrong: it stays out, and is told."""


@dataclass(frozen=True, slots=True)
class SeenCylinder:
    """A pipe in the cloud of a station."""

    sighting: CylinderSighting
    pipe: int
    base: int
    entered: bool
    """False: too far from the prediction to enter the graph."""

    @property
    def what(self) -> str:
        return f"{self.sighting.pipe_id} in the Kinect's cloud"

    def factor(self) -> gtsam.CustomFactor:
        """Without robust loss."""
        model = gaussian(cylinder_covariance(self.sighting))
        return cylinder_factor(self.sighting, model, self.base, self.pipe)


class DepthPipes:
    """All pipes that the Kinect saw."""

    def __init__(self, rig: Rig, state: State, pipes: Pipes) -> None:
        self._rig = rig
        self._state = state
        self._pipes = pipes
        self.seen: dict[tuple[str, int], SeenCylinder] = {}
        """By pipe and key of the station's `o_T_b`."""
        self.remembered: set[tuple[str, int]] = set()
        """Those that an earlier run has seen: what they said is in its memory."""
        self.refused: dict[tuple[str, int], Rejection] = {}
        """Why a pipe was not found in the last cloud that was searched."""

    def wanted(self, base: int) -> list[str]:
        """Pipes that are known, and that no cloud of a station has shown so far."""
        return [
            name
            for name in self._pipes.cylinders
            if self._pipes.axis(name) is not None
            and (name, base) not in self.remembered
            and not ((name, base) in self.seen and self.seen[name, base].entered)
            and self._state.has(base)
            and self._state.has(keys.DEPTH)
        ]

    def place(self, pipe: str, base: int) -> PredictedPipe | None:
        """Where a pipe is in {b}, as the Kinect measures it, as unsure as may be; None where no pipe can be seen."""
        axis, places = self._pipes.axis(pipe), self._pipes.places(pipe)
        if axis is None:
            return None
        start, end, radius = axis
        direction = (end - start) / np.linalg.norm(end - start)
        along = [float((p - start) @ direction) for p in places] or [0.5 * float(np.linalg.norm(end - start))]
        o_T_b = self._state.pose(base)
        offset, scale = self._state.vector(keys.DEPTH)
        ends = []
        for place in (min(along) - HALF_LENGTH_M, max(along) + HALF_LENGTH_M):
            b_p = o_T_b.transformTo(start + place * direction)
            if b_p[2] < 0.2:
                return None
            ends.append(corrected(b_p[None], -offset, -scale, -self._state.vector(keys.DEPTH_RAYS))[0])
        return PredictedPipe(ends[0], ends[1], radius, MOST_SIGMA_M)

    def narrowed(self, placed: PredictedPipe, pipe: str, base: int, solver: Incremental) -> PredictedPipe | None:
        """The same with the sigma that the state's covariance gives; None while its place is hardly known."""
        spread = self._spread(placed, self._pipes.cylinders[pipe].index, base, solver)
        sigma = float(np.sqrt(max(np.linalg.eigvalsh(spread[i : i + 2, i : i + 2])[-1] for i in (0, 2))))
        return replace(placed, sigma_m=sigma) if sigma < MOST_SIGMA_M else None

    def _spread(self, predicted: PredictedPipe, index: int, base: int, solver: Incremental) -> Float:
        """Covariance (5, 5) of what `cylinder_factor` compares, from the state alone."""
        moves = depth_moves(np.stack([predicted.point_a_m, predicted.point_b_m]))
        response = np.vstack([moves[0], moves[1], np.zeros((1, 5))])
        trial = CylinderSighting(
            0, "b_depth", "", predicted.point_a_m, predicted.point_b_m, predicted.radius_m, np.eye(7), 0, 0.0,
            "kinect_cloud", response,
        )  # fmt: skip
        factor = cylinder_factor(trial, gaussian(np.eye(5)), base, index)
        return predicted_covariance(factor, self._state.values, solver)

    def add(self, found: CylinderSighting | Rejection, pipe: str, base: int, solver: Incremental) -> Update:
        """A cylinder that was found near its predicted place, or why none was."""
        update = Update()
        if isinstance(found, Rejection):
            self.refused[pipe, base] = found
            return update
        if pipe not in self.wanted(base):
            reason = "the pipe or {b} has no place, or a cloud has shown the pipe already"
            self.refused[pipe, base] = Rejection(found.stamp_ns, FAMILY, f"{pipe} in the cloud", reason, 0.0, 1.0)
            return update
        index = self._pipes.cylinders[pipe].index
        covariance = cylinder_covariance(found)
        trial = cylinder_factor(found, gaussian(np.eye(5)), base, index)
        difference = trial.unwhitenedError(self._state.values)
        spread = predicted_covariance(trial, self._state.values, solver) + covariance
        sigma = deviate(float(difference @ np.linalg.solve(spread, difference)), 5)
        entered = sigma < GATE_SIGMA
        self.seen[pipe, base] = SeenCylinder(found, index, base, entered)
        self.refused.pop((pipe, base), None)
        what = self.seen[pipe, base].what
        if not entered:
            self.refused[pipe, base] = Rejection(
                found.stamp_ns, FAMILY, what, "off the predicted pipe by sigmas", sigma, GATE_SIGMA
            )
            return update
        model = robust(gaussian(covariance), self._rig.gates.robust_sigma)
        record = Record(FAMILY, f"Kinect's cloud of {pipe}", found.stamp_ns, what)
        update.add(cylinder_factor(found, model, base, index), record)
        return update


def predicted_covariance(factor: gtsam.CustomFactor, values: gtsam.Values, solver: Incremental) -> Float:
    """Covariance of a factor's residual from the state's alone; the factor's own noise is the unit matrix."""
    linear = factor.linearize(values)
    P = solver.joint_covariance(list(linear.keys()))
    J = linear.jacobian()[0]
    return np.asarray(J @ P @ J.T, np.float64)
