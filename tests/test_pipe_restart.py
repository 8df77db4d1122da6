"""A pipe that began in the wrong place begins anew where clicks from several places put it."""

import gtsam
import numpy as np
import pytest

from surecut.estimator.bundle import bundles
from surecut.estimator.engine import Engine
from surecut.estimator.pipe_restart import begin_anew, clicked_places
from surecut.estimator.pipes import OUTLINE
from surecut.estimator.surfaces import lay_on_surfaces
from surecut.factors import keys
from surecut.simulation.measurement_level import draw
from surecut.simulation.measurement_level_scenario import Scenario

AXIS = {keys.axis_start(0), keys.axis_end(0), keys.radius(0), keys.inset(0)}
WHOLE = Scenario.model_validate({"motion": {"duration_s": 30.0}})


@pytest.fixture
def engine():
    run = draw(WHOLE, 5)
    engine = Engine(run.rig, run.cameras, lay_on_surfaces, False)
    for bundle in bundles(list(run.measurements)):
        engine.add(bundle)
    engine.revisit()
    engine.flush()
    return engine


def moved(engine, offset):
    """The axis elsewhere, as where it began from a depth of something behind the pipe."""
    for key in (keys.axis_start(0), keys.axis_end(0)):
        for values in (engine.state.values, engine.solver.values()):
            if values.exists(key):
                values.update(key, engine.state.point(key) + offset)


def test_a_pipe_where_its_clicks_are_stays(engine):
    assert clicked_places(engine, "pipe0") == {}
    assert clicked_places(engine, "pipe9") == {}


def test_clicks_find_a_pipe_that_is_elsewhere(engine):
    known = {point.index: engine.state.point(keys.point(point.index)) for point in engine.pipes.points.values()}
    before = engine.pipes.axis("pipe0")
    sigma_m = 0.02  # of three clicks of a pixel each
    across = np.cross(before[1] - before[0], [0.3, 0.2, 1.0])
    moved(engine, 0.5 * across / np.linalg.norm(across))
    places = clicked_places(engine, "pipe0")
    assert places.keys() == known.keys()
    for index, place in places.items():
        np.testing.assert_allclose(place, known[index], atol=4 * sigma_m)

    outlines = [seen for _, seen in engine.pipes.outlined_of("pipe0")]
    assert outlines
    begin_anew(engine, "pipe0", places)
    assert engine.pipes.axis("pipe0") is None
    assert not engine.pipes.outlined
    assert not any(AXIS & set(factor.keys()) for _, factor, _ in engine.solver.log.active())
    assert not any(engine.state.has(key) for key in AXIS)
    assert [event.kind for event in engine.events].count("pipe_begun_anew") == 1
    told = [r for r in engine.rejected if r.family == OUTLINE and "passes the clicks" in r.reason]
    assert [r.stamp_ns for r in told] == [seen.stamp_ns for seen in outlines]
    assert all(r.value > r.limit for r in told)

    for seen in outlines:
        engine.add_outline(seen)
    engine.flush()
    engine.state.values = engine.solver.settle()
    after = engine.pipes.axis("pipe0")
    assert after is not None
    direction = (before[1] - before[0]) / np.linalg.norm(before[1] - before[0])
    for end in after[:2]:
        assert np.linalg.norm(np.cross(end - before[0], direction)) < 2e-3
    assert after[2] == pytest.approx(before[2], abs=1e-3)
    assert clicked_places(engine, "pipe0") == {}
    families = [record.family for _, _, record in engine.solver.log.active()]
    assert families.count(OUTLINE) == 2 * len(outlines)


def test_clicks_that_do_not_agree_tell_nothing(engine):
    where, pick = next((w, p) for w, p in engine.pipes.clicked if p.point_id == "P1")
    engine.pipes.clicked.append((where, type(pick)(*[getattr(pick, name) for name in pick.__slots__])))
    last = engine.pipes.clicked[-1][1]
    object.__setattr__(last, "px", pick.px + 60.0)
    moved(engine, np.array([0.0, 0.0, 0.5]))
    assert keys.point(engine.pipes.points["P1"].index) not in clicked_places(engine, "pipe0")


def test_what_the_kinect_or_earlier_keyframes_know_is_not_given_up(engine):
    from surecut.estimator.depth_pipes import FAMILY as CYLINDER
    from surecut.estimator.graph import Record, Update

    update = Update()
    prior = gtsam.PriorFactorVector(keys.radius(0), np.array([0.04]), gtsam.noiseModel.Isotropic.Sigma(1, 0.1))
    update.add(prior, Record(CYLINDER, "Kinect's cloud of pipe0", 0, "pipe0"))
    engine.graph.take(update)
    engine.flush()
    moved(engine, np.array([0.0, 0.0, 0.5]))
    assert clicked_places(engine, "pipe0") == {}
