"""What a report says and holds: structure, drawings, nothing from outside, the same bytes again."""

import dataclasses
import io
import json
import re
import xml.etree.ElementTree as ET
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from report_results import AXIS, SOURCES, START_NS, make_consistency, make_point, make_result, make_rig

from surecut.estimator.report.axes import K3, half_axes, triad
from surecut.estimator.report.blocks import Table
from surecut.estimator.report.compare import Run, build_comparison, mahalanobis2
from surecut.estimator.report.content import build_document
from surecut.estimator.report.essentials import budget_closure, budget_rows, family_shares
from surecut.estimator.report.glossary import TERMS
from surecut.estimator.report.html import render_html
from surecut.estimator.report.machine import render_json
from surecut.estimator.report.text import duration, fixed, mm, mm_with, significant, utc, with_sigma
from surecut.estimator.result import Advice, FamilyConsistency, PickView
from surecut.estimator.validated_range import ValidatedRange
from surecut.factors.rig import Cut

VALIDATED = ValidatedRange(
    document="docs/validation.md", runs=300, coverage95=0.951, nees_per_dof=1.02, ranges={"distance_m": (0.5, 4.0)}
)


def picture(width=360, height=240):
    rows = np.linspace(40, 200, height).astype(np.uint8)
    stream = io.BytesIO()
    Image.fromarray(np.tile(rows[:, None], (1, width))).save(stream, "PNG")
    return stream.getvalue()


def full_result(**changes):
    advice = (
        Advice("Look at the board again", "1.2 m from f0, turned by 25°, for 2 s", 0.0062, 0.28),
        Advice("Repeat the click", "P1 twice more in m_left", 0.0071, 0.17),
    )
    views = tuple(
        PickView(camera, START_NS, "P1", picture(), np.array([180.0, 110.0]), np.array([[30.0, 5.0], [5.0, 12.0]]))
        for camera in ("m_left", "b_rgb")
    )
    return make_result(**{"advice": {"P1": advice}, "pick_views": views, **changes})


def page(result=None, rig=None, validated=VALIDATED):
    result = full_result() if result is None else result
    return render_html(build_document(result, make_rig() if rig is None else rig, validated, "c" * 64))


class Outline(HTMLParser):
    """Headings, captions, verdicts, and every address that the page names."""

    def __init__(self):
        super().__init__()
        self.items = []
        self.addresses = []
        self.tags = []
        self._open = None

    def handle_starttag(self, tag, attributes):
        named = dict(attributes)
        self.tags.append(tag)
        self.addresses += [named[key] for key in ("href", "src", "action", "data", "xlink:href") if key in named]
        if tag == "section":
            self.items.append(("verdict", named["data-point"], named["data-verdict"]))
        self._open = tag if tag in ("h1", "h2", "caption") else None

    def handle_data(self, data):
        if self._open:
            self.items.append((self._open, data))
            self._open = None


def outline(html):
    parser = Outline()
    parser.feed(html)
    return parser


def test_structure():
    assert [item for item in outline(page()).items if item[0] != "caption"] == [
        ("h1", "Point P1 (cut)"),
        ("verdict", "P1", "GO"),
        ("h2", "Where"),
        ("h2", "What limits it"),
        ("h2", "What to do next"),
        ("h1", "Point G1 (grasp)"),
        ("verdict", "G1", "NO VERDICT"),
        ("h2", "Where"),
        ("h2", "What limits it"),
        ("h2", "What to do next"),
        ("h1", "Point P1 (cut): the numbers behind it"),
        ("h1", "Point G1 (grasp): the numbers behind it"),
        ("h1", "Can it be believed?"),
        ("h2", "Does the model agree with its own data?"),
        ("h2", "Do independent ways agree?"),
        ("h2", "Has the stated uncertainty been tested against truth?"),
        ("h2", "What happened on the way"),
        ("h2", "Distances"),
        ("h2", "Calibration against what was known before"),
        ("h2", "What was refused"),
        ("h2", "Live against offline"),
        ("h2", "Where it comes from"),
        ("h1", "Words"),
    ]


