"""A restart where no board is in view: the camera finds itself by the landmarks of before, and knows how well."""

import base64
import json
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import gtsam
import numpy as np
import pytest

from surecut.estimator.album import KEPT_PATCHES, KEPT_PLACES, MOST_PATCHES, MOST_PLACES, Album
from surecut.estimator.items import wanted_topics
from surecut.estimator.optimise import rig_of
from surecut.estimator.sensing import Sensing
from surecut.estimator.stream.drift import Drift, departure
from surecut.estimator.stream.graph_loop import GraphLoop
from surecut.estimator.stream.memory import JOINT_LANDMARKS, MemoryFileError, from_json, recall, remember, to_json
from surecut.estimator.stream.memory_atlas import from_data, to_data
from surecut.estimator.stream.settings import StreamSettings
from surecut.factors import keys
from surecut.frontends.stereo.atlas import Atlas, AtlasPlace, AtlasTracks
from surecut.frontends.stereo.tracks import CROP_SIDE
from surecut.io.reader import LogReader
from surecut.simulation.campaign_pixels import truth_of_log

SAMPLE = Path(__file__).parents[1] / "logs" / "sample.mcap"
S = 1_000_000_000
ENDS_S, BEGINS_S = 7.5, 7.6
NEES95 = 12.59
"""Chi-square of six degrees of freedom."""


# The album ------------------------------------------------------------------------------------------------------------


def tracks(ids):
    n = len(ids)
    points = np.column_stack([np.zeros((n, 2)), np.full(n, 1.5)])
    poses, crops = np.tile(np.eye(4), (n, 1, 1)), np.full((n, CROP_SIDE, CROP_SIDE), 7, np.uint8)
    ids = np.array(ids, np.int64)
    return AtlasTracks(ids, points, points, poses, np.zeros((n, 2)), crops, np.full(n, 2))


def place(ids):
    n = len(ids)
    points = np.column_stack([np.zeros((n, 2)), np.ones(n)])
    thumbnail = np.zeros((30, 40), np.float32)
    return AtlasPlace(np.eye(4), thumbnail, np.array(ids, np.int64), points, np.zeros((n, 32), np.uint8))


def test_album_keeps_what_shows_the_most_and_no_more_than_its_bounds():
    album, views = Album(), {}
    for k in range(200):  # each place shows half of what the one before did, and something new
        ids = list(range(20 * k, 20 * k + 40))
        album.add(Atlas((place(ids),), tracks(ids[20:])), views.keys())
        views |= dict.fromkeys(ids, 3)
    assert len(album._places) <= MOST_PLACES
    assert len(album._patches) <= MOST_PATCHES
    atlas, joint = album.chosen(views, 100)
    assert len(atlas.places) == KEPT_PLACES
    assert len(atlas.tracks) == KEPT_PATCHES
    shown = [set(p.ids.tolist()) for p in atlas.places]
    assert all(not a & b for a, b in pairwise(shown))  # none that only repeats another
    assert len(joint) == 100
    assert joint == atlas.tracks.ids[:100].tolist()
    assert min(len(s.intersection(joint)) for s in shown) >= 3  # each has its share


def test_album_keeps_nothing_that_the_map_does_not_know():
    album = Album()
    album.add(Atlas((place(range(40)),), tracks(range(40))))
    assert not album.chosen({}, 100)[0]
    assert not album.chosen(dict.fromkeys(range(5), 3), 100)[0]  # too few to place a camera
    atlas, joint = album.chosen(dict.fromkeys(range(15), 3) | dict.fromkeys(range(15, 40), 1), 10)
    assert sorted(atlas.tracks.ids.tolist()) == list(range(15))
    assert len(joint) == 10


# The file -------------------------------------------------------------------------------------------------------------


def test_atlas_survives_the_file():
    atlas = Atlas((place([3, 5, 8]), place([5, 9])), tracks([3, 5, 8, 9]))
    again = from_data(json.loads(json.dumps(to_data(atlas))))
    for name in ("ids", "points", "patch_points", "patch_poses", "slopes", "crops", "views"):
        np.testing.assert_array_equal(getattr(again.tracks, name), getattr(atlas.tracks, name))
    for a, b in zip(again.places, atlas.places, strict=True):
        for name in ("chain_T_keyframe", "thumbnail", "ids", "points", "descriptors"):
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
    assert again.next_id() == 10


def coded(values, kind="<f8"):
    return base64.b64encode(np.asarray(values, kind).tobytes()).decode()


