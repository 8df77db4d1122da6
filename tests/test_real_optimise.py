"""The whole estimator on real recordings, as a user runs it: `surecut optimise LOG --rig docs/examples/...`."""

import dataclasses
import json
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from realdata import real_data
from scipy.spatial.transform import Rotation
from scipy.stats import chi2
from typer.testing import CliRunner

from surecut.estimator.cli import application
from surecut.estimator.commands.depthpath import command as depthpath
from surecut.estimator.optimise import optimise as from_depth_alone
from surecut.estimator.result_log import write_result
from surecut.factors.rig import dump_rig, load_rig
from surecut.frontends.cloud.frontend import CloudFrontEnd, average_depth
from surecut.io.messages import CameraInfoBody, DepthBody, PoseBody
from surecut.io.reader import LogReader
from surecut.io.schemas import typestore
from surecut.io.writer import McapSink

EXAMPLES = Path(__file__).resolve().parents[1] / "docs" / "examples"


def optimise(tmp_path, log, rig, *arguments):
    """The result as JSON, and the trajectory of {m} by stamp in microseconds."""
    json_file, tum = tmp_path / "result.json", tmp_path / "m.tum"
    options = ["--rig", str(rig), "--json", str(json_file), "--tum", str(tum), *map(str, arguments)]
    done = CliRunner().invoke(application(["optimise"]), ["optimise", str(log), *options], prog_name="surecut")
    assert done.exit_code == 0, done.output
    return json.loads(json_file.read_text()), trajectory(tum)


def trajectory(path):
    rows = np.loadtxt(path, ndmin=2)
    stamps = [line.split()[0] for line in path.read_text().splitlines() if not line.startswith("#")]
    return {round(float(s) * 1e6): row[1:4] for s, row in zip(stamps, rows, strict=True)}


def thinned(source, target, every):
    """Every n-th message of each topic, as recorded."""
    counts = {}
    with LogReader(source) as reader, McapSink(target) as sink:
        for channel, log_time_ns, data in reader.raw():
            counts[channel.topic] = counts.get(channel.topic, -1) + 1
            if counts[channel.topic] % every == 0:
                message = typestore().deserialize_cdr(bytes(data), channel.schema_name)
                sink.write(channel.topic, channel.schema_name, message, log_time_ns)
    return target


def corner_rms_px(result):
    return next(e["values"]["rms_px"] for e in result["events"] if e["kind"] == "corner_rms")


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


def rms_to(reference, estimate):
    common = sorted(reference.keys() & estimate.keys())
    return rms([np.linalg.norm(reference[s] - estimate[s]) for s in common]), len(common)


# Aviary -----------------------------------------------------------------------------------------------------------


def test_aviary_every_third_frame(tmp_path):
    log = thinned(real_data("aviary/aviary.mcap"), tmp_path / "aviary.mcap", 3)
    result, _ = optimise(tmp_path, log, EXAMPLES / "aviary.rig.yaml", "--between", "29/0 60/0")
    given = [d for d in result["distances"] if d["given_m"] is not None]
    assert len(given) == 7
    assert rms([1e3 * (d["distance_m"] - d["given_m"]) for d in given]) < 4.6
    asked = [d for d in result["distances"] if d["given_m"] is None]
    assert [d["name"] for d in asked] == ["29/0 to 60/0"]
    # Tags 24 and 29 are on one board, 0.3 m and 0.15 m apart: the triangle holds.
    assert abs(asked[0]["distance_m"] - given[0]["distance_m"]) < 0.336
    assert 1e-4 < asked[0]["sigma_m"] < 0.01
    assert corner_rms_px(result) < 0.6
    assert len(result["trajectory"]) >= 225


