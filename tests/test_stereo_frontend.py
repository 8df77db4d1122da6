"""The stereo front end on rendered rooms with known motion, and on a real drive."""

from dataclasses import replace
from itertools import pairwise

import cv2
import numpy as np
import pytest
from stereo_scene import BASELINE, HEIGHT, WIDTH, K, Room, camera, expose, left_T_right, pose, texture

from surecut.frontends.stereo.frontend import StereoFrontEnd
from surecut.frontends.stereo.geometry import exponential
from surecut.frontends.stereo.settings import StereoSettings
from surecut.frontends.undistort import undistort

STEP_NS = 50_000_000


def walk(t):
    """About 0.5 m/s and 25 degrees/s at most."""
    return pose(
        0.35 * np.sin(1.2 * t),
        0.1 * np.sin(1.5 * t),
        0.05 * np.sin(t),
        (0.3 * np.sin(1.4 * t), 0.1 * np.sin(2 * t), 0.3 * np.sin(t) - 1.0),
    )


@pytest.fixture(scope="module")
def rendered():
    """Poses and noise-free pairs of two seconds."""
    room = Room()
    poses = [walk(0.05 * i) for i in range(40)]
    return poses, [room.pair(o_T_m) for o_T_m in poses]


DENSE = StereoSettings(
    focal_sigma_rel=0.0,
    centre_sigma_px=0.0,
    keyframe_parallax=0.05,
    keyframe_rotation_rad=0.12,
    keyframe_share=0.75,
    min_tracks=90,
)
"""Keyframes enough in a walk of two seconds for statistics over them."""


def front_end(settings=DENSE):
    return StereoFrontEnd(camera(), camera("m_right"), left_T_right(), settings)


def run(pairs, noise=2.0, gain=1.0, seed=0, front=None):
    rng = np.random.default_rng(seed)
    front = front or front_end()
    return [
        front.process((i + 1) * STEP_NS, expose(left, rng, noise, gain), expose(right, rng, noise, gain))
        for i, (left, right, _) in enumerate(pairs)
    ]


def test_a_pair_whose_place_matters_is_a_keyframe(rendered):
    _, pairs = rendered
    front, rng = front_end(), np.random.default_rng(5)
    frames = [
        front.process((i + 1) * STEP_NS, expose(left, rng, 2.0, 1.0), expose(right, rng, 2.0, 1.0), wanted=i == 2)
        for i, (left, right, _) in enumerate(pairs[:4])
    ]
    assert [frame.is_keyframe for frame in frames] == [True, False, True, False]
    assert np.isfinite(frames[2].right_px[:, 0]).sum() > 30


def chained(frames):
    poses = [np.eye(4)]
    for frame in frames[1:]:
        poses.append(poses[-1] @ frame.last_T_this)
    return poses


def errors(frames, truth):
    """Position errors in m and rotation errors in degrees of the chained motion."""
    out = []
    for estimate, o_T_m in zip(chained(frames), truth, strict=True):
        difference = np.linalg.inv(np.linalg.inv(truth[0]) @ o_T_m) @ estimate
        angle = np.degrees(np.arccos(np.clip((np.trace(difference[:3, :3]) - 1) / 2, -1, 1)))
        out.append((np.linalg.norm(difference[:3, 3]), angle))
    return np.array(out)


def residuals(frames, truth):
    """Residuals against the point that fits a track's observations best under the true poses.

    Returns rows of (u residual, v residual, squared residual in sigmas, its expected value), and the outliers' share.
    """
    rows = []
    for views in tracks_of(frames).values():
        if len(views) < 3:
            continue
        px, weight, matrices = observations(frames, truth, views)
        point = triangulate(px, matrices)
        for _ in range(6):
            residual, jacobian = reprojection(px, matrices, point)
            square = np.einsum("ni,nij,nj->n", residual, weight, residual)
            soft = jacobian.transpose(0, 2, 1) @ weight / (1 + square / 25)[:, None, None]
            normal = (soft @ jacobian).sum(0)
            point = point + np.linalg.solve(normal, (soft @ residual[:, :, None]).sum(0)[:, 0])
        share = np.trace(jacobian @ np.linalg.inv(normal) @ jacobian.transpose(0, 2, 1) @ weight, axis1=1, axis2=2)
        rows.append(np.column_stack((residual, square, 2 - share)))
    rows = np.concatenate(rows)
    good = rows[:, 2] < 50
    return rows[good], 1 - good.mean()


def tracks_of(frames):
    views = {}
    for i, frame in enumerate(frames):
        if frame.is_keyframe:
            for j, track in enumerate(frame.track_ids.tolist()):
                views.setdefault(track, []).append((i, j))
    return views


