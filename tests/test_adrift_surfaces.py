"""A camera whose place hangs on a motion prior is not tied to surfaces that lie where it only seems to look."""

from dataclasses import replace

import numpy as np

from surecut.estimator.bundle import bundles
from surecut.estimator.engine import Engine
from surecut.estimator.surfaces import FAMILY, lay_on_surfaces
from surecut.factors.measurements import MarkerSighting, StereoFrame
from surecut.simulation.measurement_level import draw
from surecut.simulation.measurement_level_scenario import Scenario

OPEN = Scenario.model_validate(
    {
        "panel": False,
        "motion": {"duration_s": 14.0, "board_share": 0.4},
        "picks": {"outlines": False},
        "clouds": {"points": 20000},
    }
)
NEW = 10**6
"""Added to the ids of all tracks after the gap."""


def after(gap: bool) -> tuple[int, bool]:
    """The run with or without a gap at two thirds: landmarks on surfaces that are new since; is the camera adrift?"""
    run = draw(OPEN, 3)
    frames = [m for m in run.measurements if isinstance(m, StereoFrame)]
    start_ns = frames[2 * len(frames) // 3].stamp_ns
    aside = np.eye(4)
    aside[0, 3] = 0.6
    measurements = []
    for one in run.measurements:
        if gap and one.stamp_ns >= start_ns:
            if isinstance(one, MarkerSighting):
                continue
            if isinstance(one, StereoFrame):
                one = replace(one, track_ids=one.track_ids + NEW)
                if one.stamp_ns == start_ns:
                    one = replace(one, lost=True, motion_inliers=0, last_T_this=one.last_T_this @ aside)
        measurements.append(one)
    engine = Engine(run.rig, run.cameras, lay_on_surfaces, advises=False)
    for bundle in bundles(measurements):
        engine.add(bundle)
    laid = [int(r.what.split()[1]) for _, _, r in engine.solver.log.active() if r.family == FAMILY]
    assert laid
    return sum(track >= NEW for track in laid), bool(engine.adrift)


def test_no_surfaces_for_what_is_seen_after_a_gap():
    """The camera is put down 0.6 m beside where it is, and its new landmarks with it."""
    laid, adrift = after(gap=True)
    assert adrift
    assert laid == 0


def test_a_camera_that_landmarks_hold_is_not_adrift():
    assert after(gap=False) == (0, False)
