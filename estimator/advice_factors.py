"""Predicted factors: what further measurements would add to the graph, with the noise that this run had."""

import gtsam
import numpy as np
from numpy.typing import NDArray

from ..factors import keys
from ..factors.board import page_corners, page_factor, print_scale_prior, side_prior
from ..factors.calibration import cal3, intrinsics_prior, rgb_mean, rgb_prior
from ..factors.links import mount_factor
from ..factors.noise import gaussian, sigmas
from ..factors.outline import outline_lines
from ..factors.pipe import outline_factor, tangency_covariance
from ..factors.projection import machine_projection, mobile_projection
from ..factors.rig import Board
from .advice_scene import Surroundings, View
from .advice_update import Predicted
from .board_inspection import FAMILY as CORNERS
from .pipes import EDGE_FLOOR_PX
from .pipes import FAMILY as PICKS

Float = NDArray[np.float64]

CORNER_SIGMA_PX = 0.15
"""Of a corner where this run has none in a camera: what the detector reaches on markers of 20 pixels and more."""

NEW_SLOTS = 1 << 20
"""Corner slots of a planned board, far from those in use."""


def ties(scene: Surroundings, view: View, inflation: float) -> list[Predicted]:
    """The landmarks that a new keyframe sees, left and right."""
    found = []
    for landmark in view.landmarks:
        place = scene.values.atPoint3(landmark)[None]
        for camera in ("m_left", "m_right"):
            px, inside = scene.pixels(camera, view.o_T_m, place)
            if inside[0]:
                noise = sigmas([scene.track_sigma(camera) / np.sqrt(view.share)] * 2)
                found.append(Predicted(mobile_projection(camera, px[0], noise, view.key, landmark), inflation))
    return found


def click(scene: Surroundings, point: int, pose_key: int, o_T_c: gtsam.Pose3, camera: str) -> Predicted:
    """One pick of a point.

    Args:
        point: key of the point.
        pose_key: of the keyframe, or of the base for the Kinect's colour camera.
        o_T_c: the camera itself.
    """
    floor = scene.engine.rig.noise.pick_floor_px
    sigma = scene.sigma(PICKS, camera, scene.sigma(PICKS, "m_left", max(1.0, floor)))
    K = scene.values.atCal3DS2(keys.intrinsics(camera)).K()
    px = K @ o_T_c.transformTo(scene.values.atPoint3(point))
    noise = sigmas([sigma] * 2)
    if camera == "b_rgb":
        return Predicted(machine_projection(px[:2] / px[2], noise, pose_key, point))
    return Predicted(mobile_projection(camera, px[:2] / px[2], noise, pose_key, point))


def edges(scene: Surroundings, pipe: str, point: int, view: View) -> list[Predicted]:
    """Both edges of a pipe about a point in a left image, as exact as this run's edges were."""
    cylinder = scene.engine.pipes.cylinders[pipe]
    values, i = scene.values, cylinder.index
    a, b = (view.o_T_m.transformTo(values.atPoint3(k)) for k in (keys.axis_start(i), keys.axis_end(i)))
    if a[2] < 0.1 or b[2] < 0.1:
        return []
    K = values.atCal3DS2(keys.intrinsics("m_left")).K()
    lines = outline_lines(a, b - a, float(values.atVector(keys.radius(i))[0]), K)
    own = typical_edge(scene)
    if lines is None or own is None or not values.exists(keys.inset(i)):
        return []
    px = K @ view.o_T_m.transformTo(values.atPoint3(point))
    found = []
    for line in lines:
        foot = px[:2] / px[2] - float(line @ (px / px[2])) * line[:2]
        noise = gaussian(tangency_covariance(-line, own, foot, K, a, b))
        found.append(Predicted(outline_factor("m_left", -line, noise, view.key, i)))
    return found


def typical_edge(scene: Surroundings) -> Float | None:
    """Median variances of (offset [px], direction [rad]) of this run's edges, shape (2, 2); None without one."""
    seen = scene.engine.pipes.outlined
    if not seen:
        return None
    variances = np.concatenate([np.diagonal(s.covariance, axis1=1, axis2=2) for _, s in seen])
    return np.diag(np.median(variances, axis=0)) + np.diag([EDGE_FLOOR_PX**2, 0.0])


