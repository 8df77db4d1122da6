"""The rig file: what is known about the set-up before the recording, with tolerances. Unknown keys are errors.

`load_rig` reads YAML; `Rig` is frozen and passed along, never looked up. Lengths in metres, angles in radians,
pixels in OpenCV's convention. Poses are `a_T_b`: the pose of b in a.
"""

import hashlib
from pathlib import Path
from typing import Annotated, Literal, Self

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from .errors import RigError

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Vector3 = tuple[Finite, Finite, Finite]


class Section(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", defer_build=True)  # each once, when the rig is read


class Pose(Section):
    """`a_T_b` as translation and rotation vector."""

    translation_m: Vector3 = (0.0, 0.0, 0.0)
    rotation_vector_rad: Vector3 = (0.0, 0.0, 0.0)


class Camera(Section):
    """Where a camera's data comes from, and how far its given calibration is trusted."""

    image_topic: str
    info_topic: str
    markers_topic: str | None = None
    focal_sigma_rel: NonNegative = 0.003
    centre_sigma_px: NonNegative = 1.0
    distortion_sigma: NonNegative = 0.002
    """What the given lens model leaves over: sigma of its radial coefficients, at 45 degrees from the axis."""
    freeze: tuple[Literal["focal", "centre", "distortion"], ...] = ()


class Cameras(Section):
    m_left: Camera = Camera(
        image_topic="/m/left/image_raw", info_topic="/m/left/camera_info", markers_topic="/m/left/markers"
    )
    m_right: Camera = Camera(
        image_topic="/m/right/image_raw", info_topic="/m/right/camera_info", markers_topic="/m/right/markers"
    )
    b_rgb: Camera = Camera(
        image_topic="/b/rgb/image_raw", info_topic="/b/rgb/camera_info", markers_topic="/b/rgb/markers"
    )
    b_depth: Camera = Camera(image_topic="/b/depth/image_raw", info_topic="/b/depth/camera_info")


class Stereo(Section):
    """The right mobile camera in the left one."""

    m_left_T_m_right: Pose | None = None
    """None: from the right camera_info (`P[3]` and the rectification matrices)."""
    baseline_sigma_rel: NonNegative = 0.02
    translation_sigma_m: NonNegative = 0.001
    """Of the two components across the baseline."""
    rotation_sigma_rad: NonNegative = 0.003
    freeze: bool = False


class Kinect(Section):
    """The machine's depth camera. {b} is its depth camera's optical frame."""

    model: Literal["kinect_v1", "kinect_v2", "azure", "realsense"] = "kinect_v1"
    points_topic: str = "/b/points"
    depth_offset_sigma_m: NonNegative = 0.02
    depth_scale_sigma: NonNegative = 0.01
    b_T_rgb: Pose = Pose()
    b_T_rgb_translation_sigma_m: NonNegative = 0.005
    b_T_rgb_rotation_sigma_rad: NonNegative = 0.01
    freeze: tuple[Literal["depth_offset", "depth_scale", "b_T_rgb"], ...] = ()


class Marker(Section):
    """One marker on a page: its centre in the page frame (x right, y up) and its turn about the normal."""

    id: Annotated[int, Field(ge=0)]
    centre_m: tuple[Finite, Finite]
    rotation_rad: Finite = 0.0


class Board(Section):
    """A page with markers. Frame {f}: origin at the page's centre, x right, y up, z out of the page."""

    id: str
    dictionary: str = "DICT_4X4_50"
    """An OpenCV dictionary name; `DICT_APRILTAG_36h11` also for the family `tag36h11` in messages."""
    side_m: Positive = 0.075
    side_sigma_m: Positive = 0.0005
    print_scale_sigma: Positive = 0.005
    """Relative tolerance of the printed page's size, common to all markers."""
    centre_sigma_m: Positive = 0.0002
    """Tolerance of a single marker's place on the page."""
    attached_to: Literal["b", "world"] = "b"
    markers: tuple[Marker, ...] = Field(min_length=1)
    message_corner_order: Literal["apriltag", "opencv"] = "apriltag"

    @model_validator(mode="after")
    def _unique_ids(self) -> Self:
        ids = [marker.id for marker in self.markers]
        double = sorted({i for i in ids if ids.count(i) > 1})
        if double:
            raise ValueError(f"marker id {double[0]} stands twice on board {self.id}")
        return self


class Distance(Section):
    """A known distance between two marker points: `29` is the centre of marker 29, `29/0` its corner 0.

    Corners 0..3 = (-,-), (+,-), (+,+), (-,+) in the marker's frame. Where two boards carry the same id write
    `f1:29/0`.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", populate_by_name=True)
    point_a: str = Field(alias="from")
    point_b: str = Field(alias="to")
    distance_m: Positive
    sigma_m: Positive


class Mount(Section):
    """The tape-measured pose of {b} in a board's frame."""

    board: str
    f_T_b: Pose
    translation_sigma_m: Positive = 0.001
    rotation_sigma_rad: Positive = 0.00175


class WorldBoard(Section):
    """A board whose pose is given: it defines a frame of the user's own, in which poses are reported too."""

    board: str
    world_T_f: Pose = Pose()
    translation_sigma_m: Positive = 1e-4
    rotation_sigma_rad: Positive = 1e-5


class Noise(Section):
    """Noise where the measurements cannot tell it themselves."""

    marker_message_sigma_px: Positive = 0.3
    """Corners that arrive as messages, with no image to judge them by."""
    marker_common_px: NonNegative = 0.005
    """Part of a corner's error that is the same in views from the same place, at least: what the corner fit leaves on
    images without noise. A front end that sees more of it in the pixels says so with each sighting."""
    pick_floor_px: NonNegative = 0.3
    """No click is better than this: it falls on a whole pixel, a step over root twelve."""


class Gates(Section):
    """When a measurement is refused (chi-square probabilities) and how hard large residuals are softened."""

    gate_probability: Annotated[float, Field(gt=0, lt=1)] = 1e-4
    robust_sigma: Positive = 2.5
    """Where the robust loss begins, in sigmas of one dimension; more dimensions: the same probability."""


class Box(Section):
    """A keep-out box in {b}."""

    minimum_m: Vector3
    maximum_m: Vector3


class Cut(Section):
    """What has to hold for one cut point."""

    point: str
    tolerance_along_m: Positive
    tolerance_across_m: Positive
    blade_width_m: NonNegative = 0.0
    clearance_m: NonNegative = 0.0
    keep_out: tuple[Box, ...] = ()
    tool_sigma_m: NonNegative = 0.002
    """Standard deviation of the tool centre against its command, per axis: robot and tool together."""
    wrong_go_probability: Annotated[float, Field(gt=0, lt=0.5)] = 0.05
    board_age_limit_s: Positive = 120.0
    """Longest time since a board was last seen. After it nobody has looked whether the machine still stands where it
    stood. The default is an agreement, not a measurement: time to put the camera down, click and read the report."""


class Pipe(Section):
    """A pipe that the picks are on. `points` lists their ids; none: all cut and grasp picks share the pipe."""

    id: str = "pipe0"
    points: tuple[str, ...] = ()
    nominal_diameter_m: Positive | None = None
    diameter_sigma_m: Positive = 0.002


class Rig(Section):
    """Everything that is known beforehand."""

    version: Literal[1] = 1
    cameras: Cameras = Cameras()
    stereo: Stereo = Stereo()
    kinect: Kinect = Kinect()
    boards: tuple[Board, ...] = ()
    distances: tuple[Distance, ...] = ()
    mount: Mount | None = None
    world_board: WorldBoard | None = None
    pipes: tuple[Pipe, ...] = ()
    picks_topic: str = "/picks"
    noise: Noise = Noise()
    gates: Gates = Gates()
    cut_plan: tuple[Cut, ...] = ()

    @model_validator(mode="after")
    def _references(self) -> Self:
        boards = [board.id for board in self.boards]
        if len(set(boards)) < len(boards):
            raise ValueError("two boards have one id")
        seen: dict[tuple[str, int], str] = {}
        for board in self.boards:
            for marker in board.markers:
                other = seen.setdefault((board.dictionary, marker.id), board.id)
                if other != board.id:
                    raise ValueError(f"marker id {marker.id} stands on board {other} and on board {board.id}")
        for section in (self.mount, self.world_board):
            if section is not None and section.board not in boards:
                raise ValueError(f"there is no board {section.board!r}; boards: {', '.join(boards)}")
        return self


def load_rig(source: Path | str | bytes, name: str | None = None) -> Rig:
    """The rig from a YAML file (`Path`) or its text.

    Raises:
        RigError: the file cannot be read, is no YAML, or a key or value is wrong; names file and key.
    """
    label = name or (str(source) if isinstance(source, Path) else "rig")
    try:
        text = source.read_bytes() if isinstance(source, Path) else source
        data = yaml.safe_load(text)
    except OSError as error:
        raise RigError(f"{label}: cannot be read ({error.strerror}); give the rig file with --rig") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise RigError(f"{label}: is no YAML ({' '.join(str(error).split())})") from error
    if not isinstance(data, dict):
        raise RigError(f"{label}: is no rig file; `surecut rig --example` prints one")
    try:
        return Rig.model_validate(data)
    except ValidationError as error:
        raise RigError(f"{label}: {_one_line(error)}") from error


def sha256_of(rig: "Rig") -> str:
    """Tells rigs apart."""
    return hashlib.sha256(dump_rig(rig).encode()).hexdigest()


def dump_rig(rig: Rig) -> str:
    """The effective configuration as YAML: every key, defaults included; `load_rig` reads it back equal."""
    return yaml.safe_dump(rig.model_dump(mode="json", by_alias=True), sort_keys=False, allow_unicode=True)


def _one_line(error: ValidationError) -> str:
    first = error.errors()[0]
    where = ".".join(str(part) for part in first["loc"]) or "rig"
    if first["type"] == "extra_forbidden":
        return f"unknown key {where}; `surecut rig --example` lists the keys"
    message = first["msg"].removeprefix("Value error, ")
    given = "" if isinstance(first["input"], dict | list) else f" (got {first['input']!r})"
    more = f" (and {error.error_count() - 1} more)" if error.error_count() > 1 else ""
    return f"{where}: {message}{given}{more}"
