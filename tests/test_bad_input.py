"""Bad input gets one line that names what, where and the cure; exit status 1; and nothing is overwritten."""

import errno
import json
import os
from dataclasses import replace

import cell_log as cell
import numpy as np
import pytest

from surecut.estimator.cli import main
from surecut.factors.camera import CameraModel
from surecut.io import build, writer

OLD = b"an earlier result"


class Ran:
    """One run of `surecut optimise`."""

    def __init__(self, folder, capsys, log, *arguments):
        outputs = folder / "estimate.mcap", folder / "result.json"
        for path in outputs:
            path.write_bytes(OLD)
        capsys.readouterr()
        with pytest.raises(SystemExit) as told:
            main(["optimise", str(log), "-o", str(outputs[0]), "--json", str(outputs[1]), *map(str, arguments)])
        self.code = told.value.code
        self.err = capsys.readouterr().err
        self.lines = self.err.strip().splitlines()
        self.kept = all(path.read_bytes() == OLD for path in outputs)
        left = {path.name for path in folder.iterdir() if path.name.startswith(".")}
        assert not left, f"unfinished files: {left}"
        self.result = None if self.kept else json.loads(outputs[1].read_text())

    def refused(self, *words):
        assert self.code == 1
        assert len(self.lines) == 1, self.err
        assert self.kept
        missing = [word for word in words if str(word) not in self.lines[0]]
        assert not missing, f"{missing} not in: {self.lines[0]}"

    def answered(self):
        assert self.code == 0, self.err
        assert self.err == ""
        return self.result

    def finds_the_point(self):
        point = self.answered()["points"][0]
        error = np.array(point["position_m"]) - cell.POINT_B
        assert error @ np.linalg.solve(np.array(point["covariance_m2"]), error) < 16.3  # 99.9 %
        return self.result


@pytest.fixture
def run(tmp_path, capsys):
    results = tmp_path / "results"
    results.mkdir()
    return lambda log, *arguments: Ran(results, capsys, log, *arguments)


@pytest.fixture(scope="session")
def film():
    return cell.pictures(8)


def told(result, kind):
    return [event["text"] for event in result["events"] if event["kind"] == kind]


def test_a_sound_log_is_answered(run, tmp_path):
    result = run(cell.write(tmp_path / "run.mcap")).finds_the_point()
    assert [event["kind"] for event in result["events"]] == ["corner_rms"]


# The file ---------------------------------------------------------------------------------------------------------


def test_no_such_file(run, tmp_path):
    run(tmp_path / "none.mcap").refused("none.mcap", "cannot be read", "give a recorded .mcap log")


def test_empty_file(run, tmp_path):
    log = tmp_path / "run.mcap"
    log.touch()
    run(log).refused("run.mcap", "empty")


def test_not_an_mcap(run, tmp_path):
    log = tmp_path / "run.mcap"
    log.write_text("stamp,x,y\n" * 100)
    run(log).refused("run.mcap", "MCAP")


@pytest.mark.parametrize("share", [0.001, 0.05, 0.3, 0.6, 0.9, 0.999])
def test_cut_anywhere(run, tmp_path, share):
    log = cell.write(tmp_path / "run.mcap", chunk_size=2000)
    data = log.read_bytes()
    log.write_bytes(data[: int(share * len(data))])
    rig = tmp_path / "rig.yaml"
    rig.write_text(cell.RIG)
    ran = run(log, "--rig", rig)
    if share < 0.5:
        ran.refused("run.mcap", "cut off" if share > 0.01 else "")
    else:
        result = ran.finds_the_point()
        if share < 0.8:  # beyond it stands the index only, and no message is lost
            assert "cut off at byte" in told(result, "log_damaged")[0]


