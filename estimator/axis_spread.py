"""How well a pipe's axis is known across a view: what its outline may be looked for with."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..factors import keys
from ..factors.errors import ObservabilityError
from .engine import Engine

Float = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class AxisSpread:
    """Two points of an axis in {o}, and how wrong they may be."""

    start: Float
    """Shape (3,), m."""
    end: Float
    covariance: Float
    """Joint, shape (6, 6), start first, m^2."""

    def across(self, o_p_camera: Float, part: tuple[Float, Float]) -> tuple[float, float]:
        """Standard deviations of the axis's place (m) and direction (rad) across the plane of camera and axis.

        Args:
            o_p_camera: Shape (3,), the camera's place in {o}, m.
            part: ends of the part of the axis that is looked at, shape (3,) each; its middle counts.
        """
        middle = 0.5 * (part[0] + part[1])
        normal = np.cross(self.end - self.start, middle - o_p_camera)
        normal /= max(float(np.linalg.norm(normal)), 1e-12)
        place, turn = self._at(middle)
        return float(np.sqrt(max(normal @ place @ normal, 0.0))), float(np.sqrt(max(normal @ turn @ normal, 0.0)))

    def worst(self, part: tuple[Float, Float]) -> tuple[float, float]:
        """The same from the side from which least is known."""
        span = self.end - self.start
        away = np.eye(3) - np.outer(span, span) / float(span @ span)
        place, turn = (float(np.linalg.eigvalsh(away @ c @ away)[-1]) for c in self._at(0.5 * (part[0] + part[1])))
        return float(np.sqrt(max(place, 0.0))), float(np.sqrt(max(turn, 0.0)))

    def _at(self, middle: Float) -> tuple[Float, Float]:
        """Covariances (3, 3) of the axis's place (m^2) nearest to a point, and of its unit direction."""
        span = self.end - self.start
        share = float((middle - self.start) @ span) / float(span @ span)
        place = np.hstack([(1.0 - share) * np.eye(3), share * np.eye(3)])
        turn = np.hstack([-np.eye(3), np.eye(3)]) / float(np.linalg.norm(span))
        return place @ self.covariance @ place.T, turn @ self.covariance @ turn.T


def axis_spread(engine: Engine, pipe: str) -> AxisSpread | None:
    """Of a pipe that has an axis, by the joint of all that is in the graph; None where that does not determine it."""
    index = engine.pipes.cylinders[pipe].index
    start, end = keys.axis_start(index), keys.axis_end(index)
    try:
        covariance = engine.graph.joint_covariance([start, end])
    except ObservabilityError:
        return None
    return AxisSpread(engine.state.point(start), engine.state.point(end), covariance)
