"""The running answer is at its optimum, also while pipe and points have only begun, from rough guesses."""

from pathlib import Path

from surecut.estimator.items import wanted_topics
from surecut.estimator.optimise import rig_of
from surecut.estimator.sensing import Sensing
from surecut.estimator.stream.graph_loop import SETTLED_SIGMA, GraphLoop
from surecut.estimator.stream.posterior import posterior_of
from surecut.estimator.stream.settings import StreamSettings
from surecut.io.reader import LogReader

SAMPLE = Path(__file__).parents[1] / "logs" / "sample.mcap"


def test_answers_have_settled():
    """Standard deviations by which a further Newton step would move each answer that has points."""
    with LogReader(SAMPLE) as reader:
        rig = rig_of(reader, None)
    steps: list[float] = []
    loop = GraphLoop(
        rig,
        StreamSettings(),
        lambda answer: steps.append(posterior_of(loop.engine).step_sigma) if answer.points else None,
    )
    for sensed in Sensing(rig).run(LogReader(SAMPLE, wanted_topics(rig))):
        loop.take(sensed)
    assert len(steps) > 5
    assert loop.counts["settled"] > 0  # otherwise up to 0.7
    assert all(step < SETTLED_SIGMA for step in steps)
