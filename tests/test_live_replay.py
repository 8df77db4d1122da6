"""A recording as if it were live: everything once, in the order and at the pace of the log."""

from pathlib import Path

import logmaker
import pytest
from live_helpers import Collector, wait_for

from surecut.factors.errors import LogError
from surecut.io.live.replay import Replay
from surecut.io.reader import LogReader


@pytest.fixture(scope="module")
def log(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("logs") / "log.mcap"
    logmaker.write_log(path, 10)
    return path


class Time:
    """A clock that only moves when somebody sleeps."""

    def __init__(self) -> None:
        self.now_ns = 5_000_000_000
        self.slept: list[float] = []

    def monotonic_ns(self) -> int:
        return self.now_ns

    def sleep(self, seconds: float) -> None:
        self.slept.append(seconds)
        self.now_ns += round(seconds * 1e9)


def play(replay: Replay) -> Collector:
    found = Collector()
    replay.start(found)
    wait_for(replay.ended)
    replay.stop()
    return found


def test_as_fast_as_possible_gives_what_reading_gives(log: Path):
    replay = Replay(log, None)
    found = play(replay)
    expected = list(LogReader(log))
    assert [(m.topic, m.stamp_ns, m.log_time_ns) for m in found.messages] == [
        (m.topic, m.stamp_ns, m.log_time_ns) for m in expected
    ]
    assert replay.patient
    assert replay.counters() == {"received": 180, "delivered": 180}


@pytest.mark.parametrize("rate", [1.0, 4.0])
def test_the_pace_is_that_of_the_log(log: Path, rate: float):
    time = Time()
    found = play(Replay(log, rate, {"/picks"}, monotonic_ns=time.monotonic_ns, sleep=time.sleep))
    assert found.topics() == {"/picks": 10}
    # ten moments, 50 ms apart
    assert time.slept == pytest.approx([0.05 / rate] * 9, abs=1e-6)


def test_a_slow_receiver_is_caught_up_with_not_waited_for(log: Path):
    time = Time()

    def late(_):
        time.now_ns += 200_000_000

    replay = Replay(log, 1.0, {"/picks"}, monotonic_ns=time.monotonic_ns, sleep=time.sleep)
    replay.start(late)
    wait_for(replay.ended)
    assert time.slept == []
    assert not replay.patient


def test_repetitions_continue_the_stamps(log: Path):
    stamps = [m.stamp_ns for m in play(Replay(log, None, {"/picks"}, repeat=3)).messages]
    assert len(stamps) == 30
    assert stamps == sorted(set(stamps))
    assert stamps[10] - stamps[9] == 100_000_000


def test_stopping_ends_it_in_the_middle(log: Path):
    found = Collector()
    replay = Replay(log, 0.01)
    replay.start(found)
    wait_for(lambda: found.messages)
    replay.stop()
    count = len(found.messages)
    assert replay.ended()
    assert 0 < count < 180
    replay.stop()
    assert len(found.messages) == count


def test_what_cannot_be_played_is_told_at_once(tmp_path: Path, log: Path):
    with pytest.raises(LogError, match="cannot be read"):
        Replay(tmp_path / "no.mcap").start(print)
    (tmp_path / "text.mcap").write_text("no log at all")
    with pytest.raises(LogError, match="not an MCAP"):
        Replay(tmp_path / "text.mcap").start(print)
    with pytest.raises(LogError, match="not positive"):
        Replay(log, 0.0).start(print)
    with pytest.raises(LogError, match="no message"):
        Replay(log, 1.0, {"/absent"}).start(print)


def test_a_cut_log_is_played_to_where_it_goes(tmp_path: Path, log: Path):
    path = tmp_path / "cut.mcap"
    logmaker.write_log(path, 10, chunk_size=None)
    path.write_bytes(path.read_bytes()[:40_000])
    replay = Replay(path, None)
    assert play(replay).messages
    assert "cut off" in replay.status()
