"""A stereo pair that is 2 % and 0.3 px off its calibration costs the pipe points little; see `-m campaign`."""

import numpy as np
import pytest

from surecut.simulation.campaign import open_campaign
from surecut.simulation.campaign_run import run_measurements
from surecut.simulation.measurement_level import draw
from surecut.simulation.measurement_level_scenario import Scenario

SEEDS = range(12)
PAIR = ("m_left_T_m_right.tx", "m_left_T_m_right.ry")
"""Baseline and vergence."""


def scenario(name):
    return Scenario.model_validate(open_campaign(name, "measurements").scenarios[0])


def test_the_pair_alone_differs():
    off, true = (draw(scenario(name), 4) for name in ("rig-off", "rig-true"))
    nominal = true.truth.rig.m_left_T_m_right
    assert nominal[:3, :3] == pytest.approx(np.eye(3))
    assert off.truth.rig.m_left_T_m_right[0, 3] == pytest.approx(1.02 * nominal[0, 3])
    assert off.truth.rig.m_left_T_m_right[0, 2] * true.truth.rig.cameras["m_left"].K[0, 0] == pytest.approx(
        0.3, rel=1e-3
    )
    assert off.truth.rig.depth_scale == true.truth.rig.depth_scale
    assert (off.truth.rig.f_T_b == true.truth.rig.f_T_b).all()
    assert (off.truth.o_T_b == true.truth.o_T_b).all()
    assert off.rig == true.rig


@pytest.mark.campaign
def test_points_are_within_1_2_times_those_of_a_perfect_pair_and_the_pair_is_found():
    errors, inside = {}, []
    for name in ("rig-off", "rig-true"):
        rows = [run_measurements(seed, scenario(name)) for seed in SEEDS]
        found = [quantity for row in rows for quantity in row["quantities"]]
        errors[name] = [q["error"] for q in found if q["group"] == "point"]
        if name == "rig-off":
            inside = [q["probability"] < 0.95 for q in found if q["name"] in PAIR]
    assert np.mean(errors["rig-off"]) < 1.2 * np.mean(errors["rig-true"])
    # 24 intervals: fewer than 20 by chance in one of 200 cases.
    assert len(inside) == 2 * len(SEEDS)
    assert sum(inside) >= 20
