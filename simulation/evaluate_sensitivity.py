"""Which input error moves the point by how much: finite differences of the whole estimate."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..factors.camera import CameraModel
from ..factors.measurements import CloudFrame, MarkerSighting, Pick, StereoFrame
from ..factors.rig import Pose, Rig
from .campaign_estimate import estimate_run
from .measurement_level import Run

Float = NDArray[np.float64]
Change = Callable[[Run], Run]


@dataclass(frozen=True, slots=True)
class InputError:
    """One way in which the input may be wrong, and by how much it is changed."""

    name: str
    step: float
    unit: str
    change: Change


@dataclass(frozen=True, slots=True)
class Sensitivity:
    """How a point answers to an input error."""

    point: str
    input: str
    step: float
    unit: str
    moved_b_m: Float
    """Shape (3,), difference of the point in {b} for that step."""


def sensitivities(run: Run, inputs: tuple[InputError, ...] | None = None) -> tuple[Sensitivity, ...]:
    """One estimate for the run as it is and one for every changed input."""
    plain = {point.id: point.position_m for point in estimate_run(run).points}
    found = []
    for error in inputs or input_errors():
        result = estimate_run(error.change(run))
        found += [
            Sensitivity(point.id, error.name, error.step, error.unit, point.position_m - plain[point.id])
            for point in result.points
            if point.id in plain
        ]
    return tuple(found)


def input_errors() -> tuple[InputError, ...]:
    """The errors that a site makes, each about as large as it makes them."""
    turns = [
        InputError(f"mount turned about {axis}", 0.1, "deg", _mount(np.deg2rad(0.1) * row, np.zeros(3)))
        for axis, row in zip("xyz", np.eye(3), strict=True)
    ]
    shifts = [
        InputError(f"mount shifted along {axis}", 1.0, "mm", _mount(np.zeros(3), 1e-3 * row))
        for axis, row in zip("xyz", np.eye(3), strict=True)
    ]
    return (
        *turns,
        *shifts,
        InputError("mobile focal length", 0.3, "%", _focal(1.003)),
        InputError("mobile baseline", 2.0, "%", _baseline(1.02)),
        InputError("marker side", 0.5, "mm", _side(5e-4)),
        InputError("known distances", 0.5, "%", _distances(1.005)),
        InputError("marker corners along u", 0.1, "px", _corners(np.array([0.1, 0.0]))),
        InputError("disparity of the tracks", 0.1, "px", _disparity(0.1)),
        InputError("Kinect depth", 10.0, "mm", _depth(0.01)),
        InputError("clicks along u", 1.0, "px", _clicks(np.array([1.0, 0.0]))),
    )


def _mount(turn_rad: Float, shift_m: Float) -> Change:
    def change(run: Run) -> Run:
        mount = run.rig.mount
        if mount is None:
            return run
        # Small angles: the vector of the product is close enough to the sum for a step of a tenth of a degree.
        turn = np.array(mount.f_T_b.rotation_vector_rad) + turn_rad
        shift = np.array(mount.f_T_b.translation_m) + shift_m
        pose = Pose(translation_m=_triple(shift), rotation_vector_rad=_triple(turn))
        return _with_rig(run, mount=mount.model_copy(update={"f_T_b": pose}))

    return change


def _focal(factor: float) -> Change:
    def change(run: Run) -> Run:
        def scaled(camera: CameraModel) -> CameraModel:
            return replace(camera, K=camera.K * np.array([[factor], [factor], [1.0]]) + _centre(camera, factor))

        cameras = {name: scaled(c) if name.startswith("m_") else c for name, c in run.cameras.items()}
        return replace(run, cameras=cameras)

    return change


def _centre(camera: CameraModel, factor: float) -> Float:
    back = np.zeros((3, 3))
    back[:2, 2] = (1.0 - factor) * camera.K[:2, 2]
    return back


def _baseline(factor: float) -> Change:
    def change(run: Run) -> Run:
        right = run.cameras["m_right"]
        longer = replace(right, baseline_m=(right.baseline_m or 0.0) * factor)
        return replace(run, cameras={**run.cameras, "m_right": longer})

    return change


def _side(step_m: float) -> Change:
    def change(run: Run) -> Run:
        boards = tuple(b.model_copy(update={"side_m": b.side_m + step_m}) for b in run.rig.boards)
        return _with_rig(run, boards=boards)

    return change


def _distances(factor: float) -> Change:
    def change(run: Run) -> Run:
        longer = tuple(d.model_copy(update={"distance_m": d.distance_m * factor}) for d in run.rig.distances)
        return _with_rig(run, distances=longer)

    return change


def _corners(shift_px: Float) -> Change:
    return _each(lambda m: replace(m, corners_px=m.corners_px + shift_px) if isinstance(m, MarkerSighting) else m)


def _disparity(step_px: float) -> Change:
    shift_px = np.array([step_px, 0.0])
    return _each(lambda m: replace(m, right_px=m.right_px - shift_px) if isinstance(m, StereoFrame) else m)


def _clicks(shift_px: Float) -> Change:
    return _each(lambda m: replace(m, px=m.px + shift_px) if isinstance(m, Pick) else m)


def _depth(step_m: float) -> Change:
    def deeper(m: object) -> object:
        if not isinstance(m, CloudFrame):
            return m
        return replace(m, points_m=m.points_m * (1.0 + step_m / m.points_m[:, 2:]))

    return _each(deeper)


def _each(change_one: Callable[[object], object]) -> Change:
    return lambda run: replace(run, measurements=tuple(change_one(m) for m in run.measurements))


def _with_rig(run: Run, **update: object) -> Run:
    rig: Rig = run.rig.model_copy(update=update)
    return replace(run, rig=rig)


def _triple(values: Float) -> tuple[float, float, float]:
    return float(values[0]), float(values[1]), float(values[2])