def observations(frames, truth, views):
    px, covariance, matrices = [], [], []
    for i, j in views:
        frame, m_T_o = frames[i], np.linalg.inv(truth[i])
        px.append(frame.left_px[j])
        covariance.append(frame.left_covariance_px2[j])
        matrices.append(K @ m_T_o[:3])
        if np.isfinite(frame.right_px[j, 0]):
            px.append(frame.right_px[j])
            covariance.append(frame.right_covariance_px2[j])
            matrices.append(K @ (np.linalg.inv(left_T_right()) @ m_T_o)[:3])
    return np.array(px), np.linalg.inv(np.array(covariance)), np.array(matrices)


def triangulate(px, matrices):
    rows = np.concatenate((px[:, :1] * matrices[:, 2] - matrices[:, 0], px[:, 1:] * matrices[:, 2] - matrices[:, 1]))
    point = np.linalg.svd(rows)[2][-1]
    return point[:3] / point[3]


def reprojection(px, matrices, point):
    h = matrices @ np.append(point, 1.0)
    ideal = h[:, :2] / h[:, 2:]
    jacobian = (matrices[:, :2, :3] - ideal[:, :, None] * matrices[:, 2:, :3]) / h[:, 2, None, None]
    return px - ideal, jacobian


def blurred(pairs):
    """Motion blur over two frame intervals, exposed symmetrically about the middle one."""
    return [
        (
            (pairs[i - 1][0] + 2 * pairs[i][0] + pairs[i + 1][0]) / 4,
            (pairs[i - 1][1] + 2 * pairs[i][1] + pairs[i + 1][1]) / 4,
            pairs[i][2],
        )
        for i in range(1, len(pairs) - 1)
    ]


@pytest.mark.parametrize(("noise", "gain"), [(2.0, 1.0), (0.5, 1.0), (1.5, 0.2)], ids=["noisy", "sharp", "dark"])
def test_tracks_are_unbiased_with_believable_covariances(rendered, noise, gain):
    truth, pairs = rendered
    frames = run(pairs, noise, gain)
    rows, outliers = residuals(frames, truth)
    assert len(rows) > 800
    assert outliers < 0.01
    assert np.abs(np.mean(rows[:, :2], axis=0)).max() < 0.005
    assert np.sqrt((rows[:, :2] ** 2).mean()) < (0.12 if gain < 1 else 0.05)
    # Seven keyframes do not teach the noise model all of it: it starts on the safe side.
    assert 0.6 < rows[:, 2].sum() / rows[:, 3].sum() < 1.5


def test_motion_and_keyframes_of_a_walk(rendered):
    truth, pairs = rendered
    frames = run(pairs)
    position, angle = errors(frames, truth).T
    assert not any(frame.lost for frame in frames)
    assert position.max() < 0.008
    assert angle.max() < 0.3
    # Three to ten keyframes per second.
    assert 6 <= sum(frame.is_keyframe for frame in frames) <= 20
    for frame in frames:
        assert np.isfinite(frame.left_px).all()
        assert len(set(frame.track_ids.tolist())) == len(frame.track_ids)
        assert (np.linalg.eigvalsh(frame.left_covariance_px2) > 0).all()
        right = np.isfinite(frame.right_px[:, 0])
        assert (np.linalg.eigvalsh(frame.right_covariance_px2[right]) > 0).all()


def test_the_walk_with_the_default_keyframes(rendered):
    """Few of them, and the tracks last from one to the next."""
    truth, pairs = rendered
    frames = run(pairs, front=front_end(StereoSettings()))
    keyframes = [frame for frame in frames if frame.is_keyframe]
    assert not any(frame.lost for frame in frames)
    assert 2 <= len(keyframes) <= 8
    for before, after in pairwise(keyframes):
        assert len(set(before.track_ids.tolist()) & set(after.track_ids.tolist())) > 40
    position, angle = errors(frames, truth).T
    assert position.max() < 0.03
    assert angle.max() < 0.5


def test_blur_widens_covariances(rendered):
    truth, pairs = rendered
    frames = run(blurred(pairs))
    rows, _ = residuals(frames, truth[1:-1])
    assert 0.5 < rows[:, 2].sum() / rows[:, 3].sum() < 2.0
    assert errors(frames, truth[1:-1])[:, 0].max() < 0.03
    sharp = run(pairs)
    median = [
        np.median([np.median(f.left_covariance_px2[:, 0, 0]) for f in fs[10:] if f.is_keyframe])
        for fs in (sharp, frames)
    ]
    assert median[1] > 1.5 * median[0]


