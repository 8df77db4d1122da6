"""The streaming process end to end on the sample recording: the offline numbers, and memory after `kill -9`."""

import json
import signal
import subprocess
from pathlib import Path

import numpy as np
import pytest
from stream_process import free_port, lines, started

from surecut.estimator.items import wanted_topics
from surecut.estimator.optimise import rig_of
from surecut.estimator.pipeline import Pipeline
from surecut.estimator.points_in_base import point_blocks
from surecut.estimator.sensing import Sensing
from surecut.estimator.stream.memory import MemoryFileError, from_json, load
from surecut.factors import keys
from surecut.io.reader import LogReader

SAMPLE = Path(__file__).parents[1] / "logs" / "sample.mcap"


def surecut(*arguments):
    return started(*arguments, stdout=subprocess.PIPE, stderr=subprocess.PIPE)


@pytest.fixture(scope="module")
def offline():
    """The causal result: what the same loop says after the last message, without the batch refinement."""
    with LogReader(SAMPLE) as reader:
        rig = rig_of(reader, None)
    pipeline = Pipeline(rig)
    for _ in pipeline.run(Sensing(rig).run(LogReader(SAMPLE, wanted_topics(rig)))):
        pass
    pipeline.complete()
    engine = pipeline.engine
    engine.state.values = engine.solver.settle(10)
    found = {}
    for point in engine.pipes.points.values():
        position, blocks = point_blocks(engine.state.values, keys.base(0), keys.point(point.index))
        joint = engine.solver.joint_covariance([key for key, _ in blocks])
        jacobian = np.hstack([block for _, block in blocks])
        found[point.id] = position, np.sqrt(np.diag(jacobian @ joint @ jacobian.T))
    return found


@pytest.fixture(scope="module")
def streamed(tmp_path_factory):
    folder = tmp_path_factory.mktemp("stream")
    process = surecut(
        "--replay", SAMPLE, "--rate", "max", "--json", folder / "live.json",
        "--checkpoint", folder / "memory.json", "--record", folder / "live.mcap",
    )  # fmt: skip
    _, errors = process.communicate(timeout=300)
    assert process.returncode == 0, errors.decode()
    return folder


def test_replay_gives_the_offline_numbers(offline, streamed):
    result = json.loads((streamed / "live.json").read_text())
    points = {point["id"]: point for point in result["points"]}
    assert points.keys() == offline.keys()
    assert points
    for name, (position, sigma) in offline.items():
        off = np.abs(np.array(points[name]["position_m"]) - position)
        assert (off < 0.1 * sigma).all(), (name, off / sigma)
        own = np.sqrt(np.diag(np.array(points[name]["covariance_m2"])))
        assert (own > 0.97 * sigma).all()  # correlated tracks may widen it
        assert (own < 2.1 * sigma).all()
    assert result["counters"]["queue_dropped"] == 0
    assert result["counters"]["graph_frames"] == result["counters"]["order_paired"]


def test_recording_holds_the_points(streamed):
    with LogReader(streamed / "live.mcap") as reader:
        topics = {message.topic for message in reader}
    assert {"/estimate/points", "/estimate/pose/m", "/estimate/pose/b", "/tf"} <= topics


def test_memory_is_data_that_is_checked(streamed):
    text = (streamed / "memory.json").read_text()
    memory = load(streamed / "memory.json")
    assert np.linalg.eigvalsh(memory.prior.H).min() > -1e-6 * np.abs(memory.prior.H).max()
    assert {board["id"] for board in memory.boards if board["known"]}
    for spoilt in (text[: len(text) // 2], "[]", "{}", text.replace('"kind": "b"', '"kind": "x"')):
        with pytest.raises(MemoryFileError):
            from_json(spoilt)


def first_line(port, seconds, wanted=lambda update: update["points"]):
    """The first JSON line that has what is wanted; by itself, one that says where the points are."""
    for update in lines(port, seconds):
        if wanted(update):
            return update
    raise AssertionError(f"no such line within {seconds} s")


def test_answer_is_back_after_kill(streamed, offline, tmp_path):
    memory = tmp_path / "memory.json"
    memory.write_bytes((streamed / "memory.json").read_bytes())
    port = free_port()
    process = surecut("--replay", SAMPLE, "--rate", 1, "--tcp", port, "--checkpoint", memory)
    try:
        update = first_line(port, 60)
        for point in update["points"]:
            position, sigma = offline[point["id"]]
            assert (np.abs(np.array(point["position_m"]) - position) < 0.5 * sigma).all()
            assert point["verdict"] != "GO"
        found = first_line(port, 60, lambda update: "m" in update["poses"])
        assert "relocalising" not in {fault["name"] for fault in found["health"]["faults"]}
        joint = np.array(found["points_covariance_m2"])
        for i, point in enumerate(found["points"]):
            own = joint[3 * i : 3 * i + 3, 3 * i : 3 * i + 3]
            np.testing.assert_allclose(own, point["covariance_m2"], rtol=1e-6, atol=1e-12)
        assert np.linalg.eigvalsh(joint).min() > 0
        assert np.abs(joint[:3, 3:6]).max() > 0  # they share the machine
        begun, now = (np.array(line["poses"]["b"]["matrix"]) for line in (update, found))
        np.testing.assert_allclose(now, begun, atol=0.02)  # the same {o}
        process.send_signal(signal.SIGKILL)
        process.wait(10)
        assert load(memory).keyframes > 0  # whole, whatever it was doing
    finally:
        process.kill()
        process.communicate()
