"""What an input error moves, and what a family is worth: closed forms on a short run without the Kinect's depth."""

import numpy as np
import pytest

from surecut.simulation.campaign_estimate import estimate_run
from surecut.simulation.evaluate_leave_out import estimate_without, leave_out_names, without
from surecut.simulation.evaluate_sensitivity import input_errors, sensitivities
from surecut.simulation.measurement_level import draw
from surecut.simulation.measurement_level_scenario import Scenario

SHORT = Scenario.model_validate(
    {
        "motion": {"duration_s": 16.0},
        "tracks": {"per_frame": 50},
        "clouds": {"frames": 0},
        "picks": {"roles": ["cut"]},
    }
)


@pytest.fixture(scope="module")
def run():
    return draw(SHORT, 0)


def test_the_mount_moves_the_point_by_as_much_and_clicks_by_their_share(run):
    """The mount alone ties the machine to the board: its error goes into {b} whole."""
    names = ("mount shifted along x", "clicks along u")
    chosen = tuple(error for error in input_errors() if error.name in names)
    shift, clicks = sensitivities(run, chosen)
    assert (shift.input, shift.unit, shift.step) == ("mount shifted along x", "mm", 1.0)
    # The mount's own pose moves by 1 mm in {f}; turns of the mount do not follow, so the point moves by 1 mm.
    assert np.linalg.norm(shift.moved_b_m) == pytest.approx(1e-3, rel=0.02)
    # All clicks by one pixel: at most its size at the pipe, and less where the outline holds the point.
    assert 0.0 < np.linalg.norm(clicks.moved_b_m) < 1.5 / 270.0


def test_less_is_never_better(run):
    whole = estimate_run(run).points[0].radius95_m
    for name in ("odometry tracks", "known distances"):
        assert estimate_without(run, name).points[0].radius95_m > 0.99 * whole, name


def test_families_are_left_out_and_nothing_else(run):
    for name in leave_out_names():
        rest = without(run, name)
        if name == "known distances":
            assert run.rig.distances
            assert not rest.rig.distances
            assert rest.measurements is run.measurements
        elif name != "Kinect cloud":
            kept = {id(m) for m in rest.measurements} & {id(m) for m in run.measurements}
            assert 0 < len(kept) < len(run.measurements), name
