"""The estimator as campaigns call it: one place that knows how measurements that are at hand become a result."""

from ..estimator.result import Result
from ..estimator.run import estimate
from .measurement_level import Run
from .measurement_level_association import nearest_plane


def estimate_run(run: Run) -> Result:
    """The estimate of a drawn run; raises SurecutError where the measurements determine nothing."""
    return estimate(run.measurements, run.rig, run.cameras, nearest_plane)