def test_the_glossary_in_the_documents_is_the_one_in_the_report():
    text = (Path(__file__).parent.parent / "docs" / "glossary.md").read_text(encoding="utf-8")
    rows = [line for line in text.splitlines() if line.startswith("| ")][1:]
    assert rows == [f"| {term} | {meaning} |" for term, meaning in TERMS]


def test_nothing_from_outside_and_no_script():
    html = page()
    parsed = outline(html)
    assert all(address.startswith("data:image/png;base64,") for address in parsed.addresses)
    assert len(parsed.addresses) == 2
    assert not {"script", "link", "iframe", "object", "embed", "form"} & set(parsed.tags)
    assert "url(" not in html
    assert "@import" not in html
    assert "default-src 'none'" in html
    assert set(re.findall(r"https?://[^\"<\s]*", html)) == {"http://www.w3.org/2000/svg"}


def test_every_drawing_is_well_formed_and_finite():
    drawings = re.findall(r"<svg .*?</svg>", page(), re.DOTALL)
    assert len(drawings) == 12
    for drawing in drawings:
        root = ET.fromstring(drawing)
        assert root.find("{http://www.w3.org/2000/svg}title").text
        assert "nan" not in drawing
        assert "inf" not in re.sub(r"base64,[^\"]*", "", drawing)


def test_same_result_same_bytes_whatever_the_run_time_and_order():
    result = full_result()
    other = dataclasses.replace(
        result,
        timing={"total_s": 99.0},
        rejected=tuple(reversed(result.rejected)),
        events=tuple(reversed(result.events)),
        provenance=dict(reversed(result.provenance.items())),
        points=tuple(dataclasses.replace(p, budget=dict(reversed(p.budget.items()))) for p in result.points),
    )
    assert page(other) == page(result)
    assert render_json(other, make_rig(), VALIDATED, "c") == render_json(result, make_rig(), VALIDATED, "c")


def test_budget_adds_up_in_the_table_as_printed_and_exactly_beneath():
    point = make_point()
    assert budget_closure(point) < 1e-9
    total = sum(np.trace(part) for _, part in budget_rows(point))
    assert total == pytest.approx(np.trace(point.covariance_m2), rel=1e-12)
    document = build_document(full_result(), make_rig(), VALIDATED, "c" * 64)
    table = next(b for b in document.blocks if isinstance(b, Table) and b.caption.startswith("Uncertainty budget"))
    rows = {row[0]: row[1:] for row in table.rows}
    assert set(SOURCES) < set(rows)
    for column in range(3):
        squares = sum(float(rows[name][column]) ** 2 for name in SOURCES)
        assert np.sqrt(squares) == pytest.approx(float(rows["combined standard uncertainty"][column]), abs=0.02)
    assert sum(float(rows[name][3].rstrip(" %")) for name in SOURCES) == pytest.approx(100.0, abs=0.3)


def test_a_budget_that_does_not_add_up_is_told():
    point = make_point()
    short = dataclasses.replace(point, budget=dict(list(point.budget.items())[1:]))
    assert "The budget does not add up" in page(make_result(points=(short,)))


def test_a_source_that_takes_variance_away_keeps_the_sum():
    point = make_point()
    budget = {**point.budget, "correlation": -0.1 * point.covariance_m2, "rest": 0.1 * point.covariance_m2}
    html = page(make_result(points=(dataclasses.replace(point, budget=budget),)))
    assert "less 0." in html
    assert "does not add up" not in html


def test_ellipsoid_of_a_known_covariance():
    upright = np.array([0.0, -1.0, 0.0])
    point = dataclasses.replace(
        make_point(axis=upright),
        position_m=np.array([0.0, 0.0, 2.0]),
        covariance_m2=np.diag([1e-6, 4e-6, 9e-6]),
    )
    directions = triad(point)
    assert directions.names == ("along", "across", "depth")
    assert directions.rows == pytest.approx(np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]]))
    longest, middle, shortest = half_axes(point, directions)
    assert K3 == pytest.approx(2.7955, abs=1e-4)
    assert longest.length_m == pytest.approx(0.003 * K3)
    assert longest.angles_deg == pytest.approx((90, 90, 0))
    assert middle.angles_deg == pytest.approx((0, 90, 90))
    assert shortest.angles_deg == pytest.approx((90, 0, 90))