@pytest.mark.parametrize("seed", range(6))
def test_a_flipped_bit(run, tmp_path, seed):
    log = cell.write(tmp_path / "run.mcap", chunk_size=2000)
    sound = run(log).finds_the_point()["points"]
    data = bytearray(log.read_bytes())
    bit = int(np.random.default_rng(seed).integers(8 * len(data) // 4, 8 * len(data) // 2))
    data[bit // 8] ^= 1 << bit % 8
    log.write_bytes(data)
    rig = tmp_path / "rig.yaml"
    rig.write_text(cell.RIG)
    result = run(log, "--rig", rig).finds_the_point()
    assert result["points"] == sound or "run.mcap: damaged" in told(result, "log_damaged")[0]


# The rig ----------------------------------------------------------------------------------------------------------


def test_no_rig(run, tmp_path):
    run(cell.write(tmp_path / "run.mcap", rig=None)).refused("run.mcap", "rig.yaml", "--rig")


def test_rig_file_is_not_there(run, tmp_path):
    run(cell.write(tmp_path / "run.mcap"), "--rig", tmp_path / "cell.yaml").refused("cell.yaml", "cannot be read")


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("version: 1", "version: 1\nbords: []", ("bords", "unknown key", "surecut rig --example")),
        ("mount: {board: f0,", "mount: {board: f0, rotation_sigma_rad: -0.1,", ("mount.rotation_sigma_rad", "-0.1")),
        ("id: 3,", "id: 0,", ("marker id 0 stands twice", "f0")),
        ("{board: f0,", "{board: f1,", ("no board 'f1'", "f0")),
        ("version: 1", "version: [", ("YAML",)),
    ],
    ids=["typo", "negative sigma", "one id twice", "board that is not there", "no yaml"],
)
def test_wrong_rig(run, tmp_path, old, new, words):
    rig = tmp_path / "cell.yaml"
    rig.write_text(cell.RIG.replace(old, new))
    log = cell.write(tmp_path / "run.mcap")
    run(log, "--rig", rig).refused("cell.yaml", *words)
    run(cell.write(tmp_path / "own.mcap", rig=rig.read_text())).refused("own.mcap", "rig.yaml", *words)


# Calibration ------------------------------------------------------------------------------------------------------


def with_camera(camera: CameraModel, side: str):
    entries = cell.messages()
    topic = f"/m/{side}/camera_info"
    return [cell.info(topic, e.stamp_ns, camera) if e.topic == topic else e for e in entries]


def test_missing_calibration(run, tmp_path):
    entries = [e for e in cell.messages() if e.topic != "/m/left/camera_info"]
    run(cell.write(tmp_path / "run.mcap", entries)).refused("run.mcap", "/m/left/camera_info", "no calibration")


def test_nan_in_the_intrinsics(run, tmp_path):
    broken = replace(cell.LEFT, K=np.where(cell.K == 300.0, np.nan, cell.K))
    log = cell.write(tmp_path / "run.mcap", with_camera(broken, "left"))
    run(log).refused("run.mcap", "/m/left/camera_info at 1000.000 s", "not finite", "record the calibration again")


def test_calibration_whose_centre_is_outside_its_image(run, tmp_path):
    log = cell.write(tmp_path / "run.mcap", with_camera(replace(cell.LEFT, width=160, height=120), "left"))
    run(log).refused("run.mcap", "/m/left/camera_info", "contradicts the image size", "one resolution")


def test_calibration_of_another_image_size(run, tmp_path, film):
    entries = [
        cell.info(e.topic, e.stamp_ns, replace(cell.LEFT, width=720, height=480))
        if e.topic == "/m/left/camera_info"
        else e
        for e in cell.filmed(film)
    ]
    log = cell.write(tmp_path / "run.mcap", entries)
    run(log).refused("run.mcap", "/m/left/image_raw", "360x240", "720x480", "camera_info that belongs")


# Left and right ---------------------------------------------------------------------------------------------------


def exchanged(entries):
    sides = {"/m/left/": "/m/right/", "/m/right/": "/m/left/"}

    def other(topic):
        return next((topic.replace(a, b) for a, b in sides.items() if topic.startswith(a)), topic)

    return [replace(e, topic=other(e.topic)) for e in entries]


def test_left_and_right_swapped_with_their_calibrations(run, tmp_path):
    log = cell.write(tmp_path / "run.mcap", exchanged(cell.messages()))
    run(log).refused("run.mcap", "camera_info", "left and right are swapped", "exchange")


@pytest.mark.parametrize("kind", ["markers", "image_raw"])
def test_left_and_right_swapped_under_a_right_calibration(run, tmp_path, kind, film):
    entries = cell.messages() if kind == "markers" else cell.filmed(film)
    swapped = [exchanged([e])[0] if kind in e.topic else e for e in entries]
    log = cell.write(tmp_path / "run.mcap", swapped)
    run(log).refused("run.mcap", "/m/left/image_raw", " ns: ", "left and right are swapped", "exchange the topics")


# Markers ----------------------------------------------------------------------------------------------------------


def test_no_marker_ever_seen(run, tmp_path):
    entries = [cell.markers(e.topic, e.stamp_ns, {}) if e.type_name == cell.MARKERS else e for e in cell.messages()]
    run(cell.write(tmp_path / "run.mcap", entries)).refused("run.mcap", "no known marker was seen", "marker ids")


def test_no_board_in_the_images(run, tmp_path, film):
    rig = cell.RIG
    for marker in range(4):
        rig = rig.replace(f"id: {marker},", f"id: {marker + 20},")
    log = cell.write(tmp_path / "run.mcap", cell.filmed(film), rig)
    run(log).refused("run.mcap", "{b} is not observable", "f0", "marker ids")


def test_a_marker_on_no_board_is_kept_with_its_reason(run, tmp_path):
    stray = np.array([[10.0, 30], [30, 30], [30, 10], [10, 10]])
    entries = cell.messages()
    entries.append(cell.markers("/m/left/markers", entries[-1].stamp_ns + cell.STEP_NS, {17: stray}))
    result = run(cell.write(tmp_path / "run.mcap", entries)).finds_the_point()
    assert any("17" in r["what"] and "rig does not know" in r["reason"] for r in result["rejected"])


def test_only_markers_that_are_on_no_board(run, tmp_path):
    rig = cell.RIG
    for marker in range(4):
        rig = rig.replace(f"id: {marker},", f"id: {marker + 20},")
    log = cell.write(tmp_path / "run.mcap", rig=rig)
    run(log).refused("run.mcap", "no known marker was seen", "DICT_4X4_50:0", "on no board of the rig")


# Picks ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("entry", "words"),
    [
        (lambda t: cell.pick(t, "m_middle", 100, 100), ("'m_middle'", "m_left, m_right or b_rgb")),
        (lambda t: cell.pick(t, "m_left", 400, 100), ("(400.0, 100.0)", "outside the 360x240 image")),
        (lambda t: cell.pick(t, "m_left", 100, 100, "P2"), ("P2", "no depth and no second view", "another place")),
        (lambda t: cell.pick(t + 1, "m_left", 100, 100, "P2"), ("P2", "stamp of no image")),
        (lambda t: cell.pick(t, "b_rgb", 100, 100, "P2"), ("b_rgb", "/b/rgb/camera_info")),
        (lambda t: cell.pick(t, "m_left", 100, 100, role="weld"), ("'weld'", "grasp, cut and other")),
        (lambda t: cell.pick(t, "m_left", 100, 100, sigma=0.0), ("sigma_px 0.0", "positive")),
    ],
    ids=["camera", "outside", "no depth", "stamp", "no calibration", "role", "sigma"],
)
def test_bad_pick(run, tmp_path, entry, words):
    stamp = cell.START_NS + 4 * cell.STEP_NS
    entries = sorted([*cell.messages(), entry(stamp)], key=lambda e: e.stamp_ns)
    ran = run(cell.write(tmp_path / "run.mcap", entries))
    ran.refused("run.mcap", *words)
    assert "/picks at 10004" in ran.lines[0] or "camera_info" in ran.lines[0]


