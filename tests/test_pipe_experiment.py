"""Pipes and cut points against the truth, with parts of the truth held in the graph."""

import numpy as np
import pytest

from surecut.estimator.bundle import bundles
from surecut.estimator.engine import Engine
from surecut.estimator.surfaces import lay_on_surfaces
from surecut.factors.errors import SurecutError
from surecut.simulation.held import HOLDS
from surecut.simulation.measurement_level import draw
from surecut.simulation.measurement_level_scenario import Scenario
from surecut.simulation.pipe_experiment import AS_IT_IS, CutPoint, Examined, FoundPipe, examine_all, examined
from surecut.simulation.pipe_table import as_json, as_section, held_lines, of_json, pipe_lines, point_lines

SHORT = Scenario.model_validate({"motion": {"duration_s": 12.0}})


@pytest.fixture(scope="module")
def found():
    run = draw(SHORT, 5)
    engine = Engine(run.rig, run.cameras, lay_on_surfaces, False)
    for bundle in bundles(list(run.measurements)):
        engine.add(bundle)
    return examined("short", engine, run.truth, tuple(HOLDS)), engine


def test_every_part_of_the_truth_is_solved_for(found):
    one, engine = found
    assert [p.held for p in one.points if p.id == one.points[0].id] == [AS_IT_IS, *HOLDS]
    assert not any(record.family == "truth" for record in engine.solver.log.records)


def test_what_is_held_is_no_longer_unsure(found):
    points = {(p.held, p.id): p for p in found[0].points}
    for name in {p.id for p in found[0].points}:
        plain, clicks = points[AS_IT_IS, name], points["all of these", name]
        for hold in HOLDS:
            assert np.linalg.norm(points[hold, name].sigma_m) < 1.001 * np.linalg.norm(plain.sigma_m)
        # with the cylinder and all poses known only the place along the axis is left, which clicks tell
        assert max(clicks.sigma_m[1:]) < 1e-3 < clicks.sigma_m[0]
        assert np.linalg.norm(clicks.error_m[1:]) < 1e-3
        assert points["true mount", name].sigma_m[0] < 0.95 * plain.sigma_m[0]


def test_the_cylinder_is_compared(found):
    pipe = found[0].pipe
    assert pipe is not None
    assert pipe.seen_by == "stereo"
    assert pipe.axis_rad < np.deg2rad(1.0)
    assert abs(pipe.radius_error_m) < 4 * pipe.radius_sigma_m


def a_point(recording, seen_by, error_m, held=AS_IT_IS):
    return CutPoint(
        recording, seen_by, held, "P1", error_m, (2e-3, 2e-3, 2e-3), float(np.sum(np.square(error_m)) / 4e-6)
    )


def test_figures_of_known_errors():
    pipe = FoundPipe("a", "stereo", np.deg2rad(0.5), -2e-3, 1e-3, 12, None)
    seen = FoundPipe("b", "both", np.deg2rad(0.1), 4e-3, 2e-3, 8, 1.5)
    one = Examined("a", (a_point("a", "stereo", (3e-3, 0.0, 4e-3)),), pipe)
    two = Examined("b", (a_point("b", "both", (0.0, 2e-3, 0.0)), a_point("b", "both", (0, 0, 0), [*HOLDS][-1])), seen)
    lines = {line[0]: line for line in point_lines([one, two])}
    assert lines["all"][1:5:3] == ("2", "5.0")
    assert lines["only stereo sees the pipe"][2] == "5.0"
    assert lines["only stereo sees the pipe"][7] == f"{25 / 4 / 3:.2f}"
    assert lines["both cameras see it"][5:7] == ("0.0 / 2.0 / 0.0", "2.0 / 2.0 / 2.0")
    pipes = {line[0]: line for line in pipe_lines([one, two])}
    assert pipes["all"][2:6] == ("0.30 / 0.50", "+1.0", "+4.0", "1 of 2")
    assert pipes["both cameras see it"][-1] == "1.5 sigma at most"
    assert [line[:3] for line in held_lines([one, two])] == [(AS_IT_IS, "1", "2.0"), ("all of these", "1", "0.0")]
    page = as_section([one, two, Examined("c", (), None, "no pipe")], "Title")
    assert page.startswith("## Title\n")
    assert "c: no pipe" in page
    assert of_json(as_json([one, two])) == (one, two)


def test_an_empty_folder_is_refused(tmp_path):
    with pytest.raises(SurecutError, match="no recordings"):
        examine_all(tmp_path)