@pytest.mark.parametrize("axis", [AXIS, -AXIS, np.array([1.0, 0, 0]), np.array([-0.8, 0.6, 0]), np.array([0, 0, 1.0])])
def test_directions_are_orthonormal_and_face_the_reader(axis):
    point = dataclasses.replace(make_point(axis=axis), position_m=np.array([0.0, 0.0, 2.0]))
    directions = triad(point)
    assert directions.rows @ directions.rows.T == pytest.approx(np.eye(3), abs=1e-12)
    assert abs(directions.rows[0] @ axis) == pytest.approx(1)
    assert directions.rows[0][1] <= 1e-12 or directions.rows[0][0] > 0


def test_lying_pipe_and_no_pipe_have_views_too():
    lying = dataclasses.replace(make_point(), axis=np.array([1.0, 0.0, 0.0]))
    assert "From above" in page(make_result(points=(lying,)))
    bare = make_point(axis=None)
    html = page(make_result(points=(bare,)))
    assert "No axis is known" in html
    assert "forward" in html


def test_no_cut_plan():
    html = page(rig=make_rig(()))
    assert "gives no permission to cut" in html
    assert {item[2] for item in outline(html).items if item[0] == "verdict"} == {"NO VERDICT"}


def test_no_picks():
    html = page(make_result(points=()))
    assert ("verdict", "P1", "MEASURE MORE") in outline(html).items
    assert "the recording holds no pick of P1" in html
    assert "no point to report on" in html


def test_singular_covariance_is_drawn_or_told_but_never_go():
    for covariance in (np.diag([1e-6, 1e-6, 0.0]), np.zeros((3, 3)), np.full((3, 3), np.nan), -np.eye(3)):
        point = dataclasses.replace(make_point(), covariance_m2=covariance)
        result = make_result(points=(point,))
        html = page(result)
        assert ("verdict", "P1", "MEASURE MORE") in outline(html).items
        assert json.loads(render_json(result, make_rig(), VALIDATED, "c"))["cuts"][0]["verdict"] == "MEASURE MORE"


def test_failed_consistency_leads():
    html = page(make_result(consistency=make_consistency(False)))
    assert "the data contradict the model" in html
    assert "ABOVE" in html
    assert ("verdict", "P1", "MEASURE MORE") in outline(html).items


def test_families_that_cannot_be_tested_or_are_better_than_claimed():
    consistency = make_consistency()
    mount = FamilyConsistency("mount", 0.0, 0.0, 0.0, float("inf"), 1, 0)
    calm = FamilyConsistency("calm", 10.0, 100.0, 0.5, 1.5, 100, 0)
    families = (*consistency.by_family, mount, calm)
    html = page(make_result(consistency=dataclasses.replace(consistency, by_family=families)))
    assert '<td>mount</td><td class="number">0.0</td><td class="number">0.0</td><td class="number">none</td>' in html
    assert "stated with caution: calm." in html
    assert "nan" not in "".join(re.findall(r"<svg .*?</svg>", html, re.DOTALL))


def test_sources_are_drawn_by_family_and_listed_one_by_one():
    part = make_point().covariance_m2 / 4
    budget = {"picks: P1": part, "picks: P2": part, "mount": 2 * part * (1 - 1e-5), "gauge": 2e-5 * part}
    point = dataclasses.replace(make_point(), budget=budget)
    assert family_shares(point)["picks"] == pytest.approx(np.trace(point.covariance_m2) / 2)
    html = page(make_result(points=(point,)))
    assert "picks: P1</td>" in html
    assert "below 0.1 %" in html


