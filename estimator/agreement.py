"""Independent ways to the same thing, compared: what the Kinect's cloud says about a pipe, and what all else says."""

import gtsam
import numpy as np
from numpy.typing import NDArray

from .consistency import PriorTest
from .correlation import Active
from .depth_pipes import DepthPipes, SeenCylinder
from .graph import Record
from .linear import LinearSystem, deviate

Float = NDArray[np.float64]


def cylinder_tests(pipes: DepthPipes, active: Active, system: LinearSystem, values: gtsam.Values) -> list[PriorTest]:
    """Every pipe in the Kinect's cloud against what everything else says about it, in sigmas.

    Also of cylinders that were kept out of the graph: theirs is the disagreement that a user has to know.
    """
    inside = {record.what: position for position, (_, _, record) in enumerate(active)}
    return [_test(seen, inside.get(seen.what), system, values) for seen in pipes.seen.values()]


def _test(seen: SeenCylinder, position: int | None, system: LinearSystem, values: gtsam.Values) -> PriorTest:
    record = Record("pipe cylinder", seen.what, seen.sighting.stamp_ns, seen.what)
    linear = seen.factor().linearize(values)
    residual = -linear.jacobian()[1]
    if position is not None:
        total, dof = system.standardised([position])[0]
        return PriorTest(record, total, dof, deviate(total, dof), residual)
    J, column, blocks = linear.jacobian()[0], 0, []
    for key in linear.keys():
        width = system.columns[key].stop - system.columns[key].start
        blocks.append((key, J[:, column : column + width]))
        column += width
    spread = np.eye(len(residual)) + system.covariance(blocks)
    total = float(residual @ np.linalg.solve(spread, residual))
    return PriorTest(record, total, len(residual), deviate(total, len(residual)), residual)
