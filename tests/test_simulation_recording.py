"""Whole recordings, small ones: what is in them, and that a seed fixes every byte."""

import hashlib

import cv2
import numpy as np
import pytest
import yaml
from mcap.reader import make_reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation

from surecut.factors.rig import load_rig
from surecut.simulation.recording import simulate
from surecut.simulation.rigid import inverse, rigid
from surecut.simulation.session import prepare
from surecut.simulation.trajectory import plan

from .simulation_helpers import small


def read(path):
    store, messages = get_typestore(Stores.EMPTY), {}
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        for schema, channel, message in reader.iter_messages():
            if schema.name not in store.types:
                store.register(get_types_from_msg(schema.data.decode(), schema.name))
            messages.setdefault(channel.topic, []).append(store.deserialize_cdr(message.data, schema.name))
        attachments = {a.name: a.data for a in reader.iter_attachments()}
    return messages, attachments


def nanoseconds(message):
    return message.header.stamp.sec * 10**9 + message.header.stamp.nanosec


def matrix(message):
    p, q = message.pose.position, message.pose.orientation
    return rigid(Rotation.from_quat([q.x, q.y, q.z, q.w]), (p.x, p.y, p.z))


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    path = tmp_path_factory.mktemp("logs") / "a.mcap"
    shares = []
    simulate(path, small(), 11, shares.append)
    assert shares[-1] == 1.0
    assert shares == sorted(shares)
    return path, *read(path)


def test_all_topics_are_there(recording):
    _, messages, attachments = recording
    counts = {topic: len(found) for topic, found in messages.items()}
    for side in ("left", "right"):
        assert counts[f"/m/{side}/image_raw"] == counts[f"/m/{side}/camera_info"] == 20
    assert counts["/b/depth/image_raw"] == counts["/b/rgb/image_raw"] == counts["/b/depth/camera_info"] == 4
    assert counts["/truth/pose/m"] == counts["/truth/pose/b"] == counts["/truth/pose/f"] == 20
    assert set(attachments) == {"rig.yaml", "truth.yaml"}


def test_stereo_pairs_have_equal_stamps_and_a_baseline(recording):
    _, messages, _ = recording
    left, right = messages["/m/left/image_raw"], messages["/m/right/image_raw"]
    assert [nanoseconds(m) for m in left] == [nanoseconds(m) for m in right]
    assert np.all(np.diff([nanoseconds(m) for m in left]) == 100_000_000)
    assert {m.encoding for m in left} == {"mono8"}
    info = messages["/m/right/camera_info"][0]
    assert -info.p[3] / info.p[0] == pytest.approx(0.15)
    assert info.k[0] == 90.0
    assert {m.encoding for m in messages["/b/depth/image_raw"]} == {"16UC1"}
    assert {m.encoding for m in messages["/b/rgb/image_raw"]} == {"bgr8"}


def test_truth_is_in_o_and_agrees_with_itself(recording):
    _, messages, attachments = recording
    truth = yaml.safe_load(attachments["truth.yaml"])
    assert np.allclose(matrix(messages["/truth/pose/m"][0]), np.eye(4), atol=1e-9)
    o_T_f, o_T_b = matrix(messages["/truth/pose/f"][3]), matrix(messages["/truth/pose/b"][3])
    assert np.allclose(inverse(o_T_f) @ o_T_b, truth["f_T_b"], atol=1e-9)
    points = messages["/truth/points"][0]
    assert points.ids == ["P1", "P2"]
    assert points.header.frame_id == "b"
    for point_id, point in zip(points.ids, points.points, strict=True):
        place = np.array([point.x, point.y, point.z])
        assert place == pytest.approx(truth["points"][point_id]["position_m"])
        # On the axis of the pipe.
        along = place - truth["pipe"]["point_m"]
        assert np.linalg.norm(np.cross(along, truth["pipe"]["axis"])) < 1e-9


