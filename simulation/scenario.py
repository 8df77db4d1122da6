"""What to simulate, as a file: every key has a default, unknown keys are errors."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import yaml
from pydantic import Field, ValidationError, model_validator

from ..factors.errors import SurecutError
from ..factors.rig import Finite, NonNegative, Positive, Section

FOLDER = Path(__file__).parent / "scenarios"
Distortion = Annotated[tuple[Finite, ...], Field(min_length=0, max_length=5)]
Interval = tuple[NonNegative, NonNegative]


class ScenarioError(SurecutError):
    """A scenario file cannot be used."""


class Mobile(Section):
    """The hand-held stereo camera."""

    width: Annotated[int, Field(gt=15)] = 360
    height: Annotated[int, Field(gt=15)] = 240
    focal_px: Positive = 270.0
    baseline_m: Positive = 0.15
    rate_hz: Positive = 20.0
    distortion: Distortion = ()
    """plumb_bob coefficients k1 k2 p1 p2 k3, true and given."""


class Kinect(Section):
    """The machine's camera: depth, and colour beside it."""

    rate_hz: Positive = 5.0
    width: Annotated[int, Field(gt=15)] = 640
    height: Annotated[int, Field(gt=15)] = 480
    depth_focal_px: Positive = 585.0
    rgb_focal_px: Positive = 525.0
    rgb: bool = True
    rgb_distortion: Distortion = ()
    noise_correlation_px: NonNegative = 0.5
    """Smoothing of the depth noise across pixels; its standard deviation stays as published."""


class Light(Section):
    """Lamps, exposure and the sensor's noise."""

    level: Positive = 1.0
    """Brightness of the lamps; the exposure does not follow it."""
    exposure_s: NonNegative = 0.008
    full_well_electrons: Positive = 7000.0
    """Electrons at full scale: fewer are noisier."""
    read_noise: NonNegative = 0.004
    """Standard deviation as a share of full scale."""
    gamma: Positive = 1.4
    vignetting: NonNegative = 0.25
    """Loss of light in the corners of the image."""
    blur_px: NonNegative = 0.45
    """Gaussian blur of the lens."""


class PipeOptions(Section):
    """The pipe to be cut."""

    diameter_m: Positive | None = None
    """None: 60 to 110 mm by seed."""
    tilt_rad: NonNegative | None = None
    """None: up to 0.3 rad by seed."""
    hidden: bool = True
    """A panel hides the pipe from the Kinect."""
    second: bool = False
    """A nearly parallel neighbour."""


class LooseMarker(Section):
    """A marker that came off and was pushed back out of place."""

    id: int
    shift_m: tuple[Finite, Finite] = (0.006, -0.004)
    turn_rad: Finite = 0.05


class Knock(Section):
    """The board is pushed out of place at a moment."""

    at_s: NonNegative
    shift_m: tuple[Finite, Finite, Finite] = (0.02, 0.0, 0.01)
    turn_rad: tuple[Finite, Finite, Finite] = (0.0, 0.06, 0.0)


class BoardOptions(Section):
    """The fiducial page, and what may be wrong with it."""

    side_m: Positive = 0.075
    typed_side_m: Positive | None = None
    """What the rig file says instead of `side_m`."""
    page_scale: Positive = 1.0
    """Everything on the page scaled, as by a printer."""
    swapped: tuple[int, int] | None = None
    loose: LooseMarker | None = None
    knock: Knock | None = None
    measured_distances: bool = True
    """The rig file holds distances between marker centres, measured on the printed page."""


class Sigmas(Section):
    """Standard deviations of the true rig about its nominal values; the rig file states them as its tolerances."""

    baseline_rel: NonNegative = 0.01
    disparity_px: NonNegative = 0.15
    """Of the vergence, as disparity at infinity."""
    right_turn_rad: NonNegative = 0.0006
    right_shift_m: NonNegative = 0.0003
    focal_rel: NonNegative = 0.002
    centre_px: NonNegative = 0.5
    mount_m: NonNegative = 0.001
    mount_rad: NonNegative = 0.00175
    print_scale: NonNegative = 0.002
    ink_m: NonNegative = 0.0001
    marker_m: NonNegative = 0.0001
    distance_m: NonNegative = 0.0003
    depth_offset_m: NonNegative = 0.015
    depth_scale: NonNegative = 0.005
    rgb_m: NonNegative = 0.002
    rgb_rad: NonNegative = 0.004


