"""`surecut info`: what is in a log, what can be used, what is missing, what is odd."""

import json
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import logmaker
import numpy as np
import pytest
from realdata import real_data

from surecut.estimator.cli import main
from surecut.estimator.commands.info import carried_rig
from surecut.estimator.log_check import Findings, check_log
from surecut.factors.errors import SurecutError
from surecut.factors.rig import load_rig
from surecut.io import build
from surecut.io.inventory import check_stamps, take_inventory, unpaired
from surecut.io.reader import LogReader
from surecut.io.writer import McapSink

IMAGE, INFO, PICK = "sensor_msgs/msg/Image", "sensor_msgs/msg/CameraInfo", "surecut_msgs/msg/PixelPick"
Alter = Callable[[int, str, object], object]


def findings(path: Path, rig: str | None = None) -> Findings:
    with LogReader(path) as reader:
        inventory = take_inventory(reader)
    effective = load_rig(rig) if rig is not None else carried_rig(inventory)[0]
    return check_log(inventory, effective)


def altered(path: Path, alter: Alter, moments: int = 20, rig: str | None = logmaker.RIG) -> Findings:
    """Findings about a log of which each message went through `alter`, which may drop it (None)."""
    with McapSink(path) as sink:
        if rig is not None:
            sink.attach("rig.yaml", "application/yaml", rig)
        for number in range(moments):
            for topic, type_name, message in logmaker.messages(number):
                changed = alter(number, topic, message)
                if changed is not None:
                    sink.write(topic, type_name, changed, logmaker.START_NS + number * logmaker.STEP_NS)
    return findings(path)


def moved(message, stamp_ns: int):
    """The same message with another stamp."""
    return replace(message, header=build.header(stamp_ns, message.header.frame_id))


def test_a_good_log_lacks_nothing(tmp_path: Path):
    found = altered(tmp_path / "a.mcap", lambda n, topic, message: message)
    assert found.missing == ()
    assert found.odd == ()
    usable = "\n".join(found.usable)
    for part in (
        "marker corners in m_left",
        "stereo visual odometry",
        "Kinect depth cloud",
        "20 picks of 1 points: P1 (cut)",
    ):
        assert part in usable
    assert "never for the estimate: /truth/points" in usable


def test_no_rig_is_told(tmp_path: Path):
    found = altered(tmp_path / "a.mcap", lambda n, topic, message: message, rig=None)
    assert any("give --rig" in text for text in found.missing)


@pytest.mark.parametrize(
    ("dropped", "match"),
    [
        ("/m/left/camera_info", "the calibration of m_left: no usable message on /m/left/camera_info"),
        ("/picks", "picks on /picks: without one"),
        ("/b/depth/camera_info", "the calibration of b_depth"),
    ],
)
def test_what_is_missing_is_named(tmp_path: Path, dropped, match):
    found = altered(tmp_path / "a.mcap", lambda n, topic, message: None if topic == dropped else message)
    assert any(match in text for text in found.missing), found


def test_no_link_to_the_machine_is_told(tmp_path: Path):
    rig = logmaker.RIG.replace(logmaker.RIG[logmaker.RIG.index("mount") :], "")
    found = altered(tmp_path / "a.mcap", lambda n, t, m: None if t.startswith("/b/") else m, rig=rig)
    assert any(text.startswith("a link to {b}") for text in found.missing)


def odd(tmp_path: Path, alter: Alter) -> str:
    return "\n".join(altered(tmp_path / "a.mcap", alter).odd)


def test_stamps_that_run_backwards_or_stand_twice_or_are_unset(tmp_path: Path):
    def alter(n, topic, message):
        stamps = {5: logmaker.START_NS, 10: logmaker.START_NS + 9 * logmaker.STEP_NS, 15: 0}
        return moved(message, stamps[n]) if topic == "/pose" and n in stamps else message

    text = odd(tmp_path, alter)
    assert "/pose: 1 stamps run backwards" in text
    assert "/pose: 1 stamps stand twice" in text
    assert "/pose: 1 stamps are not set" in text


def test_gaps(tmp_path: Path):
    text = odd(tmp_path, lambda n, t, m: None if t == "/b/depth/image_raw" and 5 <= n < 15 else m)
    assert "/b/depth/image_raw: 1 gaps, the largest 0.55 s after 1000.200 s; the usual step is 0.050 s" in text


def test_unequal_stereo_stamps(tmp_path: Path):
    def alter(n, topic, message):
        return (
            moved(message, logmaker.START_NS + n * logmaker.STEP_NS + 7_000_000)
            if topic == "/m/right/image_raw"
            else message
        )

    text = odd(tmp_path, alter)
    assert "stereo stamps are unequal: 20 of 20 left and 20 of 20 right images have no partner" in text
    assert "median distance 7.0 ms" in text


def test_calibration_of_another_size(tmp_path: Path):
    def alter(n, topic, message):
        camera = replace(logmaker.LEFT, width=128, height=96)
        return (
            build.camera_info(message.header.stamp.sec * 10**9, "m_left", camera)
            if topic == "/m/left/camera_info"
            else message
        )

    text = odd(tmp_path, alter)
    assert (
        "/m/left/camera_info: the calibration is for 128x96 pixels, the images on /m/left/image_raw have 64x48" in text
    )


def test_swapped_cameras(tmp_path: Path):
    def alter(n, topic, message):
        camera = {"/m/left/camera_info": logmaker.RIGHT, "/m/right/camera_info": logmaker.LEFT}.get(topic)
        return build.camera_info(logmaker.START_NS + n * logmaker.STEP_NS, "x", camera) if camera else message

    assert "left and right seem swapped" in odd(tmp_path, alter)