BAD = [
    ("tracks", "ids", coded([3, 3], "<i8")),
    ("tracks", "ids", coded([-1, 5], "<i8")),
    ("tracks", "ids", coded([3, 1 << 60], "<i8")),
    ("tracks", "points", coded(np.full((2, 3), np.nan))),
    ("tracks", "points", coded(np.full((2, 3), 1e300))),
    ("tracks", "points", coded(np.zeros((1, 3)))),
    ("tracks", "patch_points", coded(-np.ones((2, 3)))),
    ("tracks", "patch_poses", coded(2 * np.tile(np.eye(4), (2, 1, 1)))),
    ("tracks", "patch_poses", coded(np.tile(np.diag([1.0, 1.0, -1.0, 1.0]), (2, 1, 1)))),
    ("tracks", "crops", "no base64"),
    ("tracks", "crops", coded(np.zeros(17), "<u1")),
    ("tracks", "slopes", 5),
    ("tracks", "views", None),
    ("places", "thumbnail", coded(np.full((30, 40), np.inf), "<f4")),
    ("places", "descriptors", coded(np.zeros((3, 31)), "<u1")),
    ("places", "ids", coded(np.arange(20_000), "<i8")),
    ("places", "pose", coded(np.zeros((4, 4)))),
]


@pytest.mark.parametrize(("part", "name", "value"), BAD)
def test_damaged_atlas_is_refused(part, name, value):
    data = to_data(Atlas((place([3, 5, 8]),), tracks([3, 5])))
    target = data["tracks"] if part == "tracks" else data["places"][0]
    target[name] = value
    with pytest.raises((ValueError, KeyError, TypeError)):
        from_data(data)


@pytest.mark.parametrize("data", [None, 5, "x", [], {}, {"tracks": 1, "places": []}, {"tracks": {}, "places": {}}])
def test_nonsense_is_refused(data):
    with pytest.raises((ValueError, KeyError, TypeError)):
        from_data(data)


# A restart on pixels --------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def rig():
    with LogReader(SAMPLE) as reader:
        return rig_of(reader, None)


def moments(rig, sensing):
    """Groups of messages with their time since the start, s."""
    start = None
    for group in sensing.groups(LogReader(SAMPLE, wanted_topics(rig))):
        start = group[0].stamp_ns if start is None else start
        yield (group[0].stamp_ns - start) / S, group


@pytest.fixture(scope="module")
def first_life(rig):
    """A stream that is killed, and the keyframe that it did not see any more."""
    sensing, loop = Sensing(rig), GraphLoop(rig, StreamSettings(), lambda answer: None)
    for at_s, group in moments(rig, sensing):
        sensed = sensing.process(group)
        if at_s <= ENDS_S:
            loop.take(sensed)
        elif sensed.bundle.frame is not None and sensed.bundle.frame.is_keyframe:
            return loop, sensed.bundle.frame
    raise AssertionError("no keyframe after the end")


@pytest.fixture(scope="module")
def checkpoint(first_life):
    """As it was written."""
    memory = remember(first_life[0].engine)
    assert memory is not None
    return to_json(memory, "")


def restarted(rig, memory):
    """Answers at the keyframes that the graph has placed, and the loop."""
    answers = []
    sensing, loop = Sensing(rig, memory.atlas), GraphLoop(rig, StreamSettings(), answers.append, memory)
    placed = []
    for at_s, group in moments(rig, sensing):
        if at_s < BEGINS_S:
            sensing.calibrate(group)
            continue
        before = loop.engine.odometry.last_keyframe
        sensed = sensing.process(group)
        assert not [s for s in sensed.bundle.sightings if s.camera != "b_rgb"]  # no board is in view
        loop.take(sensed)
        if loop.engine.odometry.last_keyframe > before:
            loop.mark_changed()
            placed.append(loop.answer(sensed.stamp_ns))
    return placed, loop


def test_camera_finds_itself_by_landmarks(rig, checkpoint):
    memory = from_json(checkpoint)
    placed, loop = restarted(rig, memory)
    assert len(placed) >= 3
    assert not loop.engine.astray
    truth = truth_of_log(SAMPLE)
    true = dict(zip(truth.stamps_ns, truth.o_T_m, strict=True))
    for answer in placed:
        found = answer.places["m"]
        off = gtsam.Pose3.Logmap(gtsam.Pose3(found.matrix).between(gtsam.Pose3(true[answer.keyframe_ns])))
        assert off @ np.linalg.solve(found.covariance, off) < NEES95
        assert np.linalg.norm(off[3:]) < 0.02
    begun = memory.prior.at.atPose3(keys.base(0)).matrix()
    np.testing.assert_allclose(placed[-1].places["b"].matrix, begun, atol=0.01)  # the same {o}
    again = remember(loop.engine)
    assert again is not None
    kept = set(memory.atlas.tracks.ids.tolist())
    assert len(kept & set(again.atlas.tracks.ids.tolist())) > 0.8 * len(kept)  # it could be killed again
    assert again.atlas.next_id() > memory.atlas.next_id()  # no id is given twice