class Bias(Section):
    """Errors of the stereo rig that are set, not drawn. Positive ones make depth read short."""

    baseline_rel: Finite | None = None
    disparity_px: Finite | None = None


class Timeline(Section):
    """What happens when, in seconds from the start."""

    covered: tuple[Interval, ...] = ()
    """A hand on the lens."""
    still: tuple[Interval, ...] = ()
    """The mobile camera is put down."""
    turned: tuple[Interval, ...] = ()
    """The mobile camera looks away: it turns by 115 degrees within a quarter of a second, and back as fast."""
    base_move: Interval | None = None
    """The machine drives to a second station."""
    arm_moves: bool = False


class PickOptions(Section):
    """The operator's clicks."""

    sigma_px: Positive = 1.0
    in_kinect: bool = True
    """Also in the Kinect's colour image where the point is visible there."""


class Scenario(Section):
    """One recording."""

    name: str = "demo"
    description: str = ""
    duration_s: Positive = 30.0
    place: Literal["A", "B", "C"] = "B"
    motion: Literal["smooth", "sharp"] = "smooth"
    initialisation: Annotated[int, Field(ge=0, le=9)] = 0
    """Which start before the board; each has its own distance and angle."""
    return_to_board: bool = True
    mobile: Mobile = Mobile()
    kinect: Kinect = Kinect()
    light: Light = Light()
    pipe: PipeOptions = PipeOptions()
    board: BoardOptions = BoardOptions()
    sigmas: Sigmas = Sigmas()
    bias: Bias = Bias()
    timeline: Timeline = Timeline()
    picks: PickOptions = PickOptions()
    jpeg_quality: Annotated[int, Field(ge=1, le=100)] | None = None
    """Images as `CompressedImage` of that quality; None: raw."""
    detail: Annotated[float, Field(gt=0, le=4)] = 1.0
    """Fineness of the textures (the page is always fine); lower starts faster, higher suits large images."""

    @model_validator(mode="after")
    def _long_enough(self) -> Self:
        if self.duration_s < 1.0:
            raise ValueError("duration_s must be 1 at least")
        return self


def scenario_names() -> list[str]:
    """Scenarios that come with the package."""
    return sorted(path.stem for path in FOLDER.glob("*.yaml"))


def load_scenarios(source: Path | str) -> list[Scenario]:
    """The runs of a scenario file, or of a scenario that comes with the package.

    A file holds the keys of `Scenario`; with `runs`, a list of such keys, there is one scenario for each entry,
    over the common keys.

    Raises:
        ScenarioError: there is no such file or scenario, or a key or value in it is wrong.
    """
    path = Path(source)
    if not path.is_file():
        path = FOLDER / f"{source}.yaml"
        if not path.is_file():
            names = ", ".join(scenario_names())
            raise ScenarioError(f"{source}: there is no such scenario; give a file or one of {names}")
    try:
        data = yaml.safe_load(path.read_bytes()) or {}
    except (OSError, yaml.YAMLError, UnicodeDecodeError) as error:
        raise ScenarioError(f"{path}: is no readable YAML ({' '.join(str(error).split())})") from error
    if not isinstance(data, dict) or not isinstance(data.get("runs", []), list):
        raise ScenarioError(f"{path}: is no scenario; it must hold keys such as place, motion and duration_s")
    common = {"name": path.stem, **{key: value for key, value in data.items() if key != "runs"}}
    try:
        return [Scenario.model_validate(_over(common, run)) for run in data.get("runs", [{}])]
    except ValidationError as error:
        raise ScenarioError(f"{path}: {_first(error)}") from error


def override(scenario: Scenario, changes: Mapping[str, Any]) -> Scenario:
    """The scenario with some keys changed, section by section.

    Raises:
        ScenarioError: a key or value is wrong.
    """
    try:
        return Scenario.model_validate(_over(scenario.model_dump(), changes))
    except ValidationError as error:
        raise ScenarioError(f"scenario {scenario.name}: {_first(error)}") from error


def _first(error: ValidationError) -> str:
    first = error.errors()[0]
    where = ".".join(str(part) for part in first["loc"]) or "scenario"
    return f"{where}: {first['msg'].removeprefix('Value error, ')}"


def _over(common: Mapping[str, Any], run: Mapping[str, Any]) -> dict[str, Any]:
    """The common keys with those of one run laid over them, section by section."""
    merged = dict(common)
    for key, value in run.items():
        below = merged.get(key)
        merged[key] = _over(below, value) if isinstance(below, dict) and isinstance(value, dict) else value
    return merged