def test_a_negative_baseline_is_swapped_too(tmp_path: Path):
    def alter(n, topic, message):
        camera = replace(logmaker.RIGHT, baseline_m=-0.12)
        return build.camera_info(logmaker.START_NS + n, "x", camera) if topic == "/m/right/camera_info" else message

    assert "-0.1200 m" in odd(tmp_path, alter)


@pytest.mark.parametrize(
    ("camera", "uv", "role", "match"),
    [
        ("drone", (1, 1), "cut", "camera 'drone', which does not exist"),
        ("m_left", (64.2, 10), "cut", r"at (64.2, 10.0) lies outside the 64x48 image"),
        ("m_left", (10, 10), "saw", "role 'saw'; roles: cut, grasp, other"),
    ],
)
def test_strange_picks(tmp_path: Path, camera, uv, role, match):
    def alter(n, topic, message):
        return build.pixel_pick(logmaker.START_NS + n, camera, "P9", role, uv, 1) if topic == "/picks" else message

    assert match in odd(tmp_path, alter)


def test_markers_on_no_board(tmp_path: Path):
    def alter(n, topic, message):
        both = {7: logmaker.SQUARE, 8: logmaker.SQUARE}
        found = build.marker_detections(logmaker.START_NS + n, "m_left", "f", both)
        return found if topic == "/m/left/markers" else message

    assert "/m/left/markers: markers 8 are on no board" in odd(tmp_path, alter)


def test_calibration_that_is_not_finite(tmp_path: Path):
    def alter(n, topic, message):
        camera = replace(logmaker.LEFT, K=np.full((3, 3), np.nan))
        return build.camera_info(logmaker.START_NS + n, "x", camera) if topic == "/m/left/camera_info" else message

    found = altered(tmp_path / "a.mcap", alter)
    assert any("/m/left/camera_info" in text and "not finite" in text for text in found.odd)
    assert any("the calibration of m_left" in text for text in found.missing)


def test_a_rig_with_an_error_is_told_and_the_table_comes_all_the_same(tmp_path: Path, capsys):
    logmaker.write_log(tmp_path / "a.mcap", 3, rig="version: 1\nbords: []\n")
    assert run("info", str(tmp_path / "a.mcap")) == 0
    out = capsys.readouterr().out
    assert "unknown key" in out or "boards: Field required" in out
    assert "/m/left/image_raw" in out


def run(*arguments: str) -> int:
    with pytest.raises(SystemExit) as caught:
        main(arguments)
    return int(caught.value.code or 0)


def test_the_command_prints_and_writes_json(tmp_path: Path, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    logmaker.write_log(tmp_path / "a.mcap", 20)
    assert run("info", str(tmp_path / "a.mcap"), "--json", str(tmp_path / "a.json")) == 0
    out = capsys.readouterr().out
    assert "image 64x48" in out
    value = json.loads((tmp_path / "a.json").read_text())
    assert value["topics"]["/m/left/image_raw"]["messages"] == 20
    assert value["topics"]["/m/left/image_raw"]["rate_hz"] == pytest.approx(20)
    assert len(value["log_sha256"]) == 64
    assert value["missing"] == value["odd"] == []


def test_bad_input_is_one_line(tmp_path: Path, capsys):
    (tmp_path / "empty.mcap").touch()
    (tmp_path / "folder").mkdir()
    for name, match in (("empty.mcap", "is empty"), ("none.mcap", "cannot be read"), ("folder", "holds no .mcap")):
        assert run("info", str(tmp_path / name)) == 1
        err = capsys.readouterr().err
        assert err.startswith("surecut: ")
        assert err.count("\n") == 1
        assert match in err


def test_a_json_file_that_cannot_be_written(tmp_path: Path, capsys):
    logmaker.write_log(tmp_path / "a.mcap", 1)
    assert run("info", str(tmp_path / "a.mcap"), "--json", str(tmp_path / "no" / "a.json")) == 1
    assert "cannot be written" in capsys.readouterr().err


def test_a_damaged_log_is_shown_as_far_as_it_goes(tmp_path: Path, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "400")
    logmaker.write_log(tmp_path / "a.mcap", 20, chunk_size=20_000)
    data = (tmp_path / "a.mcap").read_bytes()
    (tmp_path / "a.mcap").write_bytes(data[: len(data) // 2])
    assert run("info", str(tmp_path / "a.mcap")) == 0
    assert f"cut off at byte {len(data) // 2}" in capsys.readouterr().out


def test_stamp_check_by_hand():
    check = check_stamps(np.array([10, 20, 30, 30, 25, 35, 0, 135]) * 1_000_000)
    assert check.rate_hz == pytest.approx(100)
    assert (check.backwards, check.duplicated, check.unset, check.gaps) == (1, 1, 1, 1)
    assert check.largest_gap_s == pytest.approx(0.1)
    assert check.gap_at_s == pytest.approx(0.035)


def test_unpaired_by_hand():
    assert unpaired([10, 20, 30], [11, 30, 50], 1) == (1, 1, 1.0)
    assert unpaired([], [1, 2], 1) == (0, 2, 0.0)


def test_real_logs_have_nothing_odd():
    for name in ("aviary/aviary.mcap", "kitti/kitti1.mcap", "kinect/kitchen.mcap"):
        assert findings(real_data(name)).odd == (), name


def test_rig_files_in_writing_only_appear_whole(tmp_path: Path):
    from surecut.estimator.output_files import write_text

    write_text(tmp_path / "a.txt", "one")
    write_text(tmp_path / "a.txt", "two")
    assert (tmp_path / "a.txt").read_text() == "two"
    assert os.listdir(tmp_path) == ["a.txt"]
    with pytest.raises(SurecutError, match=r"no/a\.txt: cannot be written"):
        write_text(tmp_path / "no" / "a.txt", "x")
