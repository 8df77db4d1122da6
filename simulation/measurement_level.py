"""Draws the measurements themselves, with exactly the noise that they state: a run without a pixel.

`draw` gives what the front ends would deliver, and the truth apart. The truth reaches the measurements only through
their noise: ids, stamps and covariances do not depend on it, except that a thing out of view is not measured.
"""

from dataclasses import dataclass

import numpy as np

from ..estimator.baseline import ClickedPoint
from ..estimator.pipes import INSET_SHARE
from ..factors.camera import CameraModel
from ..factors.measurements import CloudFrame, CylinderSighting, MarkerSighting, OutlineSighting, Pick, StereoFrame
from ..factors.rig import Board, Cameras, Distance, Marker, Mount, Pipe, Pose, Rig
from .measurement_level_board import misprinted
from .measurement_level_machine import clicks, cloud_frames, cylinders, stereo_clicks
from .measurement_level_mobile import marker_sightings, stereo_frames
from .measurement_level_scenario import Scenario, merged
from .measurement_level_scene import Scene, build_scene, mobile_path
from .measurement_level_truth import (
    Float,
    TrueCamera,
    TruePipe,
    TrueRig,
    Truth,
    draw_rig,
    invert,
    nominal_rig,
    transform,
    with_stereo_fault,
)
from .measurement_level_world import World

Measurement = MarkerSighting | StereoFrame | CloudFrame | CylinderSighting | Pick | OutlineSighting
START_NS = 1_000_000_000
COLOUR_SIZE = (640, 480)
OUTLIER_STREAM = 1
"""Last word of the seed from which outliers are drawn."""


@dataclass(frozen=True, slots=True)
class Run:
    """One drawn run: what the estimator gets, and what it must not see."""

    measurements: tuple[Measurement, ...]
    """Sorted by stamp."""
    rig: Rig
    cameras: dict[str, CameraModel]
    truth: Truth
    stereo_clicks: tuple[ClickedPoint, ...]
    """Stereo depth at the clicks, for the paper's chain; the estimator does not get it."""


def draw(scenario: Scenario, seed: int) -> Run:
    """One run. The same scenario and seed give the same run."""
    seeds = [scenario.seed, seed]
    world = _build_world(scenario, np.random.default_rng(seeds), np.random.default_rng([*seeds, OUTLIER_STREAM]))
    measurements: list[Measurement] = [
        *stereo_frames(world),
        *marker_sightings(world),
        *cloud_frames(world),
        *cylinders(world),
        *clicks(world),
    ]
    order = {StereoFrame: 0, MarkerSighting: 1, CloudFrame: 2, OutlineSighting: 3, Pick: 4, CylinderSighting: 5}
    measurements.sort(key=lambda measurement: (measurement.stamp_ns, order[type(measurement)]))
    cameras = {name: _model(camera, scenario.baseline_m) for name, camera in world.nominal.items()}
    picks = [measurement for measurement in measurements if isinstance(measurement, Pick)]
    return Run(tuple(measurements), world.rig, cameras, _truth(world), tuple(stereo_clicks(world, picks)))


def base_rig(scenario: Scenario, side: float, radius_m: float) -> Rig:
    """The rig file of a run: an A4 board with four 75 mm markers beside the Kinect, and the scenario's own keys."""
    marker_places = ((-0.05, 0.09), (0.05, 0.09), (-0.05, -0.09), (0.05, -0.09))
    board = Board(id="f0", markers=tuple(Marker(id=i, centre_m=place) for i, place in enumerate(marker_places)))
    # The drawn lenses have no distortion, so there is none to be found.
    cameras = Cameras()
    undistorted = {
        name: getattr(cameras, name).model_copy(update={"freeze": ("distortion",)})
        for name in ("m_left", "m_right", "b_rgb")
    }
    rig = Rig(
        cameras=cameras.model_copy(update=undistorted),
        boards=(board,),
        mount=Mount(
            board="f0",
            f_T_b=Pose(translation_m=(0.3 * side, 0.08, -0.02), rotation_vector_rad=(0.0, 0.0, np.pi)),
        ),
        pipes=(Pipe(id="pipe0", nominal_diameter_m=2 * radius_m if scenario.nominal_diameter else None),),
    )
    return Rig.model_validate(merged(rig.model_dump(mode="json", by_alias=True), scenario.rig))


