"""The estimator as campaigns call it: one place that knows how measurements that are at hand become a result."""

from ..estimator.result import Result
from ..estimator.run import estimate
from ..estimator.surfaces import lay_on_surfaces
from .measurement_level import Run


def estimate_run(run: Run) -> Result:
    """The estimate of a drawn run; raises SurecutError where the measurements determine nothing."""
    return estimate(run.measurements, run.rig, run.cameras, lay_on_surfaces)
