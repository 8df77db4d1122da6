"""The truth of one run: the rig as it really is, and where everything was. Only the evaluation reads it."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ..factors.board import CORNER_PRINT_SIGMA_M, DIRECTIONS, marker_rotation
from ..factors.calibration import ASPECT_REL, depth_ray_sigmas
from ..factors.rig import Board, Pose, Rig
from .measurement_level_scenario import StereoFault

Float = NDArray[np.float64]

KINECT_FOCAL_PX = 585.0
START_DISTANCE_M = 1.15
"""Of the mobile camera from the board when it first sees it."""


@dataclass(frozen=True, slots=True)
class TrueCamera:
    """A camera as it is, whatever its calibration says."""

    name: str
    width: int
    height: int
    K: Float
    """Shape (3, 3)."""


@dataclass(frozen=True, slots=True)
class TrueBoard:
    """A printed page as it is."""

    id: str
    markers: tuple[int, ...]
    corners_m: Float
    """Shape (n, 4, 3), in {f}, as they appear to the detector."""
    centres_m: Float
    """Shape (n, 3), in {f}."""
    side_m: float
    print_scale: float


@dataclass(frozen=True, slots=True)
class TrueRig:
    """The rig with its faults drawn."""

    cameras: dict[str, TrueCamera]
    m_left_T_m_right: Float
    """Shape (4, 4)."""
    b_T_rgb: Float
    """Shape (4, 4)."""
    f_T_b: Float
    """Shape (4, 4), of the board that the mount names."""
    depth_offset_m: float
    depth_scale: float
    """True depth is measured depth times (1 + scale), plus the offset."""
    depth_rays: Float
    """How the depth camera's rays lie beside those of its calibration: shift x, shift y [rad], scale."""
    boards: dict[str, TrueBoard]


@dataclass(frozen=True, slots=True)
class TruePipe:
    """A cylinder in {b}."""

    point_b_m: Float
    axis_b: Float
    """Unit, shape (3,)."""
    radius_m: float
    inset_m: float = 0.0
    """How far its edges are seen inside of its outline."""


@dataclass(frozen=True, slots=True)
class Truth:
    """What the estimator is to find."""

    stamps_ns: tuple[int, ...]
    o_T_m: Float
    """Shape (n, 4, 4), at those stamps."""
    o_T_b: Float
    """Shape (4, 4)."""
    o_T_f: dict[str, Float]
    points_b_m: dict[str, Float]
    pipe: TruePipe
    rig: TrueRig


def draw_rig(rig: Rig, cameras: dict[str, TrueCamera], baseline_m: float, rng: np.random.Generator) -> TrueRig:
    """Every calibration state drawn from its prior in the rig file.

    Args:
        rig: priors and their sigmas; `mount` is needed.
        cameras: as their calibration says.
        baseline_m: as the calibration says, axes parallel.
        rng: the run's generator.
    """
    if rig.mount is None:
        raise ValueError("a run needs a mount")
    stereo, kinect = rig.stereo, rig.kinect
    translation_m = np.array([baseline_m, 0.0, 0.0]) * (1.0 + rng.normal(0.0, stereo.baseline_sigma_rel))
    translation_m[1:] += rng.normal(0.0, stereo.translation_sigma_m, 2)
    m_left_T_m_right = matrix(rng.normal(0.0, stereo.rotation_sigma_rad, 3), translation_m)
    b_T_rgb = pose(kinect.b_T_rgb) @ perturbation(
        rng, kinect.b_T_rgb_rotation_sigma_rad, kinect.b_T_rgb_translation_sigma_m
    )
    f_T_b = pose(rig.mount.f_T_b) @ perturbation(rng, rig.mount.rotation_sigma_rad, rig.mount.translation_sigma_m)
    return TrueRig(
        cameras={name: _draw_camera(camera, rig, rng) for name, camera in cameras.items()},
        m_left_T_m_right=m_left_T_m_right,
        b_T_rgb=b_T_rgb,
        f_T_b=f_T_b,
        depth_offset_m=float(rng.normal(0.0, kinect.depth_offset_sigma_m)),
        depth_scale=float(rng.normal(0.0, kinect.depth_scale_sigma)),
        depth_rays=rng.normal(0.0, depth_ray_sigmas(rig.cameras.b_depth, KINECT_FOCAL_PX)),
        boards={board.id: draw_board(board, rng, _lasting_m(rig, cameras)) for board in rig.boards},
    )


def _lasting_m(rig: Rig, cameras: dict[str, TrueCamera]) -> float:
    """The part of a corner's detection error that stays in all views, on the page: as the page factor has it."""
    return rig.noise.marker_common_px * START_DISTANCE_M / float(cameras["m_left"].K[0, 0])


