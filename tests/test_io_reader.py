"""Logs that are read: the same from a file and from a pipe, ours and others'."""

import json
import resource
from collections import Counter
from pathlib import Path

import logmaker
import numpy as np
import pytest
import zstandard
from reader_helpers import Open, from_file
from realdata import real_data

from surecut.factors.errors import LogError
from surecut.io.messages import (
    CameraInfoBody,
    CloudBody,
    DepthBody,
    DetectionsBody,
    ImageBody,
    PickBody,
    PointsBody,
    PoseBody,
)
from surecut.io.reader import LogReader


@pytest.fixture(scope="module")
def log(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("logs") / "log.mcap"
    logmaker.write_log(path, 40, chunk_size=30_000, compression="zstd")
    return path


def counts(reader: LogReader) -> Counter[str]:
    return Counter(message.topic for message in reader)


def test_everything_comes_back(open_log: Open, log: Path):
    first = {}
    with open_log(log) as reader:
        for message in reader:
            first.setdefault(message.topic, message)
        assert reader.warnings == []
        assert reader.metadata == {"run": {"surecut": "0.1.0"}}
        assert reader.profile == "ros2"
    image = first["/m/left/image_raw"]
    assert (image.stamp_ns, image.log_time_ns) == (logmaker.START_NS, logmaker.START_NS + 1_000_000)
    assert image.frame_id == "m_left"
    assert isinstance(image.body, ImageBody)
    assert np.array_equal(image.body.pixels(), logmaker.picture(0))
    assert isinstance(first["/zip"].body, ImageBody)
    assert np.array_equal(first["/zip"].body.pixels(), logmaker.picture(0))
    depth = first["/b/depth/image_raw"].body
    assert isinstance(depth, DepthBody)
    assert np.isnan(depth.depth_m()[0, 0])
    assert depth.depth_m()[1, 1] == pytest.approx(1.25)
    pick = first["/picks"].body
    assert isinstance(pick, PickBody)
    assert (pick.camera, pick.point_id, pick.role, pick.sigma_px) == ("m_left", "P1", "cut", 1.5)
    assert pick.px.tolist() == [30.5, 20.25]
    found = first["/m/left/markers"].body
    assert isinstance(found, DetectionsBody)
    assert found.corners_px.tolist() == [logmaker.SQUARE]
    assert found.ids.tolist() == [7]
    assert found.centres_px.tolist() == [[15, 15]]
    cloud = first["/cloud"].body
    assert isinstance(cloud, CloudBody)
    assert cloud.points_m().tolist() == [[1, 2, 3], [1, 2, 3]]


def test_poses_points_and_cameras_come_back(open_log: Open, log: Path):
    with open_log(log) as reader:
        last = {message.topic: message.body for message in reader}
    pose, points, right = last["/pose_cov"], last["/points"], last["/m/right/camera_info"]
    assert isinstance(pose, PoseBody)
    assert pose.matrix[:3, 3].tolist() == [39, 0, 1]
    assert pose.covariance is not None
    assert np.diag(pose.covariance).tolist() == [1, 2, 3, 4, 5, 6]
    assert isinstance(points, PointsBody)
    assert points.covariances_m2 is not None
    assert np.array_equal(points.covariances_m2[0], logmaker.POINT[1])
    assert isinstance(right, CameraInfoBody)
    assert right.camera.baseline_m == pytest.approx(0.12)
    assert right.camera.distortion_model == "plumb_bob"
    assert np.array_equal(right.camera.D, logmaker.RIGHT.D)
    assert np.array_equal(right.camera.K, logmaker.K)


def test_only_wanted_topics_are_given(open_log: Open, log: Path):
    with open_log(log, {"/picks", "/absent"}) as reader:
        assert counts(reader) == {"/picks": 40}


def test_the_rig_is_found_before_the_messages(open_log: Open, log: Path):
    with open_log(log) as reader:
        assert reader.attachment("rig.yaml") == logmaker.RIG.encode()
        assert reader.attachment("other") is None
        assert sum(counts(reader).values()) == 40 * 18


def test_hash_is_that_of_the_bytes(open_log: Open, log: Path):
    import hashlib

    with open_log(log) as reader:
        list(reader)
        assert reader.sha256() == hashlib.sha256(log.read_bytes()).hexdigest()


def test_a_file_is_read_again_and_a_hash_needs_no_reading(log: Path):
    import hashlib

    with LogReader(log) as reader:
        assert reader.sha256() == hashlib.sha256(log.read_bytes()).hexdigest()
        assert counts(reader) == counts(reader)


@pytest.mark.parametrize(
    ("content", "match"),
    [
        (b"", "is empty"),
        (b"\x89MCA", "cut off after 4 bytes"),
        (b"#ROSBAG V2.0 something", "is not an MCAP file"),
        (b"PK\x03\x04zip", "is not an MCAP file"),
    ],
)
def test_other_files_are_refused_in_one_line(open_log: Open, tmp_path: Path, content, match):
    path = tmp_path / "x.mcap"
    path.write_bytes(content)
    with open_log(path) as reader, pytest.raises(LogError, match=match) as caught:
        list(reader)
    assert "\n" not in str(caught.value)


def test_a_missing_file_and_an_empty_folder_are_told(tmp_path: Path):
    with pytest.raises(LogError, match="cannot be read"):
        LogReader(tmp_path / "no.mcap")
    with pytest.raises(LogError, match=r"holds no \.mcap"):
        LogReader(tmp_path)


def test_memory_stays_flat(tmp_path: Path):
    """Reading 400 MB of pictures takes no 100 MB."""
    from surecut.io import build
    from surecut.io.writer import McapSink

    path = tmp_path / "long.mcap"
    picture = np.zeros((1000, 1000), np.uint8)
    with McapSink(path, compression="zstd") as sink:
        for number in range(400):
            picture[:, 0] = number % 256
            sink.write("/i", "sensor_msgs/msg/Image", build.image(number, "m", picture, "mono8"), number)
    list(LogReader(tmp_path / "long.mcap", {"/none"}))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    total = sum(int(m.body.pixels()[0, 0]) for m in LogReader(path) if isinstance(m.body, ImageBody))
    assert total == sum(number % 256 for number in range(400))
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000


def test_a_split_recording_is_joined(tmp_path: Path):
    folder = real_data("mcap/rosbag2")
    for number in (0, 1, 2):
        name = f"multiple_files_{number}.mcap"
        (tmp_path / name).write_bytes((folder / name).read_bytes())
    with LogReader(tmp_path) as reader:
        assert counts(reader) == {"/chatter": 3177}
    metadata = "rosbag2_bagfile_information:\n  relative_file_paths: [multiple_files_2.mcap, multiple_files_0.mcap]\n"
    (tmp_path / "metadata.yaml").write_text(metadata)
    with LogReader(tmp_path) as reader:
        assert counts(reader) == {"/chatter": 529 + 1324}
    (tmp_path / "multiple_files_2.mcap").unlink()
    with pytest.raises(LogError, match=r"multiple_files_2\.mcap is named"):
        LogReader(tmp_path)


def test_compressed_files_are_read(tmp_path: Path, log: Path):
    path = tmp_path / "log.mcap.zstd"
    path.write_bytes(zstandard.compress(log.read_bytes()))
    with LogReader(path) as reader:
        assert counts(reader) == counts(LogReader(log))
        assert reader.attachment("rig.yaml") == logmaker.RIG.encode()


@pytest.mark.parametrize("series", ["OneMessage", "TenMessages"])
def test_conformance_files(open_log: Open, series):
    """All 308 valid files, those without repeated channels or schemas too."""
    folder = real_data(f"mcap/conformance/{series}")
    files = sorted(folder.glob("*.mcap"))
    assert len(files) == 154
    for path in files if open_log is from_file else files[::8]:
        records = json.loads(path.with_suffix(".json").read_text())["records"]
        expected = []
        for record in records:
            if record["type"] == "Message":
                fields = dict(record["fields"])
                expected.append((int(fields["log_time"]), bytes(int(b) for b in fields["data"])))
        with open_log(path) as reader:
            got = [(time, bytes(data)) for _, time, data in reader.raw()]
            assert not reader.warnings, path.name
        assert got == expected, path.name


def test_recordings_of_others_have_the_expected_counts(open_log: Open):
    expected = json.loads(real_data("mcap/expected.json").read_text())["files"]
    for name, entry in expected.items():
        path = real_data(f"mcap/{name}")
        with open_log(path) as reader:
            got = Counter(channel.topic for channel, _, _ in reader.raw())
        assert got == {t["topic"]: t["messages"] for t in entry["topics"] if t["messages"]}, name


def test_unknown_encodings_are_refused_when_wanted(open_log: Open):
    path = real_data("mcap/rosbag2/wrong_rmw_test_0.mcap")
    with (
        open_log(path, {"/test_topic"}) as reader,
        pytest.raises(LogError, match=r"/test_topic: encoding wrong_format"),
    ):
        list(reader)
    with open_log(path, {"/other"}) as reader:
        assert list(reader) == []


def test_aviary(open_log: Open):
    with open_log(real_data("aviary/aviary.mcap")) as reader:
        read = list(reader)
    found = [m for m in read if isinstance(m.body, DetectionsBody)]
    assert len(found) == 681
    assert sum(m.body.ids.size for m in found) == 12_846
    assert {family for m in found for family in m.body.families} == {"tag36h11"}
    cameras = [m.body.camera for m in read if isinstance(m.body, CameraInfoBody)]
    assert cameras[0].distortion_model == "plumb_bob"
    assert (cameras[0].width, cameras[0].height) == (2048, 2048)
    delays = [(m.log_time_ns - m.stamp_ns) / 1e9 for m in read]
    assert 0.3 < min(delays) < max(delays) < 1.1


def test_kitti():
    with LogReader(real_data("kitti/kitti1.mcap")) as reader:
        read = list(reader)
    images = [m.body for m in read if isinstance(m.body, ImageBody)]
    assert len(images) == 102
    assert images[0].pixels().shape == (370, 1226)
    right = [m.body.camera for m in read if m.topic == "/m/right/camera_info" and isinstance(m.body, CameraInfoBody)]
    assert right[0].baseline_m == pytest.approx(0.5372, abs=1e-4)
    path = [m.body.matrix[:3, 3] for m in read if isinstance(m.body, PoseBody)]
    assert np.linalg.norm(np.diff(path, axis=0), axis=1).sum() == pytest.approx(59.86, abs=0.01)


def test_kinect():
    with LogReader(real_data("kinect/kitchen.mcap")) as reader:
        depths = [m.body.depth_m() for m in reader if isinstance(m.body, DepthBody)]
    stack = np.stack(depths)
    assert stack.shape == (120, 480, 640)
    assert np.isnan(stack).mean() == pytest.approx(0.098, abs=0.001)
    assert np.nanmedian(stack) == pytest.approx(1.71, abs=0.01)
