"""The parts of the stream by themselves: order of live messages, health by name, poses between keyframes, trust."""

import os
import time
from dataclasses import replace
from functools import partial

import gtsam
import numpy as np
import pytest
from stream_messages import LEFT, MS, RIG, RIGHT, START, image

from surecut.estimator.aside import Aside
from surecut.estimator.decision import Decision
from surecut.estimator.observability import Undetermined
from surecut.estimator.stream.follower import Follower
from surecut.estimator.stream.ordering import LiveOrder
from surecut.estimator.stream.settings import StreamSettings
from surecut.estimator.stream.thinning import Thinning
from surecut.estimator.stream.trust import EXPIRED, grown, verdict_of
from surecut.estimator.stream.wire import Frame, Place
from surecut.factors import keys
from surecut.factors.errors import SurecutError
from surecut.factors.measurements import StereoFrame
from surecut.factors.rig import Cut
from surecut.io.messages import Message, PickBody
from surecut.io.pairing import StereoPair


def click(stamp_ms, name="P1", camera="m_left"):
    stamp = START + stamp_ms * MS if stamp_ms is not None else 0
    return Message(RIG.picks_topic, START, stamp, camera, PickBody(camera, name, "cut", np.ones(2), 1.0))


class Feed:
    """An order with a clock, ms."""

    def __init__(self):
        self.order = LiveOrder(RIG, 100 * MS)
        self.pairs = []
        self.clicks = []

    def add(self, message, now_ms):
        self.take(self.order.add(message, START + round(now_ms * MS)))

    def tick(self, now_ms):
        self.take(self.order.due(START + round(now_ms * MS)))

    def take(self, groups):
        for group in groups:
            stamp = (group[0].stamp_ns - START) // MS
            if isinstance(group[0], StereoPair):
                self.pairs.append(stamp)
            found = [i.body.point_id for i in group if isinstance(i, Message) and isinstance(i.body, PickBody)]
            if found:
                self.clicks.append((stamp, isinstance(group[0], StereoPair), found))

    def pair(self, stamp_ms, now_ms):
        self.add(image(LEFT, stamp_ms), now_ms)
        self.add(image(RIGHT, stamp_ms), now_ms)

    def steady(self, count):
        for i in range(count):
            self.pair(50 * i, 50 * i + 5)
            self.tick(50 * i + 6)
        return 50 * count


def test_whole_pairs_in_rhythm_pass_at_once():
    feed = Feed()
    at = feed.steady(6)
    assert feed.pairs == [0, 50, 100, 150, 200, 250][: len(feed.pairs)]
    before = len(feed.pairs)
    feed.pair(at, at + 5)
    feed.tick(at + 6)
    assert len(feed.pairs) == before + 1
    assert feed.pairs[-1] == at


def test_late_frame_inside_the_window_keeps_its_place():
    feed = Feed()
    at = feed.steady(6)
    feed.pair(at + 50, at + 55)  # the one before is missing
    feed.tick(at + 70)
    assert at + 50 not in feed.pairs
    feed.pair(at, at + 90)
    feed.tick(at + 91)
    assert feed.pairs[-2:] == [at, at + 50]
    assert feed.order.counts["late"] == 0


def test_missing_frame_is_waited_for_no_longer_than_the_window():
    feed = Feed()
    at = feed.steady(6)
    feed.pair(at + 50, at + 55)
    feed.tick(at + 156)
    assert feed.pairs[-1] == at + 50
    feed.pair(at, at + 170)
    feed.tick(at + 300)
    assert at not in feed.pairs
    assert feed.order.counts["late"] == 2


def test_half_a_pair_is_counted():
    feed = Feed()
    at = feed.steady(6)
    feed.add(image(LEFT, at), at + 5)
    feed.tick(at + 120)
    assert feed.order.counts["unpaired"] == 1


def test_click_joins_its_frame_or_comes_as_a_late_one():
    feed = Feed()
    at = feed.steady(4)
    feed.add(click(at), at)
    feed.add(click(50, "P2"), at + 1)
    feed.add(click(50, "P3"), at + 2)
    feed.tick(at + 30)
    feed.pair(at, at + 31)
    feed.tick(at + 32)
    assert (50, False, ["P2", "P3"]) in feed.clicks
    assert (at, True, ["P1"]) in feed.clicks


def test_click_in_an_old_picture_is_believed():
    feed = Feed()
    now = feed.steady(300)
    feed.add(click(1000), now)  # fourteen seconds ago
    feed.tick(now + 30)
    assert feed.clicks == [(1000, False, ["P1"])]
    assert feed.order.counts["stamp_outlier"] == 0
    assert feed.order.strays() == {}