def test_a_camera_that_stands_still_stays_where_it_is(rendered):
    """For five seconds."""
    truth, pairs = rendered
    frames = run([pairs[0]] * 100)
    assert [frame.is_keyframe for frame in frames].count(True) == 1
    position, angle = errors(frames, [truth[0]] * 100).T
    assert position.max() < 0.002
    assert angle.max() < 0.1


def test_a_rig_that_is_off_keeps_its_matches(rendered):
    """Right image half a pixel down and turned by 0.2 degrees: matches stay as measured, covariances stay small."""
    truth, pairs = rendered
    turn = cv2.getRotationMatrix2D(((WIDTH - 1) / 2, (HEIGHT - 1) / 2), 0.2, 1.0)
    turn[1, 2] += 0.5
    moved = [(left, cv2.warpAffine(right, turn, (WIDTH, HEIGHT), flags=cv2.INTER_CUBIC), d) for left, right, d in pairs]
    frames = run(moved)
    assert not any(frame.lost for frame in frames)
    last = [frame for frame in frames if frame.is_keyframe][-1]
    right = np.isfinite(last.right_px[:, 0])
    assert right.sum() > 100
    vertical = (last.right_px - last.left_px)[right, 1]
    expected = 0.5 + turn[1, 0] * (last.right_px[right, 0] - (WIDTH - 1) / 2)
    assert np.abs(np.median(vertical - expected)) < 0.03
    assert np.sqrt(np.median(last.right_covariance_px2[right, 1, 1])) < 0.12
    assert errors(frames, truth)[:, 0].max() < 0.02


def test_a_distorted_lens_delivers_ideal_pixels(rendered):
    """The same walk through a lens with 6 % of barrel distortion in the corners."""
    truth, pairs = rendered
    lens = (-0.25, 0.06, 0.001, -0.001, 0.0)
    u, v = np.meshgrid(np.arange(float(WIDTH)), np.arange(float(HEIGHT)))
    ideal = undistort(camera(distortion=lens), np.stack((u.ravel(), v.ravel()), axis=1))[0].astype(np.float32)
    maps = ideal[:, 0].reshape(HEIGHT, WIDTH), ideal[:, 1].reshape(HEIGHT, WIDTH)
    bent = [
        (*(cv2.remap(image, *maps, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT) for image in pair[:2]), None)
        for pair in pairs[:24]
    ]
    front = StereoFrontEnd(camera(distortion=lens), camera("m_right", lens), left_T_right())
    frames = run(bent, front=front)
    rows, outliers = residuals(frames, truth[:24])
    assert outliers < 0.02
    assert np.abs(np.mean(rows[:, :2], axis=0)).max() < 0.02
    assert np.sqrt((rows[:, :2] ** 2).mean()) < 0.1
    assert errors(frames, truth[:24])[:, 0].max() < 0.01


def test_a_moving_arm_does_not_carry_the_camera_away():
    """A textured thing at 0.9 m runs through a view of walls at many depths while the camera stands still."""
    still = Room().pair(pose(0.7, 0.15, 0, (-0.5, 0, -0.3)))
    arm = texture(np.random.default_rng(3), 150, 80)
    disparity = round(K[0, 0] * BASELINE / 0.9)
    moving = []
    for i in range(40):
        left, right = still[0].copy(), still[1].copy()
        u = 60 + 4 * i
        left[40:190, u : u + 80] = arm
        right[40:190, u - disparity : u - disparity + 80] = arm
        moving.append((left, right, None))
    frames = run(moving)
    last = chained(frames)[-1]
    assert np.linalg.norm(last[:3, 3]) < 0.01
    assert not any(frame.lost for frame in frames)


def test_lens_covered_and_the_way_back(rendered):
    """Covered for half a second and moved meanwhile: says so, and goes on under the old ids and in the same frame."""
    truth, pairs = rendered
    black = (np.full((HEIGHT, WIDTH), 3.0), np.full((HEIGHT, WIDTH), 3.0), None)
    frames = run([*pairs[:20], *[black] * 10, *pairs[14:8:-1]])
    assert all(frame.lost for frame in frames[20:30])
    assert not any(frame.lost for frame in frames[:20])
    assert not any(frame.lost for frame in frames[31:])
    back = frames[30]
    before = {i for frame in frames[:20] for i in frame.track_ids.tolist()}
    assert len(before & set(back.track_ids.tolist())) > 25
    estimate = chained(frames)[30]
    difference = np.linalg.inv(np.linalg.inv(truth[0]) @ truth[14]) @ estimate
    assert np.linalg.norm(difference[:3, 3]) < 0.03


