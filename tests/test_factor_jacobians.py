"""Every Python factor's Jacobians against central differences."""

import dataclasses

import gtsam
import numpy as np
import pytest

from surecut.factors import board, cloud, keys, links, pipe
from surecut.factors.measurements import CylinderSighting
from surecut.factors.noise import gaussian, sigmas
from surecut.factors.rig import Board, Marker

RNG = np.random.default_rng(1)


def a_pose(scale=0.5):
    return gtsam.Pose3.Expmap(RNG.normal(0, scale, 6))


def retracted(values, key, delta):
    moved = gtsam.Values(values)
    step = gtsam.VectorValues()
    step.insert(key, delta)
    return moved.retract(step)


def numeric_jacobian(factor, values, key, dim):
    h = 1e-6
    columns = []
    for i in range(dim):
        delta = np.zeros(dim)
        delta[i] = h
        plus = factor.unwhitenedError(retracted_all(values, factor, key, delta))
        minus = factor.unwhitenedError(retracted_all(values, factor, key, -delta))
        columns.append((plus - minus) / (2 * h))
    return np.array(columns).T


def retracted_all(values, factor, key, delta):
    step = values.zeroVectors()
    full = gtsam.VectorValues()
    for k in values.keys():
        full.insert(k, delta if k == key else step.at(k))
    return values.retract(full)


def check(factor, values, whiten):
    gaussian_factor = factor.linearize(values)
    A, _ = gaussian_factor.jacobian()
    dims = {k: values.zeroVectors().at(k).size for k in values.keys()}
    column = 0
    for key in gaussian_factor.keys():
        dim = dims[key]
        expected = whiten(numeric_jacobian(factor, values, key, dim))
        np.testing.assert_allclose(A[:, column : column + dim], expected, atol=2e-5 * max(1, np.abs(expected).max()))
        column += dim


def whitener(model):
    return lambda J: np.column_stack([model.whiten(c) for c in J.T])


def test_page_factor():
    marker = Marker(id=3, centre_m=(0.05, -0.08), rotation_rad=0.3)
    sheet = Board(id="f0", markers=(marker,))
    values = gtsam.Values()
    values.insert(keys.board(0), a_pose())
    values.insert(keys.page(0), np.array([0.07, 1.02]))
    for i in range(4):
        values.insert(keys.corner(0, i), RNG.normal(0, 1, 3))
    factor = board.page_factor(sheet, marker, keys.board(0), keys.page(0), 0)
    check(factor, values, whitener(factor.noiseModel()))


def test_page_factor_is_zero_on_the_page():
    marker = Marker(id=3, centre_m=(0.05, -0.08), rotation_rad=0.3)
    sheet = Board(id="f0", markers=(marker,))
    o_T_f = a_pose()
    values = gtsam.Values()
    values.insert(keys.board(0), o_T_f)
    values.insert(keys.page(0), np.array([0.07, 0.97]))
    for i, corner in enumerate(board.page_corners(marker, 0.07, 0.97)):
        values.insert(keys.corner(0, i), o_T_f.transformFrom(corner))
    factor = board.page_factor(sheet, marker, keys.board(0), keys.page(0), 0)
    np.testing.assert_allclose(factor.unwhitenedError(values), 0, atol=1e-12)


@pytest.mark.parametrize("index", [0, 1])
def test_page_priors(index):
    values = gtsam.Values()
    values.insert(keys.page(0), np.array([0.07, 0.97]))
    make = [
        lambda: board.side_prior(keys.page(0), 0.075, 0.001),
        lambda: board.print_scale_prior(keys.page(0), 0.005),
    ]
    factor = make[index]()
    check(factor, values, whitener(factor.noiseModel()))


def test_centre_distance():
    values = gtsam.Values()
    for slot in (0, 1):
        for i in range(4):
            values.insert(keys.corner(slot, i), RNG.normal(0, 1, 3))
    a = [keys.corner(0, i) for i in range(4)]
    b = [keys.corner(1, i) for i in range(4)]
    factor = board.distance_factor(a, b, 1.0, sigmas([0.01]))
    check(factor, values, whitener(factor.noiseModel()))


def test_plane_factor():
    values = gtsam.Values()
    values.insert(keys.base(0), a_pose())
    values.insert(keys.landmark(5), RNG.normal(0, 1, 3))
    values.insert(keys.DEPTH, np.array([0.01, -0.004]))
    values.insert(keys.DEPTH_RAYS, np.array([0.002, -0.001, 0.003]))
    normal = np.array([0.3, -0.2, -0.93])
    normal /= np.linalg.norm(normal)
    factor = cloud.plane_factor(keys.base(0), keys.landmark(5), np.array([0.4, -0.3, 2.0]), normal, sigmas([0.01]))
    check(factor, values, whitener(factor.noiseModel()))


def a_pipe(values):
    values.insert(keys.axis_start(0), np.array([0.1, -0.4, 1.5]))
    values.insert(keys.axis_end(0), np.array([0.15, 0.5, 1.6]))
    values.insert(keys.radius(0), np.array([0.045]))


