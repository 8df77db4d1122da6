"""The estimator as campaigns call it: one place that knows how measurements that are at hand become a result."""

from ..estimator.bundle import bundles
from ..estimator.engine import Engine
from ..estimator.result import Result
from ..estimator.run import finish
from ..estimator.surfaces import lay_on_surfaces
from .measurement_level import Run


def estimate_run(run: Run, advises: bool = False) -> Result:
    """The estimate of a drawn run; raises SurecutError where the measurements determine nothing.

    Args:
        run: what was drawn.
        advises: the result also tells what to measure next, which takes a fifth of the time.
    """
    engine = Engine(run.rig, run.cameras, lay_on_surfaces, advises)
    for bundle in bundles(list(run.measurements)):
        engine.add(bundle)
    return finish(engine)
