"""The rig as it really is, drawn about its nominal values, and the rig file that an engineer would have written."""

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ..factors.camera import CameraModel
from ..factors.rig import Board, Camera, Cameras, Distance, Kinect, Marker, Mount, Pipe, Pose, Rig, Stereo
from .page import PrintedMarker
from .rigid import inverse, rigid, rotation_vector
from .scenario import Scenario

Float = NDArray[np.float64]
PAGE_M = (0.297, 0.210)
CENTRES_M = ((-0.096, 0.0555), (0.096, 0.0555), (0.096, -0.0555), (-0.096, -0.0555))


@dataclass(frozen=True, slots=True)
class TrueRig:
    """What only the truth knows."""

    cameras: dict[str, CameraModel]
    left_T_right: Float
    b_T_rgb: Float
    f_T_b: Float
    markers: tuple[PrintedMarker, ...]
    depth_offset_m: float
    """The Kinect reads `z (1 + depth_scale) + depth_offset_m`."""
    depth_scale: float
    errors: dict[str, float]
    """True less nominal, by name, for the record."""


@dataclass(frozen=True, slots=True)
class RigPair:
    """Nominal and true."""

    cameras: dict[str, CameraModel]
    """As given in the camera_info topics."""
    rig: Rig
    truth: TrueRig


def draw_rig(scenario: Scenario, side: float, rng: np.random.Generator) -> RigPair:
    """Draw a rig. `side` is +1 or -1: the board hangs to the right or left of the Kinect.

    The baseline and the vergence are drawn so that depth reads short, as such rigs tend to (the wrong calibration of
    a pair that was knocked in transport), unless `scenario.bias` sets them.
    """
    nominal = _nominal_cameras(scenario)
    f_T_b = _nominal_mount(side, rng)
    b_T_rgb = rigid(None, (0.025, 0.0, 0.0))
    markers = _print_page(scenario, rng)
    truth = _true_rig(scenario, nominal, f_T_b, b_T_rgb, markers, rng)
    return RigPair(nominal, _rig_file(scenario, f_T_b, b_T_rgb, markers, rng), truth)


def _nominal_cameras(scenario: Scenario) -> dict[str, CameraModel]:
    mobile, kinect = scenario.mobile, scenario.kinect

    def camera(
        name: str, size: tuple[int, int], focal: float, d: tuple[float, ...], baseline: float | None
    ) -> CameraModel:
        k = np.array([[focal, 0, (size[0] - 1) / 2], [0, focal, (size[1] - 1) / 2], [0, 0, 1.0]])
        coefficients = np.array((*d, *(0.0,) * (5 - len(d))))
        return CameraModel(name, *size, k, "plumb_bob", coefficients, np.eye(3), baseline)

    m, b = (mobile.width, mobile.height), (kinect.width, kinect.height)
    return {
        "m_left": camera("m_left", m, mobile.focal_px, mobile.distortion, None),
        "m_right": camera("m_right", m, mobile.focal_px, mobile.distortion, mobile.baseline_m),
        "b_rgb": camera("b_rgb", b, kinect.rgb_focal_px * b[0] / 640, kinect.rgb_distortion, None),
        "b_depth": camera("b_depth", b, kinect.depth_focal_px * b[0] / 640, (), None),
    }


def _nominal_mount(side: float, rng: np.random.Generator) -> Float:
    """`f_T_b`: the page beside the Kinect, turned outwards by 20 to 55 degrees."""
    yaw = side * np.deg2rad(rng.uniform(20, 55))
    pitch, roll = np.deg2rad(rng.normal(0, [4, 2]))
    # {b} has x right, y down, z forward; an upright page that faces forward has x left, y up, z forward.
    turn = Rotation.from_euler("y", yaw) * Rotation.from_euler("x", pitch)
    upright = np.diag([-1.0, -1.0, 1.0])
    b_R_f = turn.as_matrix() @ upright @ Rotation.from_euler("z", roll).as_matrix()
    place = (side * rng.uniform(0.30, 0.40), rng.uniform(-0.05, 0.10), rng.uniform(-0.05, 0.02))
    return inverse(rigid(b_R_f, np.round(place, 3)))


def _print_page(scenario: Scenario, rng: np.random.Generator) -> tuple[PrintedMarker, ...]:
    board, sigmas = scenario.board, scenario.sigmas
    scale = board.page_scale * (1 + rng.normal(0, sigmas.print_scale))
    ink = rng.normal(0, sigmas.ink_m)
    patterns = {i: i for i in range(len(CENTRES_M))}
    if board.swapped:
        first, second = board.swapped
        patterns[first], patterns[second] = second, first
    markers = []
    for number, centre in enumerate(CENTRES_M):
        place = scale * np.array(centre) + rng.normal(0, sigmas.marker_m, 2)
        turn = 0.0
        if board.loose and board.loose.id == number:
            place, turn = place + board.loose.shift_m, board.loose.turn_rad
        side = scale * board.side_m + ink
        markers.append(PrintedMarker(number, patterns[number], (float(place[0]), float(place[1])), side, turn))
    return tuple(markers)


