"""The paper's fiducial experiment again: depth of four printed markers before one camera, raw, times S, and joint.

Burrell et al., section IV.A, figures 5 and 6: a page with four 75 mm markers in plane with a 1920x1080 camera at 400 to
1200 mm, five images each; once with the right side length, once with 50 mm typed for 75.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from ..estimator.baseline import BoardView, board_scale, corrected_centres
from ..estimator.result import Result
from ..estimator.run import estimate
from ..estimator.surfaces import lay_on_surfaces
from ..factors.camera import CameraModel
from ..factors.measurements import Event
from ..factors.rig import Board, Marker, Rig
from ..frontends.fiducials.detector import MarkerFrontEnd
from ..frontends.paper_chain import marker_pose, plain_sightings
from .page import PrintedMarker
from .render_board import board_stage, exposure_gain, render_light
from .scenario import Light
from .sensor import RayGrid, expose, ray_grid
from .stage import View

Float = NDArray[np.float64]
Grey = NDArray[np.uint8]
Method = Literal["raw", "times S", "joint"]
METHODS: tuple[Method, ...] = ("raw", "times S", "joint")

PAGE_M = (0.210, 0.297)
PLACES_M = ((-0.05, 0.09), (0.05, 0.09), (-0.05, -0.09), (0.05, -0.09))
BOARD = "f0"


@dataclass(frozen=True, slots=True)
class Setup:
    """What is photographed, with what, and what the operator claims about it."""

    distances_m: tuple[float, ...] = (0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.1, 1.2)
    images: int = 5
    side_m: float = 0.075
    """As printed."""
    typed_sides_m: tuple[float, ...] = (0.075, 0.05)
    """As the rig file has it: every image is evaluated with each of them."""
    size_px: tuple[int, int] = (1920, 1080)
    focal_px: float = 1400.0
    """Of the true camera. The paper does not give it; 1400 px are 69 degrees across."""
    focal_error_rel: float = 0.0
    """The focal length that is given, over the true one, less 1."""
    focal_sigma_rel: float = 0.003
    tilt_sigma_rad: float = 0.025
    """Of the camera's pointing, which is placed by hand, about each axis."""
    aside_sigma_m: float = 0.01
    light: Light = field(default_factory=lambda: Light(exposure_s=0.0))
    """Camera and page stand still."""
    seed: int = 1

    def camera(self, given: bool) -> CameraModel:
        """The true camera, or the one that the estimators are told."""
        width, height = self.size_px
        focal = self.focal_px * (1.0 + self.focal_error_rel * given)
        K = np.array([[focal, 0.0, width / 2 - 0.5], [0.0, focal, height / 2 - 0.5], [0.0, 0.0, 1.0]])
        return CameraModel("m_left", width, height, K, "none", np.zeros(0), np.eye(3), None)

    def board(self, side_m: float) -> Board:
        markers = tuple(Marker(id=i, centre_m=place) for i, place in enumerate(PLACES_M))
        return Board(id=BOARD, side_m=side_m, markers=markers)

    def rig(self, typed_side_m: float) -> Rig:
        """The rig file of a run."""
        rig = Rig(boards=(self.board(typed_side_m),))
        left = rig.cameras.m_left.model_copy(update={"focal_sigma_rel": self.focal_sigma_rel})
        return rig.model_copy(update={"cameras": rig.cameras.model_copy(update={"m_left": left})})


@dataclass(frozen=True, slots=True)
class Depth:
    """One marker's depth in one image by one method."""

    distance_m: float
    """Where the camera was placed."""
    image: int
    typed_side_m: float
    method: Method
    marker: int
    depth_m: float
    true_m: float
    sigma_m: float | None
    """None for methods that claim nothing."""
    rotation_error_rad: float
    """Of the marker; of the whole page for the joint estimate."""


@dataclass(frozen=True, slots=True)
class Outcome:
    """All depths, and what the joint estimate said about the rig."""

    setup: Setup
    depths: tuple[Depth, ...]
    told: tuple[Event, ...]


def run_experiment(setup: Setup, progress: Callable[[float], None] = lambda share: None) -> Outcome:
    """Renders every image once and evaluates it with each side length and method.

    Args:
        progress: is told the share that is done, 0 to 1.
    """
    true, depths, told = setup.camera(given=False), [], []
    grid, view = ray_grid(true), _scene(setup)
    total = len(setup.distances_m) * setup.images
    for row, distance_m in enumerate(setup.distances_m):
        for image in range(setup.images):
            rng = np.random.default_rng([setup.seed, row, image])
            camera_T_f = _placed(setup, distance_m, rng)
            found, events = evaluate(setup, _photograph(setup, view, grid, camera_T_f, rng), camera_T_f)
            depths += [replace(d, distance_m=distance_m, image=image) for d in found]
            told += events
            progress((row * setup.images + image + 1) / total)
    return Outcome(setup, tuple(depths), tuple(told))


