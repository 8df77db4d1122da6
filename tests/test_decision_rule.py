"""GO, NO-GO or MEASURE MORE: each rule by hand-made results."""

import dataclasses

import numpy as np
import pytest
from report_results import AXIS, SECOND, make_consistency, make_point, make_pose, make_result, make_rig
from scipy.special import ndtr, ndtri
from scipy.stats import chi

from surecut.estimator import validated_range
from surecut.estimator.decision import along_room_m, decide, decide_cut, percent, tolerance_probability
from surecut.estimator.result import NearestSurface, PipeEstimate
from surecut.estimator.validated_range import QUANTITIES, ValidatedRange, load_validated_range, range_text
from surecut.factors.errors import SurecutError
from surecut.factors.measurements import Event
from surecut.factors.rig import Box, Cut

VALIDATED = ValidatedRange(
    document="docs/validation.md", runs=300, coverage95=0.95, nees_per_dof=1.0, ranges={"distance_m": (0.5, 4.0)}
)


def cut_of(**changes):
    values = {"point": "P1", "tolerance_along_m": 0.02, "tolerance_across_m": 0.02, "tool_sigma_m": 0.001, **changes}
    return Cut(**values)


def round_point(sigma_m, **changes):
    return dataclasses.replace(
        make_point(), covariance_m2=np.eye(3) * sigma_m**2, budget={"all": np.eye(3) * sigma_m**2}, **changes
    )


def decision(cut=None, point=None, validated=VALIDATED, **changes):
    point = round_point(0.002) if point is None else point
    result = make_result(points=(point,), rig=make_rig((cut or cut_of(),)), pipes=(), **changes)
    return decide_cut(cut or cut_of(), point, result, validated)


def test_closed_form_and_go():
    cut = cut_of(tolerance_along_m=0.006, tolerance_across_m=0.007, blade_width_m=0.002)
    made = decision(cut)
    sigma = np.hypot(0.002, 0.001)
    expected = (2 * ndtr(0.005 / sigma) - 1) * (1 - np.exp(-0.5 * (0.007 / sigma) ** 2))
    assert made.probability == pytest.approx(expected, abs=1e-9)
    assert made.verdict == "GO"
    assert percent(expected) in made.headline


def test_without_an_axis_the_inscribed_ball_counts():
    cut = cut_of(tolerance_along_m=0.006, tolerance_across_m=0.009)
    made = decision(cut, round_point(0.002, axis=None, pipe_id=None))
    assert made.probability == pytest.approx(chi.cdf(0.006 / np.hypot(0.002, 0.001), 3), abs=1e-9)
    assert any("No axis" in note for note in made.notes)


def test_the_margin_is_the_factor_that_turns_the_verdict():
    for sigma in (0.002, 0.006):
        made = decision(cut_of(), round_point(sigma))
        assert (made.margin > 1) == (made.verdict == "GO")
        at_limit = decision(cut_of(), round_point(sigma * made.margin))
        assert at_limit.probability == pytest.approx(made.required, abs=1e-4)
    assert decision(cut_of(), round_point(0.002)).margin * 2 == pytest.approx(
        decision(cut_of(), round_point(0.004)).margin * 4, rel=1e-3
    )


def test_measure_more_names_what_fails():
    made = decision(cut_of(), round_point(0.012))
    assert made.verdict == "MEASURE MORE"
    assert "What fails first is the tolerance" in made.headline
    assert made.probability < made.required


def test_no_go_when_the_tool_alone_is_too_coarse():
    made = decision(cut_of(tool_sigma_m=0.02))
    assert made.verdict == "NO-GO"
    assert "No measurement mends that" in made.headline
    assert decision(cut_of(blade_width_m=0.05)).verdict == "NO-GO"


def test_one_sided_clearance_in_closed_form():
    # A wall 60 mm to the right of the point; blade of 4 mm, no pipe radius known: the disc is the point and 2 mm.
    point = round_point(0.003, axis=np.array([1.0, 0.0, 0.0]), pipe_id=None)
    x, y, z = point.position_m
    wall = Box(minimum_m=(x + 0.06, y - 1, z - 1), maximum_m=(x + 1, y + 1, z + 1))
    cut = cut_of(blade_width_m=0.004, clearance_m=0.05, keep_out=(wall,))
    made = decision(cut, point)
    row = made.requirements[1]
    assert row.name == "clearance to keep-out box 1"
    assert row.probability == pytest.approx(ndtr(0.008 / np.hypot(0.003, 0.001)), abs=1e-9)
    assert row.possible == pytest.approx(ndtr((0.008 - ndtri(0.95) * 0.001) / 0.003), abs=1e-9)
    total = made.requirements[0].probability + row.probability - 1
    assert made.probability == pytest.approx(total, abs=1e-12)


def test_no_go_inside_a_keep_out_box_and_measure_more_at_its_edge():
    point = round_point(0.003, pipe_id=None)
    x, y, z = point.position_m
    inside = Box(minimum_m=(x - 0.1, y - 0.1, z - 0.1), maximum_m=(x + 0.1, y + 0.1, z + 0.1))
    made = decision(cut_of(keep_out=(inside,)), point)
    assert made.verdict == "NO-GO"
    assert "inside" in made.headline
    edge = Box(minimum_m=(x + 0.002, y - 0.1, z - 0.1), maximum_m=(x + 0.1, y + 0.1, z + 0.1))
    assert decision(cut_of(keep_out=(edge,)), point).verdict == "MEASURE MORE"


