"""A width that texture shows, in a run: its factor, and outlines that were found without it."""

import numpy as np
import pytest

from surecut.estimator.bundle import bundles
from surecut.estimator.engine import Engine
from surecut.estimator.outline_search import unmeasured_sigma
from surecut.estimator.pipe_widths import PipeWidths
from surecut.estimator.pipes import OUTLINE, WIDTH
from surecut.estimator.surfaces import lay_on_surfaces
from surecut.factors import keys
from surecut.frontends.pipe.texture_width import TextureWidth
from surecut.simulation.measurement_level import draw
from surecut.simulation.measurement_level_scenario import Scenario

SHORT = Scenario.model_validate({"motion": {"duration_s": 8.0}})


@pytest.fixture(scope="module")
def engine():
    run = draw(SHORT, 5)
    engine = Engine(run.rig, run.cameras, lay_on_surfaces, False)
    for bundle in bundles(list(run.measurements)):
        engine.add(bundle)
    engine.flush()
    return engine


def active(engine, family):
    return [record for _, _, record in engine.solver.log.active() if record.family == family]


def test_a_width_enters_once_and_outlines_without_it_leave(engine):
    radius = engine.pipes.axis("pipe0")[2]
    widths = PipeWidths(engine)
    widths.enter("pipe0")
    assert active(engine, WIDTH) == []
    assert engine.pipes.outlined_of("pipe0")

    widths._found["pipe0"] = TextureWidth(radius + 9e-3, 1e-3, np.zeros(3), 12)
    stamps = {seen.stamp_ns for _, seen in engine.pipes.outlined_of("pipe0")}
    kept = min(stamps)
    widths.forget_outlines("pipe0", stamps - {kept})
    assert {seen.stamp_ns for _, seen in engine.pipes.outlined} == {kept}
    assert {record.stamp_ns for record in active(engine, OUTLINE)} == {kept}
    assert engine.pipes.cylinders["pipe0"].outlines == len(engine.pipes.outlined)
    event = next(event for event in engine.events if event.kind == "edges_within_pipe")
    assert "9 mm within its outline" in event.text
    assert event.values["sigma"] == pytest.approx(9.0, rel=0.05)
    assert {r.stamp_ns for r in engine.rejected if r.family == OUTLINE} >= stamps - {kept}

    widths.enter("pipe0")
    widths.enter("pipe0")  # the same one again
    assert len(active(engine, WIDTH)) == 1
    widths._found["pipe0"] = TextureWidth(radius + 8e-3, 1e-4, np.zeros(3), 20)
    widths.enter("pipe0")
    assert len(active(engine, WIDTH)) == 1
    assert engine.state.vector(keys.radius(0))[0] > radius + 5e-3  # what the one outline that is left does not stop


def test_the_part_of_a_pipe_about_its_picks(engine):
    start, end = engine.pipes.known_part("pipe0")
    span = np.ptp([place @ (end - start) / np.linalg.norm(end - start) for place in engine.pipes.places("pipe0")])
    assert np.linalg.norm(end - start) == pytest.approx(span + 0.2, abs=1e-6)
    assert engine.pipes.known_part("another") is None


def test_a_radius_that_only_edges_show_is_a_pixel_unsure():
    assert unmeasured_sigma(0.0, 1.0, 250.0) == pytest.approx(4e-3)
    assert unmeasured_sigma(0.04, 0.0, 250.0) == pytest.approx(2e-3)