def test_stamp_from_the_future_stops_nothing_and_a_set_clock_is_followed():
    feed = Feed()
    at = feed.steady(6)
    feed.add(image(LEFT, at + 3_600_000), at)
    feed.pair(at, at + 5)
    feed.tick(at + 6)
    assert feed.pairs[-1] == at
    assert feed.order.counts["stamp_outlier"] == 1
    for i in range(12):  # the camera's clock was set back by an hour
        feed.pair(at + 50 * i - 3_600_000, at + 50 * i)
    feed.tick(at + 1000)
    assert feed.order.counts["clock_jumps"] == 1
    assert feed.pairs[-1] == at + 550 - 3_600_000


# Poses and trust ------------------------------------------------------------------------------------------------------


def step(x_m):
    return gtsam.Pose3(gtsam.Rot3(), np.array([x_m, 0.0, 0.0])).matrix()


def frame(number, keyframe=False, lost=False):
    return Frame(START + number * 50 * MS, step(0.01), keyframe, lost, 50)


def test_pose_between_keyframes_and_its_covariance():
    follower = Follower()
    assert follower.frame(frame(0, True)) is None
    follower.frame(frame(1))
    own = 1e-6 * np.eye(6)
    placed = follower.anchor(START, Place(step(1.0), own))
    np.testing.assert_allclose(placed.matrix, step(1.01), atol=1e-12)
    sizes = [np.trace(placed.covariance)]
    for i in range(2, 6):
        followed = follower.frame(frame(i, keyframe=True))
        np.testing.assert_allclose(followed.matrix, step(1.0 + 0.01 * i), atol=1e-12)
        sizes.append(np.trace(followed.covariance))
    assert (np.diff(sizes) > 0).all()
    lost = follower.frame(frame(6, lost=True))
    assert np.sqrt(lost.covariance[3, 3]) > 0.02  # half a metre per second, for a twentieth


def test_keyframe_in_the_making_has_a_pose_and_counts_once():
    follower = Follower()
    follower.frame(frame(0, True))
    follower.anchor(START, Place(step(1.0), 1e-6 * np.eye(6)))
    early = follower.frame(replace(frame(1), early=True))
    np.testing.assert_allclose(early.matrix, step(1.01), atol=1e-12)
    assert early.stamp_ns == frame(1).stamp_ns
    again = follower.anchor(START, Place(step(2.0), 1e-6 * np.eye(6)))  # meanwhile the graph knows better
    np.testing.assert_allclose(again.matrix, step(2.01), atol=1e-12)
    assert again.stamp_ns == frame(1).stamp_ns
    done = follower.frame(replace(frame(1, keyframe=True), last_T_this=step(0.012)))
    np.testing.assert_allclose(done.matrix, step(2.012), atol=1e-12)
    assert np.trace(done.covariance) > np.trace(early.covariance)
    np.testing.assert_allclose(follower.frame(frame(2)).matrix, step(2.022), atol=1e-12)


def test_wrong_motions_widen_the_pose():
    good, bad = Follower(), Follower()
    for follower, off in ((good, 0.0), (bad, 0.02)):
        for i in range(60):
            follower.frame(frame(i, keyframe=True))
            # the graph says that each step went aside too, one to the left, the next one to the right
            placed = step(0.01 * i)
            placed[1, 3] = off * (i % 2)
            follower.anchor(frame(i).stamp_ns, Place(placed, 1e-8 * np.eye(6)))
    sizes = [np.sqrt(f.frame(frame(60, keyframe=True)).covariance[3, 3]) for f in (good, bad)]
    assert sizes[1] == pytest.approx(0.02 / np.sqrt(3), rel=0.15)
    assert sizes[0] < 0.2 * sizes[1]


@pytest.mark.parametrize("longer", [0.9, 1.0, 1.1])
def test_ways_that_are_all_too_short_are_made_longer(longer):
    """A depth that always reads short makes every way short: the graph knows, and the pose in between follows it."""
    follower = Follower()
    for i in range(60):
        follower.frame(Frame(START + i * 50 * MS, step(0.1), True, False, 50))
        follower.anchor(START + i * 50 * MS, Place(step(0.1 * longer * i), 1e-8 * np.eye(6)))
    followed = follower.frame(Frame(START + 60 * 50 * MS, step(0.1), True, False, 50))
    assert followed.matrix[0, 3] == pytest.approx(6.0 * longer, abs=0.001)
    assert np.sqrt(followed.covariance[3, 3]) < 0.01
    new = Follower()  # one that has not compared anything yet knows that it may be wrong by as much
    new.anchor(START, Place(step(0.0), 1e-8 * np.eye(6)))
    sigma = np.sqrt(new.frame(Frame(START + 50 * MS, step(0.1), True, False, 50)).covariance[3, 3])
    assert sigma == pytest.approx(0.05 * 0.1, rel=0.1)


