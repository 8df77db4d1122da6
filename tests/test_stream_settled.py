"""The running answer is at its optimum, also while pipe and points have only begun, from rough guesses."""

from pathlib import Path

import gtsam
import numpy as np

from surecut.estimator.engine import Engine
from surecut.estimator.items import wanted_topics
from surecut.estimator.optimise import rig_of
from surecut.estimator.sensing import Sensing
from surecut.estimator.stream.graph_loop import GraphLoop
from surecut.estimator.stream.settings import StreamSettings
from surecut.estimator.stream.settled import SETTLED_SIGMA
from surecut.estimator.stream.wire import Answer
from surecut.factors import keys
from surecut.io.reader import LogReader

SAMPLE = Path(__file__).parents[1] / "logs" / "sample.mcap"


def converged(engine: Engine) -> gtsam.Values:
    values = engine.solver.values()
    for _ in range(8):
        values = engine.solver.stepped(values)
    return values


def test_answers_have_settled():
    """Each point of each answer, against the optimum of what is known at that moment."""
    with LogReader(SAMPLE) as reader:
        rig = rig_of(reader, None)
    off: list[float] = []

    def tell(answer: Answer) -> None:
        if not answer.points:
            return
        values = converged(loop.engine)
        o_T_b = values.atPose3(keys.base(0))
        for point in answer.points:
            place = o_T_b.transformTo(values.atPoint3(keys.point(loop.engine.pipes.points[point.id].index)))
            sigma = np.sqrt(np.diag(point.covariance_m2))
            off.append(float(np.abs((point.position_m - place) / sigma).max()))

    loop = GraphLoop(rig, StreamSettings(), tell)
    for sensed in Sensing(rig).run(LogReader(SAMPLE, wanted_topics(rig))):
        loop.take(sensed)
    assert len(off) > 10
    assert loop.counts["settling_steps"] > 0
    assert max(off) < SETTLED_SIGMA
