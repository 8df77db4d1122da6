"""Where the stated uncertainty has been tested against truth. Outside of it no cut is permitted.

The file is written by `surecut campaign --range` and sealed with a digest over its content: a file that was edited by
hand, or that refutes the stated uncertainty, is refused.
"""

import hashlib
import json
import math
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Self

import numpy as np
import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from ..factors.errors import SurecutError
from .result import PointEstimate, Result

FILE = "validated_range.yaml"
QUANTITIES = {
    "distance_m": "distance of the point from the machine's camera",
    "radius95_m": "radius of the 95 % region",
    "measurements": "measurements of the point",
    "duration_s": "length of the recording",
    "focal_px": "focal length of the mobile camera in pixels",
    "baseline_m": "baseline of the mobile camera",
}
"""What a range can be given for, and its name in words."""


LEAST_COVERAGE = 0.9
"""A campaign whose 95 % regions held the truth less often refutes the stated uncertainty."""


class ValidatedRange(BaseModel):
    """The outcome of a validation campaign, as far as a decision needs it."""

    model_config = ConfigDict(frozen=True, extra="forbid")
    document: str
    """Where the campaign is described."""
    stamp: str = ""
    """Date and commit of the campaign."""
    level: str = ""
    """What was simulated: `measurements`, or `pixels` with the front ends."""
    scenarios: tuple[str, ...] = ()
    runs: int = Field(gt=0)
    coverage95: float = Field(ge=LEAST_COVERAGE, le=1)
    """Share of points whose 95 % region held the truth."""
    nees_per_dof: float = Field(gt=0)
    ranges: dict[str, tuple[float, float]]
    """Smallest and largest value that the campaign covered, by the names of `QUANTITIES`."""
    digest: str = ""
    """SHA-256 over everything else, see `seal`; checked when a file is read."""

    @model_validator(mode="after")
    def _known(self) -> Self:
        unknown = sorted(set(self.ranges) - set(QUANTITIES))
        if unknown:
            raise ValueError(f"unknown quantity {unknown[0]}; known: {', '.join(QUANTITIES)}")
        return self

    def outside(self, result: Result, point: PointEstimate) -> tuple[str, ...]:
        """One sentence for each quantity that lies outside."""
        values = quantities(result, point)
        return tuple(
            f"the {QUANTITIES[name]} ({values[name]:.4g}) lies outside the validated range {low:.4g} to {high:.4g}"
            for name, (low, high) in self.ranges.items()
            if not low <= values[name] <= high
        )


def seal(validated: ValidatedRange) -> ValidatedRange:
    """The range with its digest: SHA-256 of its other fields as JSON with sorted keys."""
    content = validated.model_dump(mode="json", exclude={"digest"})
    text = json.dumps(content, sort_keys=True, separators=(",", ":"))
    return validated.model_copy(update={"digest": hashlib.sha256(text.encode()).hexdigest()})


def range_text(validated: ValidatedRange) -> str:
    """The file's content, sealed."""
    return yaml.safe_dump(seal(validated).model_dump(mode="json"), sort_keys=False)


def quantities(result: Result, point: PointEstimate) -> dict[str, float]:
    """The values of `QUANTITIES` for one point."""
    first = result.trajectory[0].stamp_ns if result.trajectory else result.end_ns
    calibration = {state.name: state.value for state in result.calibration}
    return {
        "distance_m": float(np.linalg.norm(point.position_m)),
        "radius95_m": point.radius95_m,
        "measurements": float(point.measurements),
        "duration_s": (result.end_ns - first) * 1e-9,
        "focal_px": calibration.get("m_left.fx", math.nan),
        "baseline_m": _baseline_m(calibration),
    }


def _baseline_m(calibration: Mapping[str, float]) -> float:
    """Distance of the two mobile cameras; NaN, which lies in no range, where there is but one."""
    return math.hypot(*(calibration.get(f"m_left_T_m_right.{part}", math.nan) for part in ("tx", "ty", "tz")))


def load_validated_range(path: Path | None = None) -> ValidatedRange | None:
    """The range in a YAML file, or the one that came with the program; None where it came with none.

    Raises:
        SurecutError: the file cannot be read, is no validated range, or is not as the campaign wrote it.
    """
    source = resources.files("surecut.estimator") / FILE if path is None else path
    label = FILE if path is None else str(path)
    if path is None and not source.is_file():
        return None
    try:
        validated = ValidatedRange.model_validate(yaml.safe_load(source.read_bytes()))
    except OSError as error:
        raise SurecutError(f"{label}: cannot be read ({error.strerror}); give a file with --validation") from error
    except (yaml.YAMLError, UnicodeDecodeError, ValidationError) as error:
        reason = error.errors()[0]["msg"] if isinstance(error, ValidationError) else " ".join(str(error).split())
        raise SurecutError(f"{label}: is no validated range ({reason}); see docs/report.md for its keys") from error
    if validated.digest != seal(validated).digest:
        raise SurecutError(
            f"{label}: is not as the validation campaign wrote it (digest mismatch); write it again with "
            "`surecut campaign --range`"
        )
    return validated