def _build_world(scenario: Scenario, rng: np.random.Generator, outlier_rng: np.random.Generator) -> World:
    nominal_radius_m = 0.5 * float(rng.choice([0.06, 0.089, 0.11]))
    rig = base_rig(scenario, float(rng.choice([-1.0, 1.0])), nominal_radius_m)
    # A wide draw would be a pipe of another kind than the file says.
    radius_m = nominal_radius_m + (0.5 * rng.normal(0.0, rig.pipes[0].diameter_sigma_m) if scenario.faults else 0.0)
    scene = build_scene(scenario, radius_m, rng)
    nominal = _nominal_cameras(scenario)
    true = (
        draw_rig(rig, nominal, scenario.baseline_m, rng)
        if scenario.faults
        else nominal_rig(rig, nominal, scenario.baseline_m)
    )
    if scenario.stereo is not None:
        true = with_stereo_fault(true, scenario.baseline_m, scenario.stereo)
    first = rig.boards[0].id
    true.boards[first] = misprinted(true.boards[first], scenario.board)
    w_T_f = {rig.boards[0].id: scene.w_T_b @ invert(true.f_T_b)}
    stamps_s, w_T_m, places_s = mobile_path(scene, w_T_f[rig.boards[0].id][:3, 3], scenario.motion, rng)
    stamps_ns = tuple(START_NS + round(1e9 * float(t)) for t in stamps_s)
    nearest = [int(np.abs(stamps_s - t).argmin()) for t in places_s[: scenario.picks.places]]
    return World(
        scenario=scenario,
        rig=_with_known_distances(rig, true, scenario, rng),
        nominal=nominal,
        true=true,
        scene=scene,
        w_T_m=w_T_m,
        w_T_f=w_T_f,
        stamps_ns=stamps_ns,
        place_stamps_ns=tuple(stamps_ns[i] for i in nearest),
        points_w=_named_points(scenario, scene, rng),
        inset=_inset(scenario, rng),
        rng=rng,
        outlier_rng=outlier_rng,
    )


def _inset(scenario: Scenario, rng: np.random.Generator) -> float:
    """What the pipe's edges share; from a stream of its own, so that nothing else is drawn anew."""
    return float(rng.spawn(1)[0].normal(0.0, INSET_SHARE)) if scenario.faults else 0.0


def _named_points(scenario: Scenario, scene: Scene, rng: np.random.Generator) -> dict[str, Float]:
    """The points that the operator names: on the axis; for the role `other` on the surface that all places see."""
    pipe = scene.pipe
    points = {}
    for index, role in enumerate(scenario.picks.roles):
        point = pipe.base + (0.95 + 0.25 * index + rng.uniform(-0.1, 0.1)) * pipe.axis
        if role == "other":
            outwards = np.cross(pipe.axis, [-scene.side, 0.0, 0.0])
            point = point + pipe.radius_m * outwards / np.linalg.norm(outwards)
        points[f"P{index + 1}"] = point
    return points


def _with_known_distances(rig: Rig, true: TrueRig, scenario: Scenario, rng: np.random.Generator) -> Rig:
    """Two diagonals of the board taken with callipers, and the side length as it was typed."""
    board, page = rig.boards[0], true.boards[rig.boards[0].id]
    distances = list(rig.distances)
    if not distances and len(page.markers) > 3:
        for a, b in ((0, 3), (1, 2)):
            sigma_m = 3e-4
            length_m = float(np.linalg.norm(page.corners_m[a].mean(0) - page.corners_m[b].mean(0)))
            given_m = length_m + float(rng.normal(0.0, sigma_m))
            ends = {"from": str(page.markers[a]), "to": str(page.markers[b])}
            distances.append(Distance.model_validate({**ends, "distance_m": given_m, "sigma_m": sigma_m}))
    boards = rig.boards
    if scenario.typed_side_m is not None:
        boards = (board.model_copy(update={"side_m": scenario.typed_side_m}), *boards[1:])
    return rig.model_copy(update={"distances": tuple(distances), "boards": boards})


def _truth(world: World) -> Truth:
    o_T_w = invert(world.w_T_m[0])
    b_T_w = invert(world.scene.w_T_b)
    pipe = world.scene.pipe
    return Truth(
        stamps_ns=world.stamps_ns,
        o_T_m=o_T_w @ world.w_T_m,
        o_T_b=o_T_w @ world.scene.w_T_b,
        o_T_f={name: o_T_w @ w_T_f for name, w_T_f in world.w_T_f.items()},
        points_b_m={name: transform(b_T_w, point) for name, point in world.points_w.items()},
        pipe=TruePipe(
            transform(b_T_w, pipe.base), b_T_w[:3, :3] @ pipe.axis, pipe.radius_m, world.inset * pipe.radius_m
        ),
        rig=world.true,
    )


def _nominal_cameras(scenario: Scenario) -> dict[str, TrueCamera]:
    centre = np.array([scenario.width_px, scenario.height_px]) / 2.0 - 0.5
    K = np.array([[scenario.focal_px, 0.0, centre[0]], [0.0, scenario.focal_px, centre[1]], [0.0, 0.0, 1.0]])
    K_rgb = np.array([[525.0, 0.0, 319.5], [0.0, 525.0, 239.5], [0.0, 0.0, 1.0]])
    return {
        "m_left": TrueCamera("m_left", scenario.width_px, scenario.height_px, K),
        "m_right": TrueCamera("m_right", scenario.width_px, scenario.height_px, K),
        "b_rgb": TrueCamera("b_rgb", *COLOUR_SIZE, K_rgb),
    }


def _model(camera: TrueCamera, baseline_m: float) -> CameraModel:
    return CameraModel(
        name=camera.name,
        width=camera.width,
        height=camera.height,
        K=camera.K,
        distortion_model="none",
        D=np.zeros(0),
        rectification=np.eye(3),
        baseline_m=baseline_m if camera.name == "m_right" else None,
    )