def test_a_strange_place_is_not_taken_for_a_known_one(rendered):
    _, pairs = rendered
    black = (np.full((HEIGHT, WIDTH), 3.0), np.full((HEIGHT, WIDTH), 3.0), None)
    elsewhere = Room(seed=7).pair(pose(2.5, 0, 0, (0, 0, 0)))
    frames = run([*pairs[:12], *[black] * 3, *[elsewhere] * 3])
    before = {i for frame in frames[:12] for i in frame.track_ids.tolist()}
    assert frames[15].lost
    assert not before & {i for frame in frames[15:] for i in frame.track_ids.tolist()}
    assert not frames[16].lost


def test_a_place_seen_again_continues_old_tracks(rendered):
    """There and back: landmarks out of sight come back under their ids, at the right pixels."""
    truth, pairs = rendered
    order = [*range(40), *range(39, -1, -1)]
    frames = run([pairs[i] for i in order])
    poses = [truth[i] for i in order]
    gone_and_back = 0
    for views in tracks_of(frames).values():
        keyframes = [i for i, frame in enumerate(frames) if frame.is_keyframe]
        seen = [keyframes.index(i) for i, _ in views]
        gone_and_back += max(np.diff(seen), default=0) > 2
    assert gone_and_back > 30
    rows, outliers = residuals(frames, poses)
    assert outliers < 0.01
    assert rows[:, 2].sum() / rows[:, 3].sum() < 1.6
    assert errors(frames, poses)[-1, 0] < 0.008


def test_a_loop_is_closed_after_a_drift(rendered):
    """The chain is put 0.4 m and 5 degrees off on the way: the way back is found by the place, not by the chain."""
    _, pairs = rendered
    order = [*range(40), *range(39, -1, -1)]
    front = StereoFrontEnd(camera(), camera("m_right"), left_T_right(), replace(DENSE, loop_ns=1_500_000_000))
    first = run([pairs[i] for i in order[:45]], front=front)
    before = {i for frame in first[:25] for i in frame.track_ids.tolist()}
    front._chain_T_keyframe = front._chain_T_keyframe @ exponential(np.array([0.0, 0.09, 0.0, 0.3, 0.1, -0.25]))
    front.finding.places._places = [place for place in front.finding.places._places if place.stamp_ns < 40 * STEP_NS]
    rng = np.random.default_rng(8)
    again = [
        front.process(i * STEP_NS, expose(pairs[order[i]][0], rng), expose(pairs[order[i]][1], rng))
        for i in range(46, len(order))
    ]
    assert not any(frame.lost for frame in again)
    living = set(first[-1].track_ids.tolist())
    assert len((before - living) & {i for frame in again for i in frame.track_ids.tolist()}) > 30


def test_landmarks_are_matched_where_an_estimate_expects_them(rendered):
    truth, pairs = rendered
    front = front_end()
    frames = run(pairs, front=front)
    keyframe = max(i for i, frame in enumerate(frames) if frame.is_keyframe)
    o_T_chain = truth[0]
    ids = front.landmarks.ids[front.landmarks.ids >= 0]
    rows = front.landmarks.rows_of(ids)
    o_p = front.landmarks.points[rows] @ o_T_chain[:3, :3].T + o_T_chain[:3, 3]
    m_T_o = np.linalg.inv(truth[keyframe])
    found, sighting = front.match_landmarks(ids, o_p @ m_T_o[:3, :3].T + m_T_o[:3, 3])
    assert set(found.tolist()) <= set(ids.tolist())
    # Landmarks shifted sideways by half a metre are in other places of the view: nothing may match there.
    nothing, _ = front.match_landmarks(ids, o_p @ m_T_o[:3, :3].T + m_T_o[:3, 3] + [0.5, 0.3, 0.0])
    assert len(nothing) == 0
    assert len(sighting.left_px) == len(found)


def test_a_blank_wall_is_admitted():
    rng = np.random.default_rng(1)
    front = front_end()
    blank = np.full((HEIGHT, WIDTH), 120.0)
    frames = [front.process(i * STEP_NS, expose(blank, rng), expose(blank, rng)) for i in range(1, 5)]
    assert all(frame.lost for frame in frames[1:])
    assert all(frame.motion_inliers == 0 for frame in frames)
    assert all(np.allclose(frame.last_T_this, np.eye(4)) for frame in frames)


def test_front_end_repeats_itself(rendered):
    _, pairs = rendered
    first, second = run(pairs[:15]), run(pairs[:15])
    for a, b in zip(first, second, strict=True):
        assert np.array_equal(a.track_ids, b.track_ids)
        assert np.array_equal(a.left_px, b.left_px)
        assert np.array_equal(a.last_T_this, b.last_T_this)
