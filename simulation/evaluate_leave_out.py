"""What each family of measurements is worth: the estimate without it."""

from dataclasses import replace

from ..estimator.result import Result
from ..factors.measurements import CloudFrame, MarkerSighting, OutlineSighting, Pick, StereoFrame
from .campaign_estimate import estimate_run
from .measurement_level import Run

_KINDS: dict[str, tuple[type, ...]] = {
    "Kinect cloud": (CloudFrame,),
    "pipe outlines": (OutlineSighting,),
}


def leave_out_names() -> tuple[str, ...]:
    """The families, by the names under which they are reported."""
    return (*_KINDS, "known distances", "right markers", "odometry tracks", "later clicks")


def without(run: Run, name: str) -> Run:
    """The run without one family.

    `odometry tracks` keeps every second track only, as leaving all out cuts the graph in two; `later clicks` keeps
    the first place of the operator's clicks.
    """
    if name == "known distances":
        return replace(run, rig=run.rig.model_copy(update={"distances": ()}))
    if name == "right markers":
        kept = [m for m in run.measurements if not (isinstance(m, MarkerSighting) and m.camera == "m_right")]
    elif name == "odometry tracks":
        kept = [_half(m) if isinstance(m, StereoFrame) else m for m in run.measurements]
    elif name == "later clicks":
        first_ns = min(m.stamp_ns for m in run.measurements if isinstance(m, Pick))
        kept = [m for m in run.measurements if not isinstance(m, Pick | OutlineSighting) or m.stamp_ns == first_ns]
    else:
        kept = [m for m in run.measurements if not isinstance(m, _KINDS[name])]
    return replace(run, measurements=tuple(kept))


def estimate_without(run: Run, name: str) -> Result:
    """The estimate from what is left; raises SurecutError where that determines nothing."""
    return estimate_run(without(run, name))


def _half(frame: StereoFrame) -> StereoFrame:
    rows = frame.track_ids % 2 == 0
    return replace(
        frame,
        track_ids=frame.track_ids[rows],
        left_px=frame.left_px[rows],
        left_covariance_px2=frame.left_covariance_px2[rows],
        right_px=frame.right_px[rows],
        right_covariance_px2=frame.right_covariance_px2[rows],
    )
