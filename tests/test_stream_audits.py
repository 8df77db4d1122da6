"""Tests of the model from time to time: when they fail for long, the model is no longer called consistent."""

from types import SimpleNamespace
from typing import Any, cast

import pytest

from surecut.estimator.engine import Engine
from surecut.estimator.result import Consistency
from surecut.estimator.stream import audits as module
from surecut.estimator.stream.audit import Audit
from surecut.estimator.stream.audits import SOONER, Audits
from surecut.factors.errors import ObservabilityError

PERIOD = 20 * 10**9
PASSED = Audit(Consistency(1.0, 1.0, (), {}, True, ()), {"P1": 1.5})


class Model(SimpleNamespace):
    """What the audits look at."""

    def __init__(self) -> None:
        super().__init__(
            end_ns=0,
            odometry=SimpleNamespace(last_keyframe=3),
            graph=SimpleNamespace(unsolved=False),
            boards=SimpleNamespace(any_known=lambda: False),
        )


@pytest.fixture
def model():
    return Model()


def outcomes(monkeypatch: pytest.MonkeyPatch, *each: Audit | Exception) -> None:
    coming = iter(each)

    def next_one(_: Any) -> Audit:
        found = next(coming)
        if isinstance(found, Exception):
            raise found
        return found

    monkeypatch.setattr(module, "audit", next_one)


def at(audits: Audits, model: Model, stamp_ns: int) -> bool:
    model.end_ns = stamp_ns
    audits.begin_when_due(stamp_ns)
    return audits.take()


def test_the_last_outcome_holds_until_the_next_is_due(model: Model, monkeypatch: pytest.MonkeyPatch):
    outcomes(monkeypatch, PASSED)
    audits = Audits(cast(Engine, model), PERIOD, apart=False)
    assert audits.widening("P1") == 1.0
    assert at(audits, model, PERIOD)
    assert not at(audits, model, PERIOD + PERIOD // SOONER - 1)  # a second audit would have no outcome
    assert (audits.widening("P1"), audits.widening("P2")) == (1.5, 1.0)
    assert audits.consistency() is PASSED.consistency


def test_the_first_ones_come_soon(model: Model, monkeypatch: pytest.MonkeyPatch):
    outcomes(monkeypatch, *[PASSED] * 20)
    audits = Audits(cast(Engine, model), PERIOD, apart=False)
    quarters = [q for q in range(1, 20) if at(audits, model, q * PERIOD // SOONER)]
    assert quarters == [1, 2, 3, 5, 9, 13, 17]


def test_audits_that_fail_for_long_are_told(model: Model, monkeypatch: pytest.MonkeyPatch):
    outcomes(monkeypatch, PASSED, *[ObservabilityError("l7 is not observable")] * 5, PASSED)
    audits = Audits(cast(Engine, model), PERIOD, apart=False)
    said = []
    for number in range(1, 8):
        assert at(audits, model, number * PERIOD)
        said.append(audits.consistency().passed)
    assert said == [True, True, True, True, False, False, True]
    assert audits.failed == 5


def test_the_reason_names_the_time_and_the_cause(model: Model, monkeypatch: pytest.MonkeyPatch):
    outcomes(monkeypatch, *[ObservabilityError("l7 is not observable")] * 4)
    audits = Audits(cast(Engine, model), PERIOD, apart=False)
    for number in range(1, 5):
        at(audits, model, number * PERIOD)
    assert audits.consistency().reasons == (
        "the model could not be tested against its own data for 60 s: l7 is not observable",
    )


def test_nothing_is_begun_before_there_is_a_solution(model: Model, monkeypatch: pytest.MonkeyPatch):
    outcomes(monkeypatch)
    model.graph.unsolved = True
    assert not at(Audits(cast(Engine, model), PERIOD, apart=False), model, PERIOD)