def _scene(setup: Setup) -> View:
    markers = [PrintedMarker(m.id, m.id, m.centre_m, setup.side_m) for m in setup.board(setup.side_m).markers]
    stage = board_stage(markers, PAGE_M, seed=setup.seed)
    return stage.view({"page": np.eye(4), "wall": np.eye(4)})


def _placed(setup: Setup, distance_m: float, rng: np.random.Generator) -> Float:
    """`camera_T_f` of a page that faces a camera which was put there by hand."""
    turn = cv2.Rodrigues(rng.normal(0.0, setup.tilt_sigma_rad, 3))[0]
    pose = np.eye(4)
    pose[:3, :3] = turn @ np.diag([1.0, -1.0, -1.0])
    pose[:3, 3] = [*rng.normal(0.0, setup.aside_sigma_m, 2), distance_m]
    return pose


def _photograph(setup: Setup, view: View, grid: RayGrid, camera_T_f: Float, rng: np.random.Generator) -> Grey:
    f_T_camera = np.asarray(np.linalg.inv(camera_T_f), np.float64)
    light = render_light(view, grid, lambda _: f_T_camera)
    return expose(light, setup.light, exposure_gain(light), rng)


def evaluate(setup: Setup, picture: Grey, camera_T_f: Float) -> tuple[list[Depth], list[Event]]:
    """One image, every side length, every method."""
    camera = setup.camera(given=True)
    depths, told = [], []
    for typed in setup.typed_sides_m:
        board, rig = setup.board(typed), setup.rig(typed)
        depths += _plain(board, picture, camera, camera_T_f)
        sightings, _ = MarkerFrontEnd(rig, camera, "m_left").process(0, picture)
        result = estimate(sightings, rig, {"m_left": camera}, lay_on_surfaces)
        depths += _joint(result, board, camera_T_f)
        told += [e for e in result.events if e.severity != "info"]
    return depths, told


def _plain(board: Board, picture: Grey, camera: CameraModel, camera_T_f: Float) -> list[Depth]:
    """Each marker by itself as OpenCV gives it, and the same times S, equations (1) to (9)."""
    seen = plain_sightings(0, picture, board, camera)
    poses = {s.marker: p for s in seen if (p := marker_pose(s, camera, board.side_m)) is not None}
    if not poses:
        return []
    view = BoardView(0, board.id, tuple(poses), np.array(list(poses.values())))
    centres = view.m_T_marker[:, :3, 3]
    scaled = corrected_centres(board_scale(view, board), centres)
    true = dict(zip(range(len(board.markers)), _depths(camera_T_f, board, 1.0), strict=True))
    found = []
    for row, marker in enumerate(poses):
        off = _angle(view.m_T_marker[row], camera_T_f)
        for method, place in (("raw", centres[row]), ("times S", scaled[row])):
            depth = float(place[2])
            found.append(Depth(0.0, 0, board.side_m, method, marker, depth, true[marker], None, off))  # type: ignore[arg-type]
    return found


def _joint(result: Result, board: Board, camera_T_f: Float) -> list[Depth]:
    """The markers' depths by the estimated page; {o} is the camera, which stands still in a run of one image."""
    page = next(pose for pose in result.poses if pose.name == board.id)
    scale = next(row.value for row in result.calibration if row.name == f"{board.id}.print_scale")
    assert page.covariance is not None
    off, found = _angle(page.matrix, camera_T_f), []
    true, depths = _depths(camera_T_f, board, 1.0), _depths(page.matrix, board, float(scale))
    for row, marker in enumerate(board.markers):
        arm = page.matrix[:3, :3] @ [*(scale * np.array(marker.centre_m)), 0.0]
        J = np.array([0.0, 0.0, 1.0, arm[1], -arm[0], 0.0])
        sigma = float(np.sqrt(J @ page.covariance @ J))
        found.append(Depth(0.0, 0, board.side_m, "joint", marker.id, depths[row], true[row], sigma, off))
    return found


def _depths(camera_T_f: Float, board: Board, scale: float) -> list[float]:
    centres = np.array([[*m.centre_m, 0.0] for m in board.markers])
    return (scale * centres @ camera_T_f[2, :3] + camera_T_f[2, 3]).tolist()


def _angle(one: Float, other: Float) -> float:
    return float(np.linalg.norm(cv2.Rodrigues(one[:3, :3].T @ other[:3, :3])[0]))