def test_clearance_to_another_pipe_adds_its_own_uncertainty():
    point = round_point(0.003, axis=np.array([0.0, 1.0, 0.0]), pipe_id="pipe0")
    own = PipeEstimate("pipe0", "b", point.position_m, point.axis, 0.03, np.eye(7) * 1e-6)
    beside = point.position_m + np.array([0.1, 0.0, 0.0])
    other = PipeEstimate("pipe1", "b", beside, np.array([0.0, 1.0, 0.0]), 0.04, np.diag([4e-6] * 3 + [0] * 3 + [1e-6]))
    result = make_result(points=(point,), pipes=(own, other))
    made = decide_cut(cut_of(clearance_m=0.02), point, result, VALIDATED)
    row = made.requirements[1]
    # 100 mm between the axes less 30 and 40 mm of radius less 20 mm of clearance; 3 + 2 + 1 mm of deviation.
    assert row.probability == pytest.approx(ndtr(0.01 / np.hypot(0.006, 0.001)), abs=1e-6)
    assert len(made.requirements) == 2


def test_nearest_surface_and_a_clearance_that_nothing_can_check():
    point = round_point(0.003, axis=np.array([0.0, 1.0, 0.0]), pipe_id=None)
    surface = NearestSurface("wall", 0.05, 0.004, np.array([0.0, 0.0, 1.0]))
    made = decision(cut_of(clearance_m=0.04), dataclasses.replace(point, nearest_surface=surface))
    assert made.requirements[1].probability == pytest.approx(ndtr(0.01 / np.hypot(0.004, 0.001)), abs=1e-9)
    unknown = decision(cut_of(clearance_m=0.04), point)
    assert unknown.verdict == "MEASURE MORE"
    assert "neither a keep-out box nor a mapped surface" in unknown.headline


NAN = np.full((3, 3), np.nan)
FLAT = np.diag([1e-6, 1e-6, 0.0])
LOPSIDED = np.array([[1e-6, 5e-7, 0], [0, 1e-6, 0], [0, 0, 1e-6]])
ERROR = Event(0, "marker_swapped", "Marker 31 is not where the rig says.", "error")


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"consistency": make_consistency(False)}, "contradict the model"),
        ({"last_board_age_s": 121.0}, "last seen 121 s before the end"),
        ({"last_board_age_s": None}, "no board was seen"),
        ({"validated": None}, "has not been validated"),
        ({"validated": VALIDATED.model_copy(update={"ranges": {"distance_m": (0.5, 1.0)}})}, "outside the validated"),
        ({"point": round_point(0.002, position_m=np.array([0, np.inf, 1.0]))}, "not finite"),
        ({"point": dataclasses.replace(round_point(0.002), covariance_m2=NAN)}, "not finite"),
        ({"point": dataclasses.replace(round_point(0.002), covariance_m2=FLAT)}, "singular"),
        ({"point": dataclasses.replace(round_point(0.002), covariance_m2=-FLAT)}, "singular"),
        ({"point": dataclasses.replace(round_point(0.002), covariance_m2=np.zeros((3, 3)))}, "singular"),
        ({"point": dataclasses.replace(round_point(0.002), covariance_m2=LOPSIDED)}, "not symmetric"),
        ({"point": round_point(0.002, axis=np.zeros(3))}, "is no direction"),
        ({"events": (ERROR,)}, "Marker 31 is not where the rig says"),
    ],
)
def test_never_go(changes, words):
    assert decision().verdict == "GO"
    made = decision(**changes)
    assert made.verdict == "MEASURE MORE"
    assert any(words in blocker for blocker in made.blockers)
    assert made.blockers[0] in made.headline


def test_the_machine_has_moved_on():
    poses = tuple(make_pose(name, "o", (0, 0, 0), 0) for name in ("b0", "b9", "b10", "f0"))
    assert decision(point=round_point(0.002, frame="b10"), poses=poses).verdict == "GO"
    made = decision(point=round_point(0.002, frame="b9"), poses=poses)
    assert made.verdict == "MEASURE MORE"
    assert "it now stands at b10" in made.headline


def test_no_pick_and_no_plan():
    result = make_result(points=())
    (made,) = decide(result, make_rig(), VALIDATED)
    assert made.verdict == "MEASURE MORE"
    assert "no pick of P1" in made.headline
    assert decide(result, make_rig(()), VALIDATED) == ()


def test_trust_expires_when_the_plan_says():
    made = decision(cut_of(board_age_limit_s=3600.0), last_board_age_s=3599.0)
    assert made.verdict == "GO"
    assert made.expires_ns == make_result().end_ns + SECOND