def test_without_landmarks_it_waits_for_a_board(rig, checkpoint):
    placed, loop = restarted(rig, replace(from_json(checkpoint), atlas=Atlas()))
    assert not placed
    assert loop.engine.astray


def test_nothing_is_learned_from_a_restart_alone(rig, checkpoint):
    """Killed again before it has seen anything, it remembers neither more nor less."""
    memory = from_json(checkpoint)
    assert sum(keys.kind(k) == "l" for k in memory.prior.keys) == JOINT_LANDMARKS
    loop = GraphLoop(rig, StreamSettings(), lambda answer: None, memory)
    again = remember(loop.engine)
    assert again is not None
    order = np.concatenate([columns(memory.prior)[key] for key in again.prior.keys])
    assert set(again.prior.keys) == set(memory.prior.keys)
    scale = np.sqrt(np.diag(again.prior.H))
    np.testing.assert_allclose(
        again.prior.H / np.outer(scale, scale), memory.prior.H[np.ix_(order, order)] / np.outer(scale, scale), atol=1e-6
    )
    assert set(again.atlas.tracks.ids.tolist()) == set(memory.atlas.tracks.ids.tolist())
    assert len(again.atlas.places) == len(memory.atlas.places)


def columns(prior):
    ends = np.cumsum(prior.widths)
    return {key: np.arange(end - width, end) for key, end, width in zip(prior.keys, ends, prior.widths, strict=True)}


def test_checkpoint_is_small_and_damage_gives_one_line(rig, checkpoint):
    assert len(checkpoint) < 5_000_000
    data = json.loads(checkpoint)
    for spoil in (
        lambda d: d["atlas"]["tracks"].update(crops="AAAA"),
        lambda d: d["atlas"].pop("places"),
        lambda d: d.update(atlas=[1, 2]),
        lambda d: d.update(laid="x"),
        lambda d: d.update(shared=[[1]]),
        lambda d: d.update(surecut_memory=9),
        lambda d: d.update(information=d["information"][:-8]),
    ):
        spoilt = json.loads(checkpoint)
        spoil(spoilt)
        with pytest.raises(MemoryFileError) as told:
            from_json(json.dumps(spoilt))
        assert "\n" not in str(told.value)
        assert "remove it" in str(told.value)
    del data["atlas"], data["laid"], data["shared"]
    data["surecut_memory"] = 1  # one of before landmarks were kept still serves
    old = from_json(json.dumps(data))
    loop = GraphLoop(rig, StreamSettings(), lambda answer: None)
    recall(loop.engine, old)
    assert loop.engine.astray


# A pair that has been knocked -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("shift_px", [(0.4, 0.0), (-0.4, 0.0), (0.0, 0.4), (3.0, -1.0)])
def test_pair_that_has_moved_is_told_at_the_next_keyframe(first_life, shift_px):
    loop, frame = first_life
    found = departure(loop.engine, replace(frame, right_px=frame.right_px + shift_px))
    np.testing.assert_allclose(found.shift_px, shift_px, atol=0.1)
    assert "has moved" in found.told()


def test_pair_that_stands_is_not_told(first_life):
    loop, frame = first_life
    assert departure(loop.engine, frame).told() is None
    drift = Drift(loop.engine)
    assert not drift.see(frame)
    assert drift.see(replace(frame, right_px=frame.right_px + 1.0))
    assert [event.kind for event in drift.suspects] == ["calibration_drift"]
    assert not drift.see(replace(frame, stamp_ns=frame.stamp_ns + 30 * S))
    assert drift.suspects  # a graph that is half-way in between is no better
    assert drift.see(replace(frame, stamp_ns=frame.stamp_ns + 61 * S))
    assert not drift.suspects


def test_map_that_the_right_image_does_not_show_is_told_but_not_a_covered_lens(first_life):
    loop, frame = first_life
    known = np.isin(frame.track_ids, [*loop.engine.odometry.observations])
    assert known.sum() > 12
    nothing_known = replace(frame, right_px=np.where(known[:, None], np.nan, frame.right_px))
    assert "nothing of the map" in departure(loop.engine, nothing_known).told()
    covered = replace(frame, right_px=np.full_like(frame.right_px, np.nan))
    assert departure(loop.engine, covered) is None