# Stamps -----------------------------------------------------------------------------------------------------------


def test_stamps_that_run_backwards_are_sorted(run, tmp_path):
    entries = cell.messages()
    order = [e for n in range(0, 25, 2) for e in reversed([e for e in entries if moment(e) in (n, n + 1)])]
    result = run(cell.write(tmp_path / "run.mcap", order)).finds_the_point()
    assert any("/m/left/markers" in text and "backwards" in text for text in told(result, "stamps_backwards"))


def test_stamps_that_stand_twice(run, tmp_path):
    result = run(cell.write(tmp_path / "run.mcap", [e for e in cell.messages() for _ in range(2)])).finds_the_point()
    assert any("/m/left/markers" in text and "twice" in text for text in told(result, "stamps_duplicated"))


def test_images_that_stand_twice(run, tmp_path, film):
    entries = [e for e in cell.filmed(film) for _ in range(2 if e.type_name == cell.IMAGE else 1)]
    result = run(cell.write(tmp_path / "run.mcap", entries)).answered()
    assert any("/m/left/image_raw" in text for text in told(result, "stamps_duplicated"))


def moment(entry):
    return (entry.stamp_ns - cell.START_NS) // cell.STEP_NS


# Depth ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("share", [0.5, 1.0])
def test_nan_in_the_depth(run, tmp_path, share):
    rng = np.random.default_rng(2)
    entries = []
    for number in range(25):
        stamp = cell.START_NS + number * cell.STEP_NS
        depth = np.where(rng.random((120, 160)) < share, np.nan, 1.5).astype(np.float32)
        entries.append(cell.info("/b/depth/camera_info", stamp, SMALL))
        entries.append(cell.Entry("/b/depth/image_raw", cell.IMAGE, stamp, floating(depth)))
    entries = sorted([*cell.messages(), *entries], key=lambda e: e.stamp_ns)
    run(cell.write(tmp_path / "run.mcap", entries)).finds_the_point()


SMALL = CameraModel(
    "b_depth", 160, 120, np.array([[140.0, 0, 79.5], [0, 140, 59.5], [0, 0, 1]]), "none", np.zeros(0), np.eye(3), 0.0
)


def floating(depth):
    return lambda t: build.image(t, "b", depth, "32FC1")


# The disk ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("after", [0, 2000])
def test_disk_full_while_the_log_is_written(run, tmp_path, monkeypatch, after):
    log = cell.write(tmp_path / "run.mcap")

    def full(self, data):
        if self._position + len(data) > after:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        self.stream.write(data)
        self._position += len(data)
        return len(data)

    monkeypatch.setattr(writer._Counting, "write", full)
    run(log).refused("estimate.mcap", "No space left on device", "free space")


def test_disk_full_while_the_json_is_written(tmp_path, capsys, monkeypatch):
    log, target = cell.write(tmp_path / "run.mcap"), tmp_path / "result.json"
    target.write_bytes(OLD)

    def full(_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(SystemExit) as ended:
        main(["optimise", str(log), "--json", str(target)])
    lines = capsys.readouterr().err.strip().splitlines()
    assert ended.value.code == 1
    assert len(lines) == 1
    assert "result.json" in lines[0]
    assert target.read_bytes() == OLD
    assert [p.name for p in tmp_path.iterdir() if p.name.startswith(".")] == []