def test_picks_name_both_points_at_image_stamps(recording):
    _, messages, attachments = recording
    stamps = {nanoseconds(m) for m in messages["/m/left/image_raw"]}
    picks = [m for m in messages["/picks"] if m.header.frame_id == "m_left"]
    assert {(p.point_id, p.role) for p in picks} == {("P1", "cut"), ("P2", "grasp")}
    assert len(picks) >= 4
    assert all(nanoseconds(p) in stamps and p.sigma_px == 1.0 for p in picks)
    assert load_rig(attachments["rig.yaml"]).mount is not None


def test_images_have_contrast(recording):
    _, messages, _ = recording
    for topic in ("/m/left/image_raw", "/m/right/image_raw", "/b/rgb/image_raw"):
        pixels = messages[topic][0].data.astype(float)
        assert 25 < pixels.mean() < 190
        assert pixels.std() > 12
    depth = messages["/b/depth/image_raw"][0].data.view(np.uint16)
    assert 0.3 < (depth > 0).mean() < 1.0
    assert depth.max() < 4100


def test_one_seed_one_file_whatever_the_number_of_processes(recording, tmp_path):
    path, _, _ = recording
    again = tmp_path / "again.mcap"
    simulate(again, small(), 11, workers=2)
    assert hashlib.sha256(again.read_bytes()).hexdigest() == hashlib.sha256(path.read_bytes()).hexdigest()


@pytest.fixture(scope="module")
def eventful():
    timeline = {"still": [[4.0, 7.0]], "base_move": [10.0, 12.0], "arm_moves": True}
    board = {"knock": {"at_s": 3.0, "shift_m": [0.02, 0, 0], "turn_rad": [0, 0, 0]}}
    return prepare(small(duration_s=20.0, timeline=timeline, board=board, pipe={"second": True}), 4)


def test_camera_put_down_does_not_move(eventful):
    first, later = eventful.trajectory.pose(4.2), eventful.trajectory.pose(6.8)
    assert np.abs(first - later).max() < 1e-6
    assert np.linalg.norm(eventful.trajectory.pose(3.0)[:3, 3] - first[:3, 3]) > 1e-3


def test_base_moves_once_and_points_follow(eventful):
    motion = eventful.motion
    assert np.allclose(motion.kinect(1.0), motion.kinect(9.9))
    assert np.allclose(motion.kinect(12.1), motion.kinect(19.0))
    step = inverse(motion.kinect(0.0)) @ motion.kinect(15.0)
    assert 0.2 < np.linalg.norm(step[:3, 3]) < 0.7
    before, after = eventful.points_in_b(0.0)["P1"], eventful.points_in_b(15.0)["P1"]
    assert np.allclose(step @ [*after, 1], [*before, 1])


def test_board_is_knocked_at_its_time(eventful):
    motion = eventful.motion
    shift = inverse(motion.page(2.9)) @ motion.page(3.1)
    assert np.allclose(shift[:3, 3], [0.02, 0, 0])


def test_arm_moves(eventful):
    assert not np.allclose(eventful.motion.poses(0.0)["fore_arm"], eventful.motion.poses(1.0)["fore_arm"])


@pytest.mark.parametrize(("motion", "low", "high"), [("smooth", 3.0, 6.5), ("sharp", 5.0, 12.0)])
def test_length_of_the_path(eventful, motion, low, high):
    scenario = small(duration_s=30.0, motion=motion)
    w_T_c = eventful.motion.chassis(0.0)
    lengths = [plan(scenario, eventful.cell, w_T_c, np.random.default_rng(seed)).length_m(30.0) for seed in range(8)]
    assert low < np.mean(lengths) < high


def test_compressed_images_decode(tmp_path):
    path = tmp_path / "jpeg.mcap"
    simulate(path, small(duration_s=1.0, jpeg_quality=90, kinect={"width": 80, "height": 60, "rate_hz": 1.0}), 2)
    messages, _ = read(path)
    first = messages["/m/left/image_raw"][0]
    assert first.format == "jpeg"
    assert cv2.imdecode(first.data, cv2.IMREAD_UNCHANGED).shape == (80, 120)
    assert messages["/b/depth/image_raw"][0].encoding == "16UC1"
