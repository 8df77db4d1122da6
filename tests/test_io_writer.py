"""Logs that are written: whole or not at all, equal bytes for equal input, readable by others."""

import errno
import io
from pathlib import Path

import logmaker
import numpy as np
import pytest
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader

from surecut.factors.errors import LogError
from surecut.io import build, build_views
from surecut.io.rotations import matrix_from_quaternion, quaternion_from_matrix
from surecut.io.schemas import schema
from surecut.io.writer import McapSink


@pytest.mark.parametrize("compression", ["zstd", "lz4", "none"])
@pytest.mark.parametrize("chunk_size", [2000, 1 << 20, None])
def test_rosbags_reads_every_topic(tmp_path: Path, compression, chunk_size):
    log = tmp_path / "log.mcap"
    logmaker.write_log(log, compression=compression, chunk_size=chunk_size)
    counts: dict[str, int] = {}
    with AnyReader([log]) as reader:
        for connection, _, raw in reader.messages():
            message = reader.deserialize(raw, connection.msgtype)
            assert message is not None
            counts[connection.topic] = counts.get(connection.topic, 0) + 1
    assert counts == {topic: 20 for topic, _, _ in logmaker.messages(0)}


def test_equal_input_gives_equal_bytes(tmp_path: Path):
    logmaker.write_log(tmp_path / "a.mcap")
    logmaker.write_log(tmp_path / "b.mcap")
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()


def test_channel_metadata_is_rosbag2s(tmp_path: Path):
    logmaker.write_log(tmp_path / "a.mcap", 1)
    with (tmp_path / "a.mcap").open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    by_topic = {channel.topic: channel for channel in summary.channels.values()}
    # the hash that ROS 2 publishes for sensor_msgs/msg/Image
    image_hash = "RIHS01_d31d41a9a4c4bc8eae9be757b0beed306564f7526c88ea6a4588fb9582527d47"
    assert by_topic["/m/left/image_raw"].metadata["topic_type_hash"] == image_hash
    assert "durability: 1" in by_topic["/tf_static"].metadata["offered_qos_profiles"]
    assert {channel.message_encoding for channel in summary.channels.values()} == {"cdr"}
    markers = schema("apriltag_msgs/msg/AprilTagDetectionArray").type_hash
    assert markers == "RIHS01_6016bfe513a7c741ccbdbc6419ed6c4cabfe5f11271a96555fbf26565c6b9826"


def test_nothing_is_left_after_an_exception(tmp_path: Path):
    log = tmp_path / "log.mcap"
    log.write_bytes(b"before")
    with pytest.raises(ZeroDivisionError), McapSink(log) as sink:
        sink.attach("a", "text/plain", str(1 / int(sink is None)))
    assert [path.name for path in tmp_path.iterdir()] == ["log.mcap"]
    assert log.read_bytes() == b"before"


@pytest.mark.parametrize("after", [0, 100, 5000, 30000])
def test_a_full_disk_overwrites_nothing(tmp_path: Path, monkeypatch, after):
    log = tmp_path / "log.mcap"
    log.write_bytes(b"before")
    real_open = Path.open

    class Full(io.FileIO):
        left = after

        def write(self, data):
            if len(data) > self.left:
                raise OSError(errno.ENOSPC, "No space left on device")
            self.left -= len(data)
            return super().write(data)

    def small(path, mode="r", *args, **kwargs):
        return Full(path, "xb") if mode == "xb" else real_open(path, mode, *args, **kwargs)

    monkeypatch.setattr(Path, "open", small)
    with pytest.raises(LogError, match=r"log\.mcap: cannot be written \(No space left.*nothing was overwritten"):
        logmaker.write_log(log, 20, compression="none", chunk_size=1000)
    monkeypatch.undo()
    assert [path.name for path in tmp_path.iterdir()] == ["log.mcap"]
    assert log.read_bytes() == b"before"


