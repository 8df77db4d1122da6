"""A board that is knocked beside the machine, on rendered pixels: named within two seconds, moving or not."""

import pytest

from surecut.estimator.items import wanted_topics
from surecut.estimator.optimise import rig_of
from surecut.estimator.sensing import Sensed, Sensing
from surecut.estimator.stream.glances import Glance
from surecut.estimator.stream.graph_loop import GraphLoop
from surecut.estimator.stream.health import Monitor
from surecut.estimator.stream.look_process import LookLoop
from surecut.estimator.stream.settings import StreamSettings
from surecut.estimator.stream.track_process import TrackLoop
from surecut.estimator.stream.wire import Group
from surecut.io.reader import LogReader
from surecut.simulation.recording import simulate
from surecut.simulation.scenario import Scenario
from surecut.simulation.session import stamp_ns

pytestmark = pytest.mark.campaign

SCENE = {
    "name": "knocked",
    "place": "B",
    "duration_s": 24,
    "return_to_board": False,
    "mobile": {"rate_hz": 10},
    "kinect": {"rate_hz": 1, "width": 160, "height": 120, "depth_focal_px": 146.25, "rgb_focal_px": 131.25},
}
MOVING, STILL = (
    {"board": {"knock": {"at_s": 2.5}}},
    {"board": {"knock": {"at_s": 5.0}}, "timeline": {"still": [(3.2, 9)]}},
)


class Queue(list):
    put = list.append

    def qsize(self):
        return 0


def faults_over(log, until_s):
    """What the health state says with each answer: (stamp, names of faults). The processes' work, one after the other,
    as if each were done at once."""
    with LogReader(log) as reader:
        rig = rig_of(reader, None)
    settings, found = StreamSettings(), []
    tracked, looked, out = Queue(), Queue(), Queue()
    monitor = Monitor(rig, settings)

    def tell(answer):
        monitor.answered(answer)
        found.append((answer.stamp_ns, {fault.name for fault in monitor.health(0, answer.stamp_ns).faults}))

    graph = GraphLoop(rig, settings, tell)
    track = TrackLoop(rig, settings, True, tracked, out)
    look = LookLoop(rig, settings, True, looked, out)
    for group in Sensing(rig).groups(LogReader(log, wanted_topics(rig))):
        if group[0].stamp_ns > stamp_ns(until_s):
            break
        track.take(Group(group))
        while tracked:
            look.take(tracked.pop(0))
        while looked:
            item = looked.pop(0)
            if isinstance(item, Glance):
                graph.glance(item)
            elif isinstance(item, Sensed):
                graph.take(item)
    return found


@pytest.mark.parametrize("more", [MOVING, STILL], ids=["moving", "still"])
def test_knock_is_named_within_two_seconds(more, tmp_path):
    log = tmp_path / "knocked.mcap"
    simulate(log, Scenario.model_validate(SCENE | more), 3)
    at_s = more["board"]["knock"]["at_s"]
    found = faults_over(log, at_s + 4.0)
    before = [names for stamp, names in found if stamp < stamp_ns(at_s)]
    assert before
    assert not any("board_knocked" in names for names in before)
    named = [stamp for stamp, names in found if "board_knocked" in names]
    assert stamp_ns(at_s) < named[0] < stamp_ns(at_s + 2.0)