def test_percent_never_flatters():
    assert percent(0.94999) == "94.9 %"
    assert percent(0.95) == "95.0 %"
    assert percent(0.9999999) == "above 99.99 %"
    assert percent(0.98999) == "98.9 %"
    assert percent(0.99) == "99.0 %"
    assert percent(0.995) == "99.50 %"
    assert percent(1e-9) == "below 0.01 %"
    assert percent(0.005) == "0.50 %"


def estimate_by_measuring(rng):
    """A point from a random set of measurements: covariance and error of the weighted mean."""
    rows = rng.normal(size=(rng.integers(4, 12), 3))
    sigmas = np.exp(rng.normal(-5.5, 0.6, len(rows)))
    information = (rows / sigmas[:, None] ** 2).T @ rows
    covariance = np.linalg.inv(information)
    error = -covariance @ (rows / sigmas[:, None] ** 2).T @ (sigmas * rng.normal(size=len(rows)))
    return covariance, error


@pytest.mark.parametrize("allowed", [0.05, 0.01])
def test_wrong_go_rate_and_power(allowed):
    """2,000 measured points, random tolerances; noise scale known from 200 residuals, as a real run knows it."""
    rng = np.random.default_rng(int(1000 * allowed))
    runs = 2000
    go = wrong = ideal = 0
    for _ in range(runs):
        covariance, error = estimate_by_measuring(rng)
        cut = cut_of(
            tolerance_along_m=rng.uniform(0.003, 0.03),
            tolerance_across_m=rng.uniform(0.003, 0.03),
            tool_sigma_m=rng.uniform(0.0, 0.003),
            wrong_go_probability=allowed,
        )
        stated = covariance * rng.chisquare(200) / 200
        permitted = tolerance_probability(cut, stated, AXIS) >= 1 - allowed
        ideal += tolerance_probability(cut, covariance, AXIS) >= 1 - allowed
        total = error + cut.tool_sigma_m * rng.normal(size=3)
        along = total @ AXIS
        outside = abs(along) > along_room_m(cut) or np.linalg.norm(total - along * AXIS) > cut.tolerance_across_m
        go += permitted
        wrong += permitted and outside
    assert 0.3 * runs < go < 0.98 * runs
    assert wrong <= allowed * go
    assert abs(go - ideal) <= 0.05 * runs


def test_whole_rule_against_sampled_ideal():
    """200 runs of the whole decision against the share of 40,000 sampled cuts; they may differ only at the limit."""
    rng = np.random.default_rng(8)
    normal = rng.normal(size=(40_000, 3))
    verdicts = {"GO": 0, "MEASURE MORE": 0, "NO-GO": 0}
    for _ in range(200):
        covariance, _ = estimate_by_measuring(rng)
        cut = cut_of(tolerance_along_m=rng.uniform(0.003, 0.03), tolerance_across_m=rng.uniform(0.003, 0.03))
        point = dataclasses.replace(make_point(), covariance_m2=covariance)
        made = decision(cut, point)
        verdicts[made.verdict] += 1
        error = normal @ np.linalg.cholesky(covariance + np.eye(3) * cut.tool_sigma_m**2).T
        along = error @ AXIS
        kept = np.mean(
            (np.abs(along) <= cut.tolerance_along_m) & ((error**2).sum(1) - along**2 <= cut.tolerance_across_m**2)
        )
        if abs(kept - 0.95) > 0.005:
            assert (made.verdict == "GO") == (kept > 0.95)
    assert min(verdicts["GO"], verdicts["MEASURE MORE"]) > 20


def test_validated_range_file(tmp_path):
    file = tmp_path / "range.yaml"
    sealed = range_text(VALIDATED)
    file.write_text(sealed)
    assert load_validated_range(file).ranges == {"distance_m": (0.5, 4.0)}
    tampered = (
        sealed.replace("- 4.0", "- 40.0"),
        sealed.replace("runs: 300", "runs: 3000"),
        sealed[: sealed.index("digest")],
    )
    for text in tampered:
        file.write_text(text)
        with pytest.raises(SurecutError, match="digest mismatch") as caught:
            load_validated_range(file)
        assert "\n" not in str(caught.value)
    refuted = range_text(VALIDATED.model_copy(update={"coverage95": 0.8}))
    unknown = "document: d\nruns: 3\ncoverage95: 1\nnees_per_dof: 1\nranges: {colour: [1, 2]}"
    for text in ("{", "runs: 3", unknown, refuted):
        file.write_text(text)
        with pytest.raises(SurecutError, match="is no validated range") as caught:
            load_validated_range(file)
        assert "\n" not in str(caught.value)
    with pytest.raises(SurecutError, match="cannot be read"):
        load_validated_range(tmp_path / "none.yaml")


def test_the_range_that_comes_along_is_as_its_campaign_wrote_it():
    validated = load_validated_range()
    assert validated is not None
    assert validated.runs >= 100
    assert 0.935 <= validated.coverage95 <= 0.97
    assert set(validated.ranges) == set(QUANTITIES)


def test_without_the_range_that_comes_along_there_is_no_go(tmp_path, monkeypatch):
    monkeypatch.setattr(validated_range.resources, "files", lambda package: tmp_path)
    assert load_validated_range() is None
    assert decision(validated=load_validated_range()).verdict == "MEASURE MORE"