def test_several_cuts_get_a_summary_in_the_plan_s_order():
    cuts = tuple(Cut(point=name, tolerance_along_m=0.02, tolerance_across_m=0.02) for name in ("G1", "P1", "P9"))
    document = build_document(full_result(), make_rig(cuts), VALIDATED, "c" * 64)
    assert isinstance(document.blocks[0], Table)
    assert [row[:2] for row in document.blocks[0].rows] == [("G1", "GO"), ("P1", "GO"), ("P9", "MEASURE MORE")]


def test_hostile_names_stay_text():
    point = dataclasses.replace(make_point(), id="<script>alert(1)</script>\"'", role="<b>")
    result = make_result(points=(point,), provenance={"<img src=x>": "<a href='http://x'>"})
    html = page(result)
    assert "<script" not in html
    assert "<img" not in html
    assert "<a href" not in html
    assert not outline(html).addresses


def test_json_shape():
    data = json.loads(render_json(full_result(), make_rig(), VALIDATED, "c" * 64))
    (cut,) = data["cuts"]
    assert cut["verdict"] == "GO"
    assert cut["plan"]["tolerance_along_m"] == 0.01
    assert data["points"][0]["advice"][0]["gain"] == 0.28
    assert data["points"][1]["verdict"] == "NO VERDICT"
    assert "timing" not in data
    assert data["rejected"][1] == {
        "family": "marker corners",
        "reason": "squared Mahalanobis distance above the gate",
        "count": 7,
    }


def test_images_that_cannot_be_decoded_and_large_ones():
    def view(data):
        return PickView("m_left", START_NS, "P1", data, np.array([10.0, 10.0]), np.eye(2) * 4)

    assert "The image cannot be decoded" in page(full_result(pick_views=(view(b"nothing"),)))
    noise = np.random.default_rng(1).integers(0, 255, (1200, 1600, 3), dtype=np.uint8)
    stream = io.BytesIO()
    Image.fromarray(noise).save(stream, "PNG")
    html = page(full_result(pick_views=(view(stream.getvalue()),) * 4))
    assert len(html) < 3_000_000


def test_comparison_in_closed_form():
    first = dataclasses.replace(make_point(), covariance_m2=np.eye(3) * 4e-6)
    moved = dataclasses.replace(
        first, position_m=first.position_m + np.array([0.003, 0, 0]), covariance_m2=np.eye(3) * 5e-6
    )
    assert mahalanobis2(first, moved) == pytest.approx(1.0)
    a = Run("a.mcap", make_result(points=(first,)), make_rig(), "a" * 64)
    b = Run("b.mcap", make_result(points=(moved, make_point("X"))), make_rig(), "b" * 64)
    html = render_html(build_comparison(a, b, VALIDATED))
    assert "Together 1.0 σ in three dimensions; by chance as much or more in 80.1 % of cases" in html
    assert "In one of the two only: X." in html
    same = render_html(build_comparison(a, a, VALIDATED))
    assert "Together 0 σ" in same


def test_numbers():
    assert mm(0.00483) == "4.8 mm"
    assert mm(0.0124) == "12 mm"
    assert mm(0.123) == "120 mm"
    assert mm(0.00999) == "10 mm"
    assert mm_with(0.35212, 0.0048) == "352.1 ± 4.8 mm"
    assert mm_with(-0.35262, 0.0124) == "−353 ± 12 mm"
    assert with_sigma(0.1002, 0.00049) == "0.10020 ± 0.00049"
    assert significant(0.000123) == "0.00012"
    assert significant(0) == "0"
    assert fixed(-0.0001, 2) == "0.00"
    assert fixed(float("nan"), 2) == "not finite"
    assert utc(1_790_000_000_000_000_000) == "2026-09-21 14:13:20 UTC"
    assert utc(5_500_000_000) == "5.5 s (log time)"
    assert [duration(s) for s in (4.04, 200, 7500)] == ["4.0 s", "3 min 20 s", "2 h 5 min"]
