"""Results as JSON: lossless, stable, with a hash that anyone can check."""

import dataclasses
import hashlib
import json
from dataclasses import MISSING, fields

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from report_results import make_point, make_pose, make_result

from surecut.estimator.result import Advice, PickView, Result
from surecut.estimator.result_json import FORMAT, ResultError, content_sha256, from_json, to_json


def same(a, b):
    """Equality down to the bit, NaN included."""
    if dataclasses.is_dataclass(a):
        return type(a) is type(b) and all(same(getattr(a, f.name), getattr(b, f.name)) for f in dataclasses.fields(a))
    if isinstance(a, np.ndarray):
        return isinstance(b, np.ndarray) and a.shape == b.shape and a.tobytes() == b.tobytes()
    if isinstance(a, tuple):
        return isinstance(b, tuple) and len(a) == len(b) and all(same(x, y) for x, y in zip(a, b, strict=True))
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(same(a[k], b[k]) for k in a)
    if isinstance(a, float) and np.isnan(a):
        return isinstance(b, float) and np.isnan(b)
    return type(a) is type(b) and a == b


def full_result():
    view = PickView(
        "b_rgb", 12, "P1", b"\x89PNG\r\n\x00\xff", np.array([3.5, 7.25]), np.array([[4.0, 1.0], [1.0, 9.0]])
    )
    advice = {"P1": (Advice("See the board again", "from 1.2 m", 0.004, 0.3),)}
    return make_result(advice=advice, pick_views=(view,))


def reseal(data):
    """What somebody would write who knows the format: the hash fits again."""
    return json.dumps({**data, "sha256": content_sha256(data)})


def test_round_trip_is_lossless_and_stable():
    result = full_result()
    text = to_json(result)
    back = from_json(text)
    assert same(back, result)
    assert to_json(back) == text


def test_shape_for_other_readers():
    data = json.loads(to_json(full_result()))
    assert list(data)[:5] == ["surecut", "log_sha256", "rig_sha256", "format", "sha256"]
    assert data["points"][0]["id"] == "P1"
    assert np.shape(data["points"][0]["covariance_m2"]) == (3, 3)
    pose = data["poses"]["b"]
    assert pose["frame"] == "o"
    assert pose["translation_m"] == [0.2, 0.1, -0.4]
    assert pose["rotation_wxyz"] == pytest.approx([np.cos(0.15), 0, 0, np.sin(0.15)])
    assert data["calibration"]["stereo baseline"]["prior_sigma"] == 0.002
    assert data["consistency"]["by_family"]["picks"]["dof"] == 11.0
    assert data["provenance"]["command"].startswith("surecut")


def test_equal_results_give_equal_bytes_whatever_the_order_of_their_maps():
    result = full_result()
    turned = dataclasses.replace(
        result,
        provenance=dict(reversed(result.provenance.items())),
        points=tuple(dataclasses.replace(p, budget=dict(reversed(p.budget.items()))) for p in result.points),
    )
    assert to_json(turned) == to_json(result)


def test_timing_does_not_touch_the_hash():
    fast = json.loads(to_json(make_result(timing={"total_s": 1.0})))
    slow = json.loads(to_json(make_result(timing={"total_s": 9.0})))
    assert fast["sha256"] == slow["sha256"]


def test_hash_is_the_published_one():
    data = json.loads(to_json(full_result()))
    kept = {k: v for k, v in data.items() if k not in ("sha256", "timing")}
    text = json.dumps(kept, sort_keys=True, ensure_ascii=False, separators=(",", ":"))
    assert data["sha256"] == hashlib.sha256(text.encode()).hexdigest()


@settings(max_examples=60, deadline=None)
@given(
    arrays(np.float64, (3, 3), elements=st.floats(allow_nan=True, allow_infinity=True)),
    st.text(st.characters(exclude_categories=["Cs"])),
    st.integers(-(2**63), 2**63 - 1),
)
def test_any_number_and_text_survives(covariance, text, stamp):
    covariance = np.where(np.isnan(covariance), np.nan, covariance)
    point = dataclasses.replace(make_point(), covariance_m2=covariance, id=text, radius95_m=float("inf"))
    result = make_result(points=(point,), provenance={text: text}, end_ns=stamp)
    back = from_json(to_json(result))
    assert same(back, result)


def test_two_poses_of_one_name_in_two_parents():
    poses = (make_pose("b", "o", (0, 0, 1), 5), make_pose("b", "world", (0, 0, 2), 5))
    result = make_result(poses=poses)
    assert list(json.loads(to_json(result))["poses"]) == ["b", "b@world"]
    assert same(from_json(to_json(result)).poses, poses)
    with pytest.raises(ResultError, match="b in o stands there twice"):
        to_json(make_result(poses=poses[:1] * 3))


def test_an_edit_is_noticed():
    text = to_json(full_result())
    assert '"radius95_m":' in text
    edited = text.replace('"passed":true', '"passed":false')
    assert edited != text
    with pytest.raises(ResultError, match=r"run\.mcap: was changed after it was written"):
        from_json(edited, "run.mcap")


def test_newer_version():
    data = json.loads(to_json(full_result()))
    with pytest.raises(ResultError, match=f"format {FORMAT + 1} of surecut 0.1.0, this one reads {FORMAT}"):
        from_json(reseal({**data, "format": FORMAT + 1}))


@pytest.mark.parametrize(
    "text", ["", "{", "[1]", "{}", '{"format": 1}', "\x00", '{"format": NaN, "sha256": ""}', "[" * 9000]
)
def test_no_result_at_all(text):
    with pytest.raises(ResultError, match=r"^x: ") as caught:
        from_json(text, "x")
    assert "\n" not in str(caught.value)


def test_missing_keys_and_wrong_types_even_under_a_fitting_hash():
    good = json.loads(to_json(full_result()))
    head = {"surecut", "log_sha256", "rig_sha256", "format", "sha256"}
    later = {f.name for f in fields(Result) if f.default is not MISSING or f.default_factory is not MISSING}
    for key in good.keys() - head - later:
        with pytest.raises(ResultError, match=f"lacks {key}"):
            from_json(reseal({k: v for k, v in good.items() if k != key}))
    for key, bad in [
        ("points", 3),
        ("end_ns", "now"),
        ("end_ns", True),
        ("config_yaml", None),
        ("extra", 1),
        ("points", [{}]),
    ]:
        with pytest.raises(ResultError):
            from_json(reseal({**good, key: bad}))
    short = [{**good["points"][0], "covariance_m2": [[1.0, 0.0], [0.0, 1.0]]}]
    with pytest.raises(ResultError, match=r"points\[0\].covariance_m2 has shape \(2, 2\)"):
        from_json(reseal({**good, "points": short}))


def test_families_of_one_name_are_refused():
    consistency = make_result().consistency
    double = dataclasses.replace(consistency, by_family=consistency.by_family * 2)
    with pytest.raises(ResultError, match="by_family: two entries"):
        to_json(make_result(consistency=double))