def board_view(scene: Surroundings, board: Board, view: View) -> list[Predicted]:
    """All corners of a board that is in the map already, left and right."""
    found = []
    common = scene.engine.rig.noise.marker_common_px
    for marker in board.markers:
        slot = scene.engine.boards.slot_of(board.id, marker.id)
        if slot is None or not scene.values.exists(keys.corner(slot, 0)):
            continue
        for i in range(4):
            point = keys.corner(slot, i)
            for camera in ("m_left", "m_right"):
                px, inside = scene.pixels(camera, view.o_T_m, scene.values.atPoint3(point)[None])
                if inside[0]:
                    sigma = scene.sigma(CORNERS, camera, float(np.hypot(CORNER_SIGMA_PX, common)))
                    found.append(Predicted(mobile_projection(camera, px[0], sigmas([sigma] * 2), view.key, point)))
    return found


def mount_again(scene: Surroundings) -> list[Predicted]:
    """The mount measured so much better that its sigma halves: three more measurements as good as the first."""
    mount = scene.engine.rig.mount
    if mount is None or not scene.engine.boards.known(mount.board):
        return []
    better = mount.model_copy(
        update={
            "translation_sigma_m": mount.translation_sigma_m / np.sqrt(3.0),
            "rotation_sigma_rad": mount.rotation_sigma_rad / np.sqrt(3.0),
        }
    )
    return [Predicted(mount_factor(better, scene.engine.boards.key(mount.board), scene.engine.base))]


def colour_camera(scene: Surroundings) -> tuple[gtsam.Pose3, gtsam.Cal3DS2]:
    """`o_T_rgb` and the pinhole of the Kinect's colour camera, from the estimate or from what was given."""
    values, o_T_b = scene.values, scene.values.atPose3(scene.engine.base)
    if values.exists(keys.intrinsics("b_rgb")):
        return o_T_b.compose(values.atPose3(keys.extrinsics("b_rgb"))), values.atCal3DS2(keys.intrinsics("b_rgb"))
    return o_T_b.compose(rgb_mean(scene.engine.rig.kinect)), cal3(scene.engine.cameras["b_rgb"])


def open_colour(scene: Surroundings, new: gtsam.Values) -> list[Predicted]:
    """The Kinect's colour camera with its priors, where it has delivered nothing so far; its variables go to `new`."""
    if scene.values.exists(keys.intrinsics("b_rgb")):
        return []
    rig, model = scene.engine.rig, scene.engine.cameras["b_rgb"]
    new.insert(keys.intrinsics("b_rgb"), cal3(model))
    new.insert(keys.extrinsics("b_rgb"), rgb_mean(rig.kinect))
    return [Predicted(intrinsics_prior("b_rgb", model, rig.cameras.b_rgb)), Predicted(rgb_prior(rig.kinect))]


def second_board(
    scene: Surroundings, new: gtsam.Values, board: Board, o_T_f: gtsam.Pose3, view: View
) -> list[Predicted]:
    """A board like `board`, seen once by the mobile pair and by the Kinect's colour camera; variables go to `new`."""
    index = len(scene.engine.rig.boards)
    found = open_colour(scene, new)
    o_T_rgb, pinhole = colour_camera(scene)
    K = pinhole.K()
    new.insert(keys.board(index), o_T_f)
    new.insert(keys.page(index), np.array([board.side_m, 1.0]))
    page = keys.page(index)
    found += [Predicted(side_prior(page, board.side_m, board.side_sigma_m))]
    found += [Predicted(print_scale_prior(page, board.print_scale_sigma))]
    common = scene.engine.rig.noise.marker_common_px
    colour = sigmas([scene.sigma(CORNERS, "b_rgb", float(np.hypot(CORNER_SIGMA_PX, common)))] * 2)
    away = float(np.linalg.norm(o_T_f.translation() - view.o_T_m.translation()))
    lasting = common * away / scene.engine.cameras["m_left"].fx
    first = NEW_SLOTS
    for offset, marker in enumerate(board.markers):
        slot = first + offset
        found.append(Predicted(page_factor(board, marker, keys.board(index), page, slot, lasting)))
        for i, corner in enumerate(page_corners(marker, board.side_m)):
            point, place = keys.corner(slot, i), o_T_f.transformFrom(corner)
            new.insert(point, place)
            px = K @ o_T_rgb.transformTo(place)
            found.append(Predicted(machine_projection(px[:2] / px[2], colour, scene.engine.base, point)))
            for camera in ("m_left", "m_right"):
                seen, inside = scene.pixels(camera, view.o_T_m, place[None])
                sigma = scene.sigma(CORNERS, camera, float(np.hypot(CORNER_SIGMA_PX, common)))
                if inside[0]:
                    found.append(Predicted(mobile_projection(camera, seen[0], sigmas([sigma] * 2), view.key, point)))
    return found