def test_dev_full_is_told_in_one_line():
    with pytest.raises(LogError, match="No space left"), open("/dev/full", "wb", buffering=0) as full:
        logmaker.write_log(full)


def test_a_missing_folder_is_told(tmp_path: Path):
    with pytest.raises(LogError, match="No such file"):
        McapSink(tmp_path / "no" / "log.mcap")


def test_wrong_messages_are_refused(tmp_path: Path):
    with McapSink(tmp_path / "log.mcap") as sink:
        pose = build.pose_stamped(1, "o", np.eye(4))
        sink.write("/p", "geometry_msgs/msg/PoseStamped", pose, 1)
        with pytest.raises(LogError, match=r"/p holds geometry_msgs/msg/PoseStamped, not sensor_msgs"):
            sink.write("/p", "sensor_msgs/msg/Image", pose, 1)
        with pytest.raises(LogError, match="is no sensor_msgs/msg/Image"):
            sink.write("/q", "sensor_msgs/msg/Image", pose, 1)
        with pytest.raises(LogError, match="no message type a/msg/B"):
            sink.write("/r", "a/msg/B", pose, 1)


def test_images_that_do_not_fit_are_refused():
    for array, encoding in (
        (np.zeros((4, 4), np.uint16), "mono8"),
        (np.zeros((4, 4), np.uint8), "bgr8"),
        (np.zeros((4, 4), np.uint8), "nv12"),
    ):
        with pytest.raises(ValueError, match=encoding):
            build.image(0, "m", array, encoding)


def test_depth_is_millimetres_with_zero_for_none():
    depth = np.array([[1.2345, np.nan, 0.0, -1.0, 70.0, np.inf]])
    message = build.depth_image(0, "b", depth)
    assert message.data.view("<u2").tolist() == [1234, 0, 0, 0, 0, 0]


def test_baseline_stands_in_the_projection():
    message = build.camera_info(0, "m_right", logmaker.RIGHT)
    assert message.p[3] == pytest.approx(-50.0 * 0.12)
    assert not np.signbit(build.camera_info(0, "m_left", logmaker.LEFT).p).any()


def test_quaternions_match_matrices():
    rng = np.random.default_rng(1)
    for q in [*rng.normal(size=(50, 4)), [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]:
        matrix = matrix_from_quaternion(q)
        assert np.allclose(matrix @ matrix.T, np.eye(3))
        assert np.allclose(matrix_from_quaternion(quaternion_from_matrix(matrix)), matrix)
    # a quarter turn about z takes x to y
    turn = matrix_from_quaternion([0, 0, np.sqrt(0.5), np.sqrt(0.5)])
    assert np.allclose(turn @ [1, 0, 0], [0, 1, 0])


def test_ellipsoid_holds_95_percent():
    rng = np.random.default_rng(2)
    factor = rng.normal(size=(3, 3)) * 1e-3
    covariance = factor @ factor.T
    diameters, axes = build_views.ellipsoid_axes(covariance)
    assert np.linalg.det(axes) == pytest.approx(1)
    samples = rng.multivariate_normal(np.zeros(3), covariance, 20000)
    inside = (((samples @ axes) / (diameters / 2)) ** 2).sum(axis=1) < 1
    assert inside.mean() == pytest.approx(0.95, abs=0.006)
    message = build_views.marker_array_ellipsoids(0, "b", "p", [([0, 0, 0], np.diag([1e-6, 4e-6, 9e-6]))])
    assert message.markers[0].scale.z == pytest.approx(2 * 2.7955 * 3e-3, rel=1e-4)


def test_the_crossing_of_the_diagonals_is_the_centre():
    quad = [[0, 0], [10, 0], [6, 4], [0, 4]]
    message = build.marker_detections(0, "m_left", "f", {1: quad})
    centre = message.detections[0].centre
    assert (centre.x, centre.y) == pytest.approx((3.75, 2.5))