@pytest.mark.campaign
def test_aviary_whole(tmp_path):
    log = real_data("aviary/aviary.mcap")
    result, _ = optimise(tmp_path, log, EXAMPLES / "aviary.rig.yaml")
    assert rms([1e3 * (d["distance_m"] - d["given_m"]) for d in result["distances"]]) < 4.6
    corners = next(f for f in result["consistency"]["by_family"].values() if f["family"] == "marker corners")
    assert corners["residuals"] > 50_000
    assert corner_rms_px(result) < 0.6
    assert len(result["trajectory"]) >= 680


@pytest.mark.campaign
def test_half_of_the_distances_predicts_the_other_half(tmp_path):
    """The long first distance holds the scale, so it is always given."""
    log, rig = real_data("aviary/aviary.mcap"), load_rig(EXAMPLES / "aviary.rig.yaml")
    rng, misses = np.random.default_rng(0), []
    for _ in range(3):
        keep = {0, *rng.choice(np.arange(1, 7), 3, replace=False).tolist()}
        half = rig.model_copy(update={"distances": tuple(rig.distances[i] for i in sorted(keep))})
        (tmp_path / "half.yaml").write_text(dump_rig(half))
        rest = [d for i, d in enumerate(rig.distances) if i not in keep]
        asked = [x for d in rest for x in ("--between", f"{d.point_a} {d.point_b}")]
        result, _ = optimise(tmp_path, log, tmp_path / "half.yaml", *asked)
        found = [d for d in result["distances"] if d["given_m"] is None]
        misses += [1e3 * (f["distance_m"] - d.distance_m) for f, d in zip(found, rest, strict=True)]
    assert rms(misses) < 10.0


# Single tags ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("name", "poses"), [("collinear", 297), ("perch", 455)])
def test_tags_about_one_and_two_cameras(tmp_path, name, poses):
    folder = real_data(f"stereo_tags/{name}")
    rig = EXAMPLES / f"{name}.rig.yaml"
    _, estimate = optimise(tmp_path, folder / f"{name}.mcap", rig, "--frame", "world")
    miss, common = rms_to(trajectory(folder / "reference_tum.txt"), estimate)
    assert common >= poses
    assert miss < 0.010


def test_no_frame_world_without_a_board_for_it(tmp_path):
    folder = real_data("stereo_tags/collinear")
    rig = load_rig(EXAMPLES / "collinear.rig.yaml")
    (tmp_path / "rig.yaml").write_text(dump_rig(rig.model_copy(update={"world_board": None})))
    arguments = ["--rig", tmp_path / "rig.yaml", "--tum", tmp_path / "m.tum", "--frame", "world"]
    command = ["optimise", *map(str, [folder / "collinear.mcap", *arguments])]
    done = CliRunner().invoke(application(["optimise"]), command)
    assert "world_board" in str(done.exception)
    assert not (tmp_path / "m.tum").exists()


# KITTI and Kinect -------------------------------------------------------------------------------------------------


def test_drive(tmp_path):
    log = real_data("kitti/kitti1.mcap")
    result, _ = optimise(tmp_path, log, EXAMPLES / "kitti.rig.yaml")
    truth = {m.stamp_ns: m.body.matrix for m in LogReader(log, ["/truth/pose/m"]) if isinstance(m.body, PoseBody)}
    stamps = sorted(truth)
    found = {p["stamp_ns"]: np.array(p["matrix"]) for p in result["trajectory"]}
    assert sorted(found) == stamps
    path = sum(np.linalg.norm(truth[b][:3, 3] - truth[a][:3, 3]) for a, b in pairwise(stamps))
    start_T_end = np.linalg.inv(truth[stamps[0]]) @ truth[stamps[-1]]
    assert np.linalg.norm(start_T_end[:3, 3] - found[stamps[-1]][:3, 3]) < 0.01 * path
    turns = [
        Rotation.from_matrix((np.linalg.inv(truth[a]) @ truth[b])[:3, :3]).inv()
        * Rotation.from_matrix((np.linalg.inv(found[a]) @ found[b])[:3, :3])
        for a, b in pairwise(stamps)
    ]
    # The truth of the first second is interpolated: its turns are all the same.
    assert np.rad2deg(np.mean([turn.magnitude() for turn in turns])) < 0.05
    assert np.rad2deg(np.mean([turn.magnitude() for turn in turns[12:]])) < 0.03