@pytest.mark.parametrize("camera", ["m_left", "m_right"])
def test_outline_factor(camera):
    values = gtsam.Values()
    a_pipe(values)
    values.insert(keys.keyframe(0), gtsam.Pose3.Expmap(RNG.normal(0, 0.1, 6)))
    values.insert(keys.intrinsics(camera), gtsam.Cal3DS2(270, 272, 0, 180, 120, 0, 0, 0, 0))
    if camera == "m_right":
        values.insert(keys.extrinsics(camera), gtsam.Pose3.Expmap(np.array([0.01, 0, 0.02, 0.15, 0, 0])))
    line = np.array([0.995, 0.0998, -170.0])
    values.insert(keys.inset(0), np.array([0.002]))
    factor = pipe.outline_factor(camera, line, sigmas([0.01, 0.02]), keys.keyframe(0), 0)
    check(factor, values, whitener(factor.noiseModel()))


def test_outline_touches_the_cylinder():
    # A vertical pipe of radius r straight ahead at z: tangent planes leave the optical axis at asin(r / z).
    K = np.array([[300.0, 0, 180], [0, 300, 120], [0, 0, 1]])
    r, z = 0.05, 1.3
    slope = np.tan(np.arcsin(r / z))
    lines = np.array([[1.0, 0, -(180 - 300 * slope)], [-1.0, 0, 180 + 300 * slope]])
    for line in lines:
        residual, _, _ = pipe.tangency(line, K, np.array([[0, -0.3, z], [0, 0.4, z]]), r)
        np.testing.assert_allclose(residual, 0, atol=1e-12)


def test_on_axis_factor():
    values = gtsam.Values()
    a_pipe(values)
    values.insert(keys.point(0), np.array([0.2, 0.1, 1.4]))
    factor = pipe.on_axis_factor(keys.point(0), 0)
    check(factor, values, whitener(factor.noiseModel()))


def test_cylinder_factor():
    values = gtsam.Values()
    a_pipe(values)
    values.insert(keys.base(0), gtsam.Pose3.Expmap(RNG.normal(0, 0.1, 6)))
    values.insert(keys.DEPTH, np.array([0.01, -0.004]))
    values.insert(keys.DEPTH_RAYS, np.array([0.002, -0.001, 0.003]))
    seen = cylinder_sighting()
    np.testing.assert_allclose(pipe.cylinder_covariance(seen), np.eye(5) * 1e-4, atol=1e-12)
    factor = pipe.cylinder_factor(seen, gaussian(pipe.cylinder_covariance(seen)), keys.base(0), 0)
    check(factor, values, whitener(factor.noiseModel()))


def cylinder_sighting():
    a, b = np.array([0.1, -0.2, 1.45]), np.array([0.12, 0.3, 1.52])
    axis = (b - a) / np.linalg.norm(b - a)
    across = np.kron(np.eye(2), np.eye(3) - np.outer(axis, axis))
    information = np.block([[across, np.zeros((6, 1))], [np.zeros((1, 6)), np.ones((1, 1))]]) / 1e-4
    response = np.random.default_rng(4).normal(0, 1, (7, 5))
    return CylinderSighting(5, "b_depth", "pipe0", a, b, 0.05, information, 900, 0.001, "kinect_cloud", response)


def test_a_cylinder_seen_too_far_by_the_depth_offset():
    # The true pipe is 20 mm nearer than the depth camera says: an offset of -20 mm explains the whole residual.
    a, b, r = np.array([0.0, -0.3, 1.5]), np.array([0.0, 0.3, 1.5]), 0.05
    response = np.zeros((7, 5))
    response[[2, 5], 0] = 1.0
    back = np.array([0.0, 0.0, 0.02])
    seen = dataclasses.replace(cylinder_sighting(), point_a_m=a + back, point_b_m=b + back, by_depth=response)
    values = gtsam.Values()
    values.insert(keys.base(0), gtsam.Pose3())
    for key, point in ((keys.axis_start(0), a), (keys.axis_end(0), b)):
        values.insert(key, point)
    values.insert(keys.radius(0), np.array([r]))
    values.insert(keys.DEPTH, np.array([-0.02, 0.0]))
    values.insert(keys.DEPTH_RAYS, np.zeros(3))
    factor = pipe.cylinder_factor(seen, gaussian(np.eye(5) * 1e-4), keys.base(0), 0)
    np.testing.assert_allclose(factor.unwhitenedError(values), 0, atol=1e-12)
    values.update(keys.DEPTH, np.zeros(2))
    assert np.linalg.norm(factor.unwhitenedError(values)) == pytest.approx(0.02 * np.sqrt(2), rel=1e-6)


def test_carried_factor():
    values = gtsam.Values()
    b_T_f, before, after = (a_pose() for _ in range(3))
    values.insert(keys.base(0), before)
    values.insert(keys.board(0, 0), before.compose(b_T_f).retract(RNG.normal(0, 0.01, 6)))
    values.insert(keys.base(1), after)
    values.insert(keys.board(0, 1), after.compose(b_T_f))
    factor = links.carried_factor(keys.base(0), keys.board(0, 0), keys.base(1), keys.board(0, 1))
    check(factor, values, whitener(factor.noiseModel()))
    values.update(keys.board(0, 0), before.compose(b_T_f))
    np.testing.assert_allclose(factor.unwhitenedError(values), 0, atol=1e-9)
