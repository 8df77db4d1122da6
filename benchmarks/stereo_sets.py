"""GTSAM's own stereo sets through the project's solvers and through plain GTSAM: robust error and CPU seconds.

python benchmarks/stereo_sets.py [large] [00]
"""

import sys
import time

import gtsam

from surecut.estimator.graph import FactorLog, Update
from surecut.estimator.incremental import Incremental
from surecut.estimator.newton import optimum
from surecut.factors.errors import SurecutError
from surecut.simulation.stereo_sets import SETS, load, updates


def frame_by_frame(steps: list[Update]) -> gtsam.Values:
    """The running solver's estimate after the last frame."""
    solver = Incremental()
    for update in steps:
        solver.update(update)
    return solver.settle(20)


def main() -> int:
    """Prints a table per set."""
    for name in sys.argv[1:] or list(SETS):
        steps = list(updates(load(name)))
        log, starts = FactorLog(), gtsam.Values()
        for update in steps:
            log.append(update)
            starts.insert(update.values)
        graph = log.graph()
        print(f"{name}: {len(steps)} frames, {graph.size()} factors, start {graph.error(starts):.1f}")
        for what, solve in (
            ("plain GTSAM, LM", lambda g=graph, v=starts: gtsam.LevenbergMarquardtOptimizer(g, v).optimize()),
            ("in batch", lambda g=graph, v=starts: optimum(g, v)[0]),
            ("frame by frame (iSAM2)", lambda s=steps: frame_by_frame(s)),
        ):
            begin = time.process_time()
            try:
                error = f"{graph.error(solve()):10.2f}"
            except (SurecutError, RuntimeError) as refused:
                error = f"no answer: {str(refused).strip().splitlines()[0]}"
            print(f"  {what:24s} {error} {time.process_time() - begin:8.2f} s", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
