"""GTSAM's own stereo sets through the project's solvers and through plain GTSAM: robust error and CPU seconds.

python benchmarks/stereo_sets.py [large] [00]
"""

import sys
import time

import gtsam

from surecut.estimator.batch import optimum
from surecut.estimator.incremental import Incremental
from surecut.simulation.stereo_sets import SETS, load, updates


def main() -> int:
    """Prints a table per set."""
    for name in sys.argv[1:] or list(SETS):
        data, solver, starts = load(name), Incremental(), gtsam.Values()
        begin, slowest = time.process_time(), 0.0
        for update in updates(data):
            before = time.process_time()
            solver.update(update)
            slowest = max(slowest, time.process_time() - before)
            starts.insert(update.values)
        graph = solver.log.graph()
        running = solver.settle(20)
        rows = [("frame by frame (iSAM2)", graph.error(running), time.process_time() - begin)]
        begin = time.process_time()
        rows.append(("then in batch", graph.error(optimum(graph, running)[0]), time.process_time() - begin))
        begin = time.process_time()
        rows.append(("in batch from the start", graph.error(optimum(graph, starts)[0]), time.process_time() - begin))
        begin = time.process_time()
        plain = gtsam.LevenbergMarquardtOptimizer(graph, starts).optimize()
        rows.append(("plain GTSAM, LM", graph.error(plain), time.process_time() - begin))
        print(f"{name}: {len(data.poses)} frames, {graph.size()} factors, start {graph.error(starts):.1f}")
        for what, error, seconds in rows:
            print(f"  {what:26s} {error:10.2f} {seconds:8.2f} s")
        print(f"  slowest frame {1e3 * slowest:.0f} ms")
    return 0


if __name__ == "__main__":
    sys.exit(main())