def test_covariance_grows_as_its_formula_says():
    settings = StreamSettings(unseen_walk_m_per_root_s=0.001, unseen_turn_rad_per_root_s=0.01)
    covariance = grown(np.zeros((3, 3)), np.array([0.0, 0.0, 2.0]), 4.0, settings)
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), [np.hypot(0.002, 0.04)] * 2 + [0.002], rtol=1e-9)


def test_points_creep_together():
    """The joint covariance of two points holds each one's own, and the machine's creep in both alike."""
    settings = StreamSettings(unseen_walk_m_per_root_s=0.001, unseen_turn_rad_per_root_s=0.01)
    places = np.array([[0.0, 0.0, 2.0], [0.1, -0.2, 1.5]])
    joint = grown(np.zeros((6, 6)), places, 4.0, settings)
    for i in range(2):
        own = joint[3 * i : 3 * i + 3, 3 * i : 3 * i + 3]
        np.testing.assert_allclose(own, grown(np.zeros((3, 3)), places[i], 4.0, settings), atol=1e-15)
    apart = np.hstack([np.eye(3), -np.eye(3)])
    walk_only = grown(np.zeros((6, 6)), places, 4.0, replace(settings, unseen_turn_rad_per_root_s=0.0))
    np.testing.assert_allclose(apart @ walk_only @ apart.T, 0.0, atol=1e-15)
    assert np.linalg.eigvalsh(joint).min() > -1e-15


@pytest.mark.parametrize("apart", [False, True])
def test_work_aside_comes_back_or_says_why(apart):
    aside, state = Aside(apart), [1]

    def result():
        until = time.monotonic() + 10
        while (found := aside.taken()) is None and time.monotonic() < until:
            time.sleep(0.01)
        return found

    def work():
        state.append(2)
        return b"x" * 300_000 + bytes(state)

    aside.begin(work)
    assert aside.busy()
    assert result() == b"x" * 300_000 + b"\x01\x02"
    assert state == ([1] if apart else [1, 2])  # a copy changes nothing here
    assert not aside.busy()
    for error, told in (
        (Undetermined(keys.landmark(7)), "landmark 7"),
        (ZeroDivisionError("by nothing"), "by nothing"),
    ):
        aside.begin(partial(throw, error))
        with pytest.raises(SurecutError, match=told):
            result()
    if apart:
        aside.begin(lambda: os._exit(3))
        with pytest.raises(SurecutError, match="died"):
            result()
        aside.begin(lambda: time.sleep(60))
        aside.stop()
    assert not aside.busy()


def throw(error):
    raise error


def test_verdict_expires():
    cut = Cut(point="P1", tolerance_along_m=0.01, tolerance_across_m=0.01, board_age_limit_s=30.0)
    decision = Decision(cut, "GO", "Cut P1.", 0.99, 0.95, 1.0, (), (), 2.0, START + 30_000 * MS)
    assert verdict_of(decision, START + 29_000 * MS)[0] == "GO"
    assert verdict_of(decision, START + 31_000 * MS)[0] == EXPIRED
    assert verdict_of(replace(decision, expires_ns=None), START)[0] == EXPIRED
    assert verdict_of(None, START)[0] == "MEASURE MORE"


class Behind:
    """A queue that so many wait in."""

    backlog = 0

    def qsize(self):
        return self.backlog


def moved(number, keyframe=False, lost=False):
    none, covariance = np.empty((0, 2)), np.empty((0, 2, 2))
    seen = np.empty(0, int), none, covariance, none, covariance
    return StereoFrame(START + number * 50 * MS, keyframe, *seen, step(0.01), 50, lost)


def offered(backlogs, patient=False):
    """What is handed on of one frame for each backlog: every second is a keyframe, number 21 lost its tracks."""
    queue, found = Behind(), []
    thinning = Thinning(queue, StreamSettings(), patient)
    for i, queue.backlog in enumerate(backlogs):
        found.append(thinning.offered(moved(i, keyframe=i % 2 == 0, lost=i == 21), dear=i == 33))
    return [frame for frame in found if frame is not None], thinning


def test_who_does_not_keep_up_gets_fewer_frames_and_the_whole_motion():
    frames, thinning = offered([0] * 10 + [100] * 30)
    assert [f.stamp_ns for f in frames[:10]] == [START + i * 50 * MS for i in range(10)]
    late = [f for f in frames[10:] if f.stamp_ns != START + 33 * 50 * MS]
    assert all(f.is_keyframe for f in late)
    assert 2 <= len(late) <= 3  # half a second apart
    assert len(late) == len(frames) - 11  # and the one that is dear
    went = sum(f.last_T_this[0, 3] for f in frames)
    assert went == pytest.approx(0.01 * (1 + (frames[-1].stamp_ns - START) / 50 / MS))
    assert [f.lost for f in frames].count(True) == 1
    assert thinning.taken() == 40 - len(frames)
    assert thinning.taken() == 0


def test_patient_senders_are_never_thinned():
    assert len(offered([199] * 40, patient=True)[0]) == 40
