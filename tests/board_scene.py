"""Boards seen by cameras whose places are known: measurements without a pixel."""

import cv2
import numpy as np

from surecut.factors.camera import CameraModel
from surecut.factors.measurements import MarkerSighting
from surecut.factors.rig import Board, Marker
from surecut.simulation.marker_images import marker_corners, project

STEP_NS = 200_000_000
BASELINE_M = 0.15
PLACES = ((-0.05, 0.09), (0.05, 0.09), (-0.05, -0.09), (0.05, -0.09))


def page(name="f0", ids=(0, 1, 2, 3), **more):
    markers = tuple(Marker(id=i, centre_m=place) for i, place in zip(ids, PLACES, strict=False))
    return Board(id=name, markers=markers, **more)


def lens(name, width=1280, height=720, focal=900.0):
    K = np.array([[focal, 0.0, width / 2 - 0.5], [0.0, focal, height / 2 - 0.5], [0.0, 0.0, 1.0]])
    baseline = BASELINE_M if name == "m_right" else None
    return CameraModel(name, width, height, K, "none", np.zeros(0), np.eye(3), baseline)


def pair(**size):
    return {name: lens(name, **size) for name in ("m_left", "m_right")}


def board_before(distance_m, tilt_deg=0.0, about_deg=0.0, roll_deg=0.0, aside_m=(0.0, 0.0)):
    """camera_T_f of a board that faces the camera when all angles are zero."""
    about = np.deg2rad(about_deg)
    tilt = cv2.Rodrigues(np.deg2rad(tilt_deg) * np.array([np.cos(about), np.sin(about), 0.0]))[0]
    roll = cv2.Rodrigues(np.array([0.0, 0.0, np.deg2rad(roll_deg)]))[0]
    result = np.eye(4)
    result[:3, :3] = tilt @ np.diag([1.0, -1.0, -1.0]) @ roll
    result[:3, 3] = [*aside_m, distance_m]
    return result


def right_of(camera_T_f):
    shifted = camera_T_f.copy()
    shifted[0, 3] -= BASELINE_M
    return shifted


def seen(board, camera, camera_T_f, stamp_ns, rng, sigma_px=0.1, inset_px=0.0, only=None, side_m=None):
    """Sightings of the markers that are whole in the image."""
    found = []
    for marker, corners in marker_corners(board, side_m).items():
        px = project(camera, camera_T_f, corners)
        inside = (px > 2).all() and (px < [camera.width - 3, camera.height - 3]).all()
        if not inside or (only is not None and marker not in only):
            continue
        rays = px - px.mean(axis=0)
        px = px - inset_px * rays / np.linalg.norm(rays, axis=1, keepdims=True) + rng.normal(0.0, sigma_px, (4, 2))
        covariance = np.tile(sigma_px**2 * np.eye(2), (4, 1, 1))
        found.append(MarkerSighting(stamp_ns, camera.name, board.id, marker, px, covariance, px))
    return found


def seen_by_pair(board, cameras, left_T_f, stamp_ns, rng, **more):
    left = seen(board, cameras["m_left"], left_T_f, stamp_ns, rng, **more)
    return [*left, *seen(board, cameras["m_right"], right_of(left_T_f), stamp_ns, rng, **more)]
