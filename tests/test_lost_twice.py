"""Lost, a place never seen before, lost again: what lies between hangs on nothing, and harms nothing."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from surecut.estimator.bounded import Bounded
from surecut.estimator.bundle import Bundle
from surecut.estimator.engine import Engine
from surecut.estimator.limits import Limits
from surecut.estimator.refusals import everything_rejected
from surecut.estimator.run import finish
from surecut.estimator.surfaces import lay_on_surfaces
from surecut.factors import keys
from surecut.factors.camera import CameraModel
from surecut.factors.measurements import MarkerSighting, Pick, StereoFrame
from surecut.factors.rig import Board, Marker, Rig
from surecut.simulation.evaluate import pose_quantity

K = np.array([[270.0, 0.0, 179.5], [0.0, 270.0, 119.5], [0.0, 0.0, 1.0]])
BASELINE, SIGMA_PX = 0.15, 0.1
STRANGE, AGAIN, BACK, END, ROUND = 6, 10, 14, 20, 26
"""First keyframes of the strange view, after the second loss, of the return, and of a turn to the strange view; end."""
SIDE_M = 0.1
STAMPS = [10**8 * (1 + step + 20 * ((step >= STRANGE) + (step >= AGAIN))) for step in range(ROUND)]
o_T_f = np.eye(4)
o_T_f[:3, :3] = Rotation.from_rotvec([np.pi, 0, 0]).as_matrix()  # the page looks at the camera
o_T_f[:3, 3] = [0.1, 0.0, 1.6]
CENTRES = {0: (0.0, 0.0), 1: (0.15, 0.0), 2: (0.0, 0.15), 3: (0.15, 0.15)}


def camera(name, baseline=None):
    return CameraModel(name, 360, 240, K, "none", np.zeros(0), np.eye(3), baseline)


def rig():
    markers = tuple(Marker(id=i, centre_m=centre) for i, centre in CENTRES.items())
    return Rig(boards=(Board(id="page", side_m=SIDE_M, markers=markers, attached_to="world"),))


def true_pose(step):
    """Along the wall; a strange view; somewhere else that is new as well; then slowly back to where it began."""
    pose = np.eye(4)
    if step < STRANGE:
        pose[0, 3] = 0.05 * step
    elif step < AGAIN:
        pose[:3, :3] = Rotation.from_rotvec([0, 1.9, 0]).as_matrix()
        pose[:3, 3] = [0.5 + 0.05 * (step - STRANGE), 0.1, -0.2]
    elif step >= END:
        share = (step - END + 1) / (ROUND - END)
        pose[:3, :3] = Rotation.from_rotvec([0, 1.9 * share, 0]).as_matrix()
        pose[:3, 3] = [0.5 * share, 0.1 * share, -0.2 * share]
    else:
        share = max(0.0, 1 - (step - AGAIN) / (BACK + 1 - AGAIN))
        pose[:3, :3] = Rotation.from_rotvec([0, 0.9 * share, 0.1 * share]).as_matrix()
        pose[:3, 3] = [0.25 + 0.8 * share, 0.0, 0.1 * share]
    return pose


def pixels(points, pose):
    here = (points - pose[:3, 3]) @ pose[:3, :3]
    return [(here[:, :2] - [b, 0]) / here[:, 2:] * 270.0 + [179.5, 119.5] for b in (0.0, BASELINE)], here[:, 2]


def seen(points, pose, rng):
    (left, right), depth = pixels(points, pose)
    inside = ((left > 5) & (left < [355, 235]) & (right > 5) & (right < [355, 235])).all(axis=1) & (depth > 0.3)
    ids = np.flatnonzero(inside)
    noise = rng.normal(0, SIGMA_PX, (2, len(ids), 2))
    return ids, left[ids] + noise[0], right[ids] + noise[1]


def sightings(stamp_ns, pose, rng):
    found = []
    corners = 0.5 * SIDE_M * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0.0]])
    for marker, centre in CENTRES.items():
        page = corners + np.array([*centre, 0.0])
        images, depth = pixels(page @ o_T_f[:3, :3].T + o_T_f[:3, 3], pose)
        for name, px in zip(("m_left", "m_right"), images, strict=True):
            if (depth > 0.3).all() and ((px > 5) & (px < [355, 235])).all():
                px = px + rng.normal(0, SIGMA_PX, (4, 2))
                covariance = np.tile(SIGMA_PX**2 * np.eye(2), (4, 1, 1))
                found.append(MarkerSighting(stamp_ns, name, "page", marker, px, covariance, px))
    return found


def dark(engine, stamp_ns):
    """Two seconds without light."""
    none = np.zeros((0, 2))
    for _ in range(20):
        stamp_ns += 10**8
        none_seen = np.zeros(0, np.int64), none, np.zeros((0, 2, 2)), none, np.zeros((0, 2, 2))
        engine.add(Bundle(stamp_ns, StereoFrame(stamp_ns, False, *none_seen, np.eye(4), 0, lost=True)))
    return stamp_ns


def run(by_board=False, picks_at=(), strange_again=False, limits=None, end=None):
    """Before, strange and again have track names of their own: the front end knows nothing again until the return."""
    rng = np.random.default_rng(4)
    spots = rng.uniform(-1, 1, (6000, 3))
    spots = 2.5 * spots / np.abs(spots).max(axis=1, keepdims=True) * rng.uniform(0.8, 1.0, (6000, 1))
    engine = Engine(rig(), {"m_left": camera("m_left"), "m_right": camera("m_right", BASELINE)}, lay_on_surfaces)
    bounded = Bounded(engine, limits) if limits else None
    stamp_ns, last, adrift = 0, np.eye(4), []
    for step in range(end or (ROUND if strange_again else END)):
        pose = true_pose(step)
        lost = step in (STRANGE, AGAIN)
        if lost:
            stamp_ns = dark(engine, stamp_ns)
        stamp_ns += 10**8
        names, left, right = seen(spots, pose, rng)
        known = [(STRANGE <= step < AGAIN) + 2 * (step >= AGAIN)]
        known += [0] if step >= BACK and not by_board else []
        known += [1] if step >= END else []
        names = np.concatenate([names + 10_000 * part for part in known])
        left, right = np.tile(left, (len(known), 1)), np.tile(right, (len(known), 1))
        covariance = np.tile(SIGMA_PX**2 * np.eye(2) * len(known), (len(names), 1, 1))
        motion = np.eye(4) if lost else np.linalg.inv(last) @ pose
        last = pose
        frame = StereoFrame(stamp_ns, True, names, left, covariance, right, covariance, motion, len(names), lost=lost)
        boards = sightings(stamp_ns, pose, rng) if by_board and not STRANGE <= step < BACK else ()
        px = np.array([180.0, 120.0])
        clicked = tuple(Pick(stamp_ns, "m_left", p, "other", px, px, np.eye(2)) for p, at in picks_at if at == step)
        engine.add(Bundle(stamp_ns, frame, tuple(boards), clicked, {p: (2.0, 0.05) for p, _ in picks_at}))
        adrift.append(bool(engine.adrift))
        if bounded:
            bounded.tidy()
    engine.flush()
    return engine, adrift


def test_a_run_without_end_keeps_what_is_adrift():
    engine, adrift = run(True, limits=Limits(keyframes=8, step=4))
    assert adrift == [False] * STRANGE + [True] * (BACK - STRANGE) + [False] * (END - BACK)
    poses = {keys.index(key): engine.state.pose(key) for key in engine.state.values.keys() if keys.kind(key) == "x"}
    assert 0 not in poses
    assert set(range(STRANGE, AGAIN)) <= poses.keys()
    for step, pose in poses.items():
        if STRANGE <= step < AGAIN:
            continue
        off = np.linalg.inv(true_pose(step)) @ pose.matrix()
        assert np.linalg.norm(off[:3, 3]) < 0.025
        assert Rotation.from_matrix(off[:3, :3]).magnitude() < 0.015


def errors(result, step):
    """Metres, radians, and NEES per degree of freedom."""
    pose = next(p for p in result.trajectory if p.stamp_ns == STAMPS[step])
    off = np.linalg.inv(true_pose(step)) @ pose.matrix
    nees = pose_quantity("pose", "m", pose.matrix, pose.covariance, true_pose(step)).nees
    return np.linalg.norm(off[:3, 3]), Rotation.from_matrix(off[:3, :3]).magnitude(), nees / 6


def kinds(result):
    return [event.kind for event in result.events]


@pytest.mark.parametrize("by_board", [False, True])
def test_the_way_goes_on_in_the_same_frame(by_board):
    engine, adrift = run(by_board)
    assert adrift == [False] * STRANGE + [True] * (BACK - STRANGE) + [False] * (END - BACK)
    result = finish(engine)
    for step in (*range(STRANGE), *range(AGAIN, END)):
        off_m, off_rad, nees = errors(result, step)
        assert off_m < 0.015
        assert off_rad < 0.01
        assert nees < 4.0
    for step in range(STRANGE, AGAIN):
        off_m, _, nees = errors(result, step)
        assert off_m > 0.1
        assert nees < 4.0
    assert kinds(result).count("sight_lost") == 1
    assert "board_knocked" not in kinds(result)
    assert result.consistency.passed, result.consistency.reasons


def test_a_strange_view_that_is_seen_again_finds_its_place():
    engine, adrift = run(strange_again=True)
    result = finish(engine)
    assert not adrift[-1]
    assert all(errors(result, step)[0] < 0.01 for step in range(ROUND))
    assert all(errors(result, step)[2] < 4.0 for step in range(ROUND))
    assert "sight_lost" not in kinds(result)


def test_a_way_that_is_never_found_says_so_and_harms_nothing():
    engine, adrift = run(by_board=True, picks_at=[("nowhere", STRANGE + 1), ("nowhere", STRANGE + 2)], end=BACK - 1)
    assert adrift[-1]
    result = finish(engine)
    assert all(errors(result, step)[0] < 0.003 for step in range(STRANGE))
    for step in range(STRANGE, BACK - 1):
        off_m, _, nees = errors(result, step)
        assert off_m > 0.1
        assert nees < 4.0
    assert kinds(result).count("sight_lost") == 2
    assert "board_knocked" not in kinds(result)
    assert [r.what for r in result.rejected if r.reason.startswith("the camera's place")] == [
        "pick nowhere in m_left"
    ] * 2


def test_clicks_in_a_strange_view_wait_for_its_place():
    picks = [("there", 2), ("there", STRANGE + 1), ("nowhere", STRANGE + 1), ("later", AGAIN + 1)]
    engine, _ = run(picks_at=picks)
    assert sorted(engine.pipes.points) == ["later", "there"]
    assert engine.pipes.points["there"].picks == 1
    refused = [r.what for r in everything_rejected(engine) if r.reason.startswith("the camera's place is unknown")]
    assert sorted(refused) == ["pick nowhere in m_left", "pick there in m_left"]

    engine, _ = run(picks_at=picks, strange_again=True)
    assert sorted(engine.pipes.points) == ["later", "nowhere", "there"]
    assert not engine.lost_picks()