def _true_rig(
    scenario: Scenario,
    nominal: dict[str, CameraModel],
    f_T_b: Float,
    b_T_rgb: Float,
    markers: tuple[PrintedMarker, ...],
    rng: np.random.Generator,
) -> TrueRig:
    sigmas, bias = scenario.sigmas, scenario.bias
    drawn = abs(rng.normal(0, sigmas.baseline_rel)), abs(rng.normal(0, sigmas.disparity_px))
    baseline = drawn[0] if bias.baseline_rel is None else bias.baseline_rel
    disparity = drawn[1] if bias.disparity_px is None else bias.disparity_px
    focal = dict(zip(nominal, rng.normal(0, sigmas.focal_rel, 4), strict=True))
    focal["m_right"] = focal["m_left"] + 0.2 * focal["m_right"]
    cameras = {name: _changed(nominal[name], focal[name], rng.normal(0, sigmas.centre_px, 2)) for name in nominal}
    turn = np.array([0, disparity / scenario.mobile.focal_px, 0]) + rng.normal(0, sigmas.right_turn_rad, 3) * [1, 0, 1]
    across = rng.normal(0, sigmas.right_shift_m, 2)
    left_T_right = rigid(turn, (scenario.mobile.baseline_m * (1 + baseline), *across))
    true_f_T_b = f_T_b @ rigid(rng.normal(0, sigmas.mount_rad, 3), np.zeros(3))
    true_f_T_b[:3, 3] += rng.normal(0, sigmas.mount_m, 3)
    true_b_T_rgb = b_T_rgb @ rigid(rng.normal(0, sigmas.rgb_rad, 3), rng.normal(0, sigmas.rgb_m, 3))
    offset, scale = rng.normal(0, sigmas.depth_offset_m), rng.normal(0, sigmas.depth_scale)
    errors = {
        "baseline_rel": baseline,
        "disparity_px": disparity,
        **{f"focal_rel_{name}": float(value) for name, value in focal.items()},
        "depth_offset_m": offset,
        "depth_scale": scale,
        "marker_side_m": markers[0].side_m,
        "mount_shift_m": float(np.linalg.norm(true_f_T_b[:3, 3] - f_T_b[:3, 3])),
        "mount_turn_rad": float(np.linalg.norm(rotation_vector(inverse(f_T_b) @ true_f_T_b))),
    }
    errors = {name: float(value) for name, value in errors.items()}
    return TrueRig(cameras, left_T_right, true_b_T_rgb, true_f_T_b, markers, float(offset), float(scale), errors)


def _changed(camera: CameraModel, focal_rel: float, centre_px: Float) -> CameraModel:
    k = camera.K.copy()
    k[0, 0] *= 1 + focal_rel
    k[1, 1] *= 1 + focal_rel
    k[:2, 2] += centre_px
    return CameraModel(
        camera.name,
        camera.width,
        camera.height,
        k,
        camera.distortion_model,
        camera.D,
        camera.rectification,
        camera.baseline_m,
    )


def pose_section(a_T_b: Float) -> Pose:
    """A pose as the rig file writes it."""
    turn = rotation_vector(a_T_b)
    return Pose(
        translation_m=(float(a_T_b[0, 3]), float(a_T_b[1, 3]), float(a_T_b[2, 3])),
        rotation_vector_rad=(float(turn[0]), float(turn[1]), float(turn[2])),
    )


def _rig_file(
    scenario: Scenario, f_T_b: Float, b_T_rgb: Float, markers: tuple[PrintedMarker, ...], rng: np.random.Generator
) -> Rig:
    """The rig with nominal values, and as its tolerances what such values are known to."""
    board, sigmas = scenario.board, scenario.sigmas
    distances = []
    if board.measured_distances:
        for a, b in combinations(markers, 2):
            true = float(np.linalg.norm(np.subtract(a.centre_m, b.centre_m)))
            sigma = max(sigmas.distance_m, 1e-5)
            measured = round(true + rng.normal(0, sigma), 5)
            distances.append(
                Distance.model_validate({"from": str(a.id), "to": str(b.id), "distance_m": measured, "sigma_m": sigma})
            )
    page = Board(
        id="f0",
        side_m=board.typed_side_m or board.side_m,
        side_sigma_m=max(2 * sigmas.ink_m, 0.0002),
        print_scale_sigma=max(sigmas.print_scale, 1e-4),
        centre_sigma_m=max(sigmas.marker_m, 2e-5),
        markers=tuple(Marker(id=number, centre_m=centre) for number, centre in enumerate(CENTRES_M)),
    )
    return Rig(
        cameras=_camera_sections(scenario),
        stereo=Stereo(
            baseline_sigma_rel=max(2 * sigmas.baseline_rel, 1e-4),
            translation_sigma_m=max(sigmas.right_shift_m, 1e-5),
            rotation_sigma_rad=max(0.003 if sigmas.disparity_px else sigmas.right_turn_rad, 1e-5),
        ),
        kinect=Kinect(
            depth_offset_sigma_m=max(sigmas.depth_offset_m, 1e-4),
            depth_scale_sigma=max(sigmas.depth_scale, 1e-4),
            b_T_rgb=pose_section(b_T_rgb),
            b_T_rgb_translation_sigma_m=max(sigmas.rgb_m, 1e-5),
            b_T_rgb_rotation_sigma_rad=max(sigmas.rgb_rad, 1e-5),
        ),
        boards=(page,),
        distances=tuple(distances),
        mount=Mount(
            board="f0",
            f_T_b=pose_section(f_T_b),
            translation_sigma_m=max(sigmas.mount_m, 1e-5),
            rotation_sigma_rad=max(sigmas.mount_rad, 1e-5),
        ),
        pipes=(Pipe(id="pipe0", points=("P1", "P2")),),
    )


def _camera_sections(scenario: Scenario) -> Cameras:
    plain = Cameras()
    focal, centre = max(scenario.sigmas.focal_rel, 1e-5), max(scenario.sigmas.centre_px, 1e-3)

    def trusted(camera: Camera) -> Camera:
        return camera.model_copy(update={"focal_sigma_rel": focal, "centre_sigma_px": centre})

    return Cameras(
        m_left=trusted(plain.m_left),
        m_right=trusted(plain.m_right),
        b_rgb=trusted(plain.b_rgb),
        b_depth=trusted(plain.b_depth),
    )
