"""What a run at measurement level is made of: a scenario file (YAML), unknown keys are errors."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import yaml
from pydantic import Field, ValidationError

from ..factors.errors import RigError
from ..factors.rig import NonNegative, Positive, Section

Share = Annotated[float, Field(ge=0.0, le=1.0)]
Count = Annotated[int, Field(ge=0)]
Interval = tuple[Positive, Positive]


class Outliers(Section):
    """Gross errors: which share of the measurements, and how large, uniform in direction and size up to `size`."""

    share: Share = 0.0
    families: tuple[Literal["tracks", "markers", "clouds", "picks", "outlines"], ...] = (
        "tracks",
        "markers",
        "clouds",
        "picks",
        "outlines",
    )
    size_px: Positive = 30.0
    size_m: Positive = 0.3


class NoiseFactors(Section):
    """True noise over stated noise, by family. 1: the models are right; 2: the estimator is told half of it."""

    tracks: Positive = 1.0
    markers: Positive = 1.0
    clouds: Positive = 1.0
    picks: Positive = 1.0
    outlines: Positive = 1.0


class PipePlace(Section):
    """Where the pipe stands: uniform between two limits."""

    distance_m: Interval = (1.9, 2.2)
    """Before the machine. The panel, if there is one, stands at 1.45 m."""
    offset_m: tuple[float, float] = (-0.25, 0.25)
    """To the machine's left."""


class Motion(Section):
    """The mobile camera's way: in front of the board, round the panel, three places with the pipe in view."""

    duration_s: Positive = 20.0
    keyframe_turn_rad: Positive = 0.2
    """A keyframe at the latest after this turn, this way, and this time: the map has to stay in view."""
    keyframe_way_m: Positive = 0.25
    keyframe_time_s: Positive = 1.0
    board_distance_m: Interval = (1.0, 1.25)
    """Of the camera from the board when it first sees it."""
    board_share: Annotated[float, Field(gt=0.0, lt=0.8)] = 0.3
    """Share of the time spent before the board."""
    style: Literal["smooth", "sharp"] = "smooth"
    returns: bool = False
    """The board is seen again at the end."""


class Tracks(Section):
    """Features of the mobile stereo pair."""

    per_frame: Count = 70
    sigma_px: Positive = 0.25
    right_share: Share = 0.9
    """Share of the features that are found in the right image too."""
    mean_life_frames: Positive = 20.0
    motion_sigma_m: NonNegative = 0.003
    motion_sigma_rad: NonNegative = 0.0006
    """Of the front end's motion from frame to frame: a first guess only."""


class Markers(Section):
    sigma_px: Positive = 0.12
    smallest_side_px: Positive = 13.0


class Clouds(Section):
    """Kinect depth images. 0 frames: no Kinect."""

    frames: Count = 2
    points: Count = 2000
    cylinder: bool = True
    """The pipe is found in the cloud, where the Kinect sees it."""


class Picks(Section):
    """Operator clicks at each of the places on each of the two pipe points."""

    places: Annotated[int, Field(ge=1, le=3)] = 3
    clicks: Annotated[int, Field(ge=1)] = 2
    sigma_px: Positive = 1.0
    roles: tuple[Literal["grasp", "cut", "other"], ...] = ("grasp", "cut")
    outlines: bool = True
    """The pipe's two outline edges in the image of every click."""
    outline_sigma_px: Positive = 0.3


class BoardFaults(Section):
    """What is wrong with the first board, and not in the rig file."""

    page_scale: Positive = 1.0
    swapped: tuple[int, int] | None = None
    """Two ids that stand in each other's place."""
    loose: int | None = None
    loose_at_s: NonNegative = 0.0
    loose_shift_m: tuple[float, float] = (0.006, -0.004)
    loose_turn_rad: float = 0.05
    knock_at_s: NonNegative | None = None
    knock_shift_m: tuple[float, float, float] = (0.02, 0.0, 0.01)
    """In {f}."""
    knock_turn_rad: tuple[float, float, float] = (0.0, 0.06, 0.0)
    inset_px: float = 0.0
    """All corners found so far inside their markers, along the diagonal."""


class StereoFault(Section):
    """How far the stereo pair is off its calibration, set instead of drawn. Positive: depth reads short."""

    baseline_rel: float = 0.0
    disparity_px: float = 0.0


class Scenario(Section):
    """One kind of run. Every run draws scene, faults of the rig, motion and noise anew from its seed."""

    name: str = "cell"
    text: str = ""
    seed: int = 0
    """Added to the seed of the run."""
    width_px: Annotated[int, Field(ge=64)] = 360
    height_px: Annotated[int, Field(ge=48)] = 240
    focal_px: Positive = 270.0
    baseline_m: Positive = 0.15
    panel: bool = True
    """A panel hides the pipe from the Kinect."""
    pipe: PipePlace = PipePlace()
    motion: Motion = Motion()
    tracks: Tracks = Tracks()
    markers: Markers = Markers()
    clouds: Clouds = Clouds()
    picks: Picks = Picks()
    noise_factors: NoiseFactors = NoiseFactors()
    outliers: Outliers = Outliers()
    board: BoardFaults = BoardFaults()
    faults: bool = True
    """False: the rig is in truth exactly as its file says."""
    stereo: StereoFault | None = None
    """Baseline and vergence of the pair; None: drawn like the rest."""
    typed_side_m: Positive | None = None
    """Side length that the rig file gives when it is wrong; None: the right one."""
    nominal_diameter: bool = True
    """The rig file gives the pipe's diameter."""
    rig: dict[str, object] = Field(default_factory=dict)
    """Merged into the rig file of the runs, key by key."""


def load_scenarios(path: Path) -> tuple[Scenario, ...]:
    """The scenarios of a YAML file: one, or with `runs` one for each of its entries, laid over the common keys.

    Raises:
        RigError: the file cannot be read, is no YAML, or a key or value is wrong; names file and key.
    """
    try:
        data = yaml.safe_load(path.read_bytes())
    except OSError as error:
        raise RigError(f"{path}: cannot be read ({error.strerror}); give a scenario file or name") from error
    except yaml.YAMLError as error:
        raise RigError(f"{path}: is no YAML ({' '.join(str(error).split())})") from error
    data = data or {}
    if not isinstance(data, dict) or not isinstance(data.get("runs", []), list):
        raise RigError(f"{path}: is no scenario; it must hold keys such as motion, tracks and picks")
    common = {key: value for key, value in data.items() if key != "runs"}
    try:
        return tuple(Scenario.model_validate(merged(common, one)) for one in data.get("runs") or [{}])
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"]) or "scenario"
        raise RigError(f"{path}: {where}: {first['msg']}") from error


def merged(base: Mapping[str, Any], extra: Mapping[str, Any]) -> dict[str, Any]:
    """`extra` laid over `base`, mappings key by key."""
    found = dict(base)
    for key, value in extra.items():
        old = found.get(key)
        found[key] = merged(old, value) if isinstance(old, dict) and isinstance(value, Mapping) else value
    return found
