"""Boards, cameras and poses that the fiducial tests share."""

import cv2
import numpy as np

from surecut.factors.camera import CameraModel
from surecut.factors.measurements import MarkerSighting
from surecut.factors.rig import Board, Marker
from surecut.simulation.marker_images import marker_corners, project

PAGE_M = (0.21, 0.297)


def a4_board(dictionary="DICT_4X4_50", ids=(0, 1, 2, 3), **more):
    places = ((-0.05, -0.09), (0.05, -0.09), (-0.05, 0.09), (0.05, 0.09))
    markers = tuple(Marker(id=i, centre_m=p) for i, p in zip(ids, places, strict=False))
    return Board(id=more.pop("id", "f0"), dictionary=dictionary, markers=markers, **more)


def camera(width, height, focal, model="none", coefficients=()):
    K = np.array([[focal, 0.0, width / 2 - 0.5], [0.0, focal, height / 2 - 0.5], [0.0, 0.0, 1.0]])
    return CameraModel("m_left", width, height, K, model, np.array(coefficients, float), np.eye(3), None)


def pose(tilt_deg, about_deg, roll_deg, place_m):
    """camera_T_f of a board that faces the camera when all angles are zero."""
    about = np.deg2rad(about_deg)
    tilt = cv2.Rodrigues(np.deg2rad(tilt_deg) * np.array([np.cos(about), np.sin(about), 0.0]))[0]
    roll = cv2.Rodrigues(np.array([0.0, 0.0, np.deg2rad(roll_deg)]))[0]
    result = np.eye(4)
    result[:3, :3] = tilt @ np.diag([1.0, -1.0, -1.0]) @ roll
    result[:3, 3] = place_m
    return result


def sightings_of(board, camera_model, camera_T_f, rng, sigma_px, side_m=None, moved=None):
    """Sightings with Gaussian noise; `moved` maps a marker to the shift (x, y) of its place in metres."""
    result = []
    for marker, corners in marker_corners(board, side_m).items():
        shift = (moved or {}).get(marker, (0.0, 0.0))
        true = project(camera_model, camera_T_f, corners + np.array([*shift, 0.0]))
        seen = true + rng.normal(0.0, sigma_px, (4, 2))
        covariance = np.broadcast_to(sigma_px**2 * np.eye(2), (4, 2, 2))
        result.append(MarkerSighting(0, "m_left", board.id, marker, seen, covariance, seen))
    return result


def turn_between_deg(one, other):
    return float(np.rad2deg(np.linalg.norm(cv2.Rodrigues(one[:3, :3].T @ other[:3, :3])[0])))