def test_kitchen_becomes_a_cloud():
    camera, depths, stamp_ns = None, [], 0
    for message in LogReader(real_data("kinect/kitchen.mcap"), ["/b/depth/image_raw", "/b/depth/camera_info"]):
        if isinstance(message.body, CameraInfoBody):
            camera = dataclasses.replace(message.body.camera, name="b_depth")
        elif isinstance(message.body, DepthBody):
            depths.append(message.body.depth_m())
            stamp_ns = message.stamp_ns
        if len(depths) == 2 and camera is not None:
            break
    assert camera is not None
    frame = CloudFrontEnd(camera, "kinect_v1").process(stamp_ns, average_depth(np.stack(depths)), len(depths))
    assert frame is not None
    assert len(frame.points_m) > 500
    assert 1.0 < np.median(frame.points_m[:, 2]) < 2.8
    np.testing.assert_allclose(np.linalg.norm(frame.normals, axis=1), 1.0, atol=1e-6)
    assert (frame.sigma_m > 0).all()
    assert np.median(frame.sigma_m) < 0.03


def kitchen_errors(path):
    """Stamps, and the distances of a path from the reference: from the first pose on, and aligned; rms, m."""
    log = real_data("kinect/kitchen.mcap")
    true = {m.stamp_ns: np.asarray(m.body.matrix) for m in LogReader(log, ["/truth/pose/b"])}
    stamps = sorted(true)
    first = np.linalg.inv(true[stamps[0]])
    reference = np.array([(first @ true[s])[:3, 3] for s in stamps])
    assert path.shape == reference.shape
    rms = np.sqrt(((path - reference) ** 2).sum(axis=1).mean())
    rotation, _ = Rotation.align_vectors(reference - reference.mean(0), path - path.mean(0))
    left = reference - reference.mean(0) - rotation.apply(path - path.mean(0))
    return stamps, first @ true[stamps[-1]], rms, np.sqrt((left**2).sum(axis=1).mean())


def test_kitchen_path_by_depth_alone(tmp_path):
    log, out = real_data("kinect/kitchen.mcap"), tmp_path / "kitchen.tum"
    depthpath(log, out, EXAMPLES / "kitchen.rig.yaml")
    rows = np.loadtxt(out)
    stamps, _, rms, aligned = kitchen_errors(rows[:, 1:4])
    np.testing.assert_allclose(rows[:, 0], np.array(stamps) * 1e-9, atol=1e-6)
    assert rms < 0.0315  # KISS-ICP on the same frames: 63 mm, 39 mm aligned
    assert aligned < 0.0195


def test_kitchen_is_estimated_from_depth_alone(tmp_path):
    found = from_depth_alone(real_data("kinect/kitchen.mcap"), EXAMPLES / "kitchen.rig.yaml")
    stamps, end, rms, aligned = kitchen_errors(np.array([pose.matrix[:3, 3] for pose in found.trajectory]))
    assert [pose.stamp_ns for pose in found.trajectory] == stamps
    assert {pose.name for pose in found.trajectory} == {"b"}
    assert rms < 0.0315
    assert aligned < 0.0195
    assert [event.kind for event in found.events] == ["depth_alone"]
    last = found.poses[0]
    turn = Rotation.from_matrix(end[:3, :3] @ last.matrix[:3, :3].T).as_rotvec()
    error = np.concatenate([end[:3, 3] - last.matrix[:3, 3], turn])
    assert error @ np.linalg.solve(last.covariance, error) < chi2.ppf(0.999, 6)
    write_result(tmp_path / "kitchen.estimate.mcap", found)
    assert len(list(LogReader(tmp_path / "kitchen.estimate.mcap", ["/estimate/pose/b"]))) == 120
