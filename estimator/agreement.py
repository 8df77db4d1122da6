"""Independent ways to the same thing, compared: what the Kinect's cloud says about a pipe, and what all else says."""

from collections.abc import Mapping

import gtsam
import numpy as np
from numpy.typing import NDArray

from ..factors.measurements import Event
from .consistency import PriorTest
from .correlation import Active
from .depth_pipes import DepthPipes, SeenCylinder
from .graph import Record
from .linear import LinearSystem, deviate
from .surfaces import FAMILY as CLOUD

Float = NDArray[np.float64]

TOLD_SIGMA = 3.0
ERROR_SIGMA = 3.9
"""Beyond it (1 in 10 000 by chance) the contradiction has to be settled before anybody cuts."""


def cylinder_tests(pipes: DepthPipes, active: Active, system: LinearSystem, values: gtsam.Values) -> list[PriorTest]:
    """Every pipe in the Kinect's cloud against what everything else says about it, in sigmas.

    Also of cylinders that were kept out of the graph: theirs is the disagreement that a user has to know.
    """
    inside = {record.what: position for position, (_, _, record) in enumerate(active)}
    return [cylinder_test(seen, inside.get(seen.what), system, values) for seen in pipes.seen.values()]


def cylinder_test(seen: SeenCylinder, position: int | None, system: LinearSystem, values: gtsam.Values) -> PriorTest:
    """A cylinder against what a system says about it; `position` is its factor's there, None where it has none."""
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


def cylinder_event(test: PriorTest) -> Event | None:
    """What a user has to know of a pipe that the cameras see in different places; None where they agree."""
    if test.sigma < TOLD_SIGMA:
        return None
    text = (
        f"{test.record.what} lies {test.sigma:.1f} sigma from where the mobile camera, boards and mount put it: the "
        "mount is wrong, the Kinect or a board has been moved, or it is another pipe"
    )
    severity = "error" if test.sigma > ERROR_SIGMA else "warning"
    return Event(test.record.stamp_ns, "pipe_disagrees", text, severity, {"sigma": test.sigma})


def cloud_event(without: Mapping[tuple[str, str], float], stamp_ns: int) -> Event | None:
    """What a user has to know where points lie elsewhere by the Kinect's cloud than by boards and mount alone.

    Args:
        without: sigmas by point and family left out, see `without_families`.
    """
    moved = {point: sigma for (point, family), sigma in without.items() if family == CLOUD}
    worst = max(moved, key=lambda point: moved[point], default="")
    if not worst or moved[worst] < TOLD_SIGMA:
        return None
    text = (
        f"by the Kinect's cloud {worst} lies {moved[worst]:.1f} sigma from where boards and mount put it: the mount is "
        "wrong, or the Kinect or a board has been moved; measure the mount again"
    )
    severity = "error" if moved[worst] > ERROR_SIGMA else "warning"
    return Event(stamp_ns, "cloud_disagrees", text, severity, {"sigma": moved[worst]})