def nominal_rig(rig: Rig, cameras: dict[str, TrueCamera], baseline_m: float) -> TrueRig:
    """The rig without a fault."""
    if rig.mount is None:
        raise ValueError("a run needs a mount")
    return TrueRig(
        cameras=cameras,
        m_left_T_m_right=matrix(np.zeros(3), np.array([baseline_m, 0.0, 0.0])),
        b_T_rgb=pose(rig.kinect.b_T_rgb),
        f_T_b=pose(rig.mount.f_T_b),
        depth_offset_m=0.0,
        depth_scale=0.0,
        depth_rays=np.zeros(3),
        boards={board.id: draw_board(board, None) for board in rig.boards},
    )


def with_stereo_fault(rig: TrueRig, baseline_m: float, fault: StereoFault) -> TrueRig:
    """The same rig with a pair that is off by just so much; nothing else is drawn anew.

    Args:
        rig: as drawn.
        baseline_m: as the calibration says, axes parallel.
        fault: in place of what was drawn.
    """
    turn_rad = fault.disparity_px / float(rig.cameras["m_left"].K[0, 0])
    translation_m = np.array([baseline_m * (1.0 + fault.baseline_rel), 0.0, 0.0])
    return replace(rig, m_left_T_m_right=matrix(np.array([0.0, turn_rad, 0.0]), translation_m))


def draw_board(board: Board, rng: np.random.Generator | None, lasting_m: float = 0.0) -> TrueBoard:
    """A page with its print errors: common scale, single centres, apparent side. Without `rng`: as described."""
    n = len(board.markers)
    print_scale = 1.0 + (0.0 if rng is None else float(rng.normal(0.0, board.print_scale_sigma)))
    side_m = print_scale * board.side_m + (0.0 if rng is None else float(rng.normal(0.0, board.side_sigma_m)))
    centres_m = np.zeros((n, 3))
    centres_m[:, :2] = print_scale * np.array([marker.centre_m for marker in board.markers])
    ragged_m = np.zeros((n, 4, 3))
    if rng is not None:
        centres_m += rng.normal(0.0, board.centre_sigma_m, (n, 3))
        ragged_m = rng.normal(0.0, np.hypot(CORNER_PRINT_SIGMA_M, lasting_m), (n, 4, 3))
    squares_m = np.array([0.5 * side_m * DIRECTIONS @ marker_rotation(marker).T for marker in board.markers])
    corners_m = centres_m[:, None] + squares_m + ragged_m
    return TrueBoard(
        id=board.id,
        markers=tuple(marker.id for marker in board.markers),
        corners_m=corners_m,
        centres_m=centres_m,
        side_m=side_m,
        print_scale=print_scale,
    )


def _draw_camera(camera: TrueCamera, rig: Rig, rng: np.random.Generator) -> TrueCamera:
    prior = getattr(rig.cameras, camera.name)
    K = camera.K.copy()
    if "focal" not in prior.freeze:
        K[[0, 1], [0, 1]] *= 1.0 + rng.normal(0.0, prior.focal_sigma_rel) + rng.normal(0.0, ASPECT_REL, 2)
    if "centre" not in prior.freeze:
        K[:2, 2] += rng.normal(0.0, prior.centre_sigma_px, 2)
    return TrueCamera(camera.name, camera.width, camera.height, K)


def perturbation(rng: np.random.Generator, rotation_sigma_rad: float, translation_sigma_m: float) -> Float:
    """A small random pose, shape (4, 4)."""
    return matrix(rng.normal(0.0, rotation_sigma_rad, 3), rng.normal(0.0, translation_sigma_m, 3))


def matrix(rotation_vector_rad: Float, translation_m: Float) -> Float:
    """Shape (4, 4)."""
    result = np.eye(4)
    result[:3, :3] = Rotation.from_rotvec(rotation_vector_rad).as_matrix()
    result[:3, 3] = translation_m
    return result


def pose(section: Pose) -> Float:
    """A pose of the rig file, shape (4, 4)."""
    return matrix(np.array(section.rotation_vector_rad), np.array(section.translation_m))


def invert(a_T_b: Float) -> Float:
    """`b_T_a`. Shape (..., 4, 4)."""
    rotation = np.swapaxes(a_T_b[..., :3, :3], -1, -2)
    result = np.zeros_like(a_T_b)
    result[..., :3, :3] = rotation
    result[..., :3, 3] = -np.einsum("...ij,...j->...i", rotation, a_T_b[..., :3, 3])
    result[..., 3, 3] = 1.0
    return result


def transform(a_T_b: Float, b_points: Float) -> Float:
    """Points of b in a: (4, 4) and (..., 3) to (..., 3)."""
    return b_points @ a_T_b[:3, :3].T + a_T_b[:3, 3]
