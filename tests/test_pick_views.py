"""A click is kept as an image with the estimate's place in it; the operator's picks and command stand in the result."""

import io
import json
import sys

import cell_log as cell
import numpy as np
import pytest
from PIL import Image

from surecut.estimator.cli import main
from surecut.estimator.pick_views import PER_POINT
from surecut.estimator.result_json import from_json, to_json
from surecut.estimator.sensing import Sensing
from surecut.factors.errors import SurecutError
from surecut.factors.measurements import Pick
from surecut.factors.rig import load_rig
from surecut.frontends.pick_image import cut_out
from surecut.io.messages import ImageBody, Message
from surecut.io.pixels import RawPixels
from surecut.io.reader import LogReader


@pytest.mark.parametrize(
    ("shape", "px", "corner", "size"),
    [
        ((240, 360), (180.0, 120.0), (120, 60), (120, 120)),  # a third of 360 columns
        ((240, 360), (3.0, 239.0), (0, 120), (120, 120)),  # in the corner
        ((1080, 1920, 3), (960.2, 540.0), (840, 420), (240, 240)),  # no more than 240, and grey
        ((50, 60), (30.0, 20.0), (0, 0), (60, 50)),  # smaller than a cut-out
    ],
)
def test_cut_out(shape, px, corner, size):
    image = np.random.default_rng(0).integers(0, 255, shape, dtype=np.uint8)
    found = cut_out(image, np.array(px))
    assert found.corner_px == corner
    with Image.open(io.BytesIO(found.png)) as shown:
        assert shown.size == size
        assert shown.mode == "L"
        if image.ndim == 2:
            part = image[corner[1] : corner[1] + size[1], corner[0] : corner[0] + size[0]]
            np.testing.assert_array_equal(np.asarray(shown), part)


def test_no_image():
    with pytest.raises(SurecutError, match="empty"):
        cut_out(np.zeros((0, 0), np.uint8), np.zeros(2))


@pytest.fixture(scope="module")
def optimised(tmp_path_factory):
    """A filmed recording, optimised by the command line."""
    folder = tmp_path_factory.mktemp("views")
    log = cell.write(folder / "run.mcap", cell.filmed(cell.pictures(12)))
    output = folder / "estimate.mcap"
    given = ["optimise", str(log), "-o", str(output)]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["/usr/local/bin/surecut", *given])
        with pytest.raises(SystemExit) as told:
            main(given)
    assert told.value.code in (0, None)
    with LogReader(output) as reader:
        return output, from_json(reader.attachment("result.json")), given


def test_views_show_the_estimate(optimised):
    _, result, _ = optimised
    assert 0 < len(result.pick_views) <= PER_POINT
    b_T_o = np.linalg.inv(next(p.matrix for p in result.poses if p.name == "b"))
    by_stamp = {p.stamp_ns: p.matrix for p in result.trajectory}
    for view in result.pick_views:
        with Image.open(io.BytesIO(view.image)) as shown:
            width, height = shown.size
            pixels = np.asarray(shown).astype(int)
        # The same point through the published poses, in the image that was recorded.
        o_p = np.linalg.inv(b_T_o) @ [*result.points[0].position_m, 1.0]
        m_p = np.linalg.inv(by_stamp[view.stamp_ns]) @ o_p
        whole = (cell.K @ m_p[:3])[:2] / m_p[2]
        number = (view.stamp_ns - cell.START_NS) // cell.STEP_NS
        left = cell.pictures(int(number) + 1)[int(number)][0].astype(int)
        corner = np.round(whole - view.pixel).astype(int)
        np.testing.assert_allclose(whole - view.pixel, corner, atol=1.5)  # K is estimated too
        found = [
            (x, y)
            for x in range(corner[0] - 2, corner[0] + 3)
            for y in range(corner[1] - 2, corner[1] + 3)
            if x >= 0 and y >= 0 and np.array_equal(left[y : y + height, x : x + width], pixels)
        ]
        assert len(found) == 1, "the cut-out is no piece of the recorded image"
        values = np.linalg.eigvalsh(view.ellipse_px2)
        assert 0.0 < values[0] <= values[1] < 9.0


def test_picks_and_command_are_kept(optimised):
    output, result, given = optimised
    assert [(p.point_id, p.role, p.camera) for p in result.picks] == [("P1", "cut", "m_left")] * 2
    assert [p.stamp_ns for p in result.picks] == [cell.START_NS + n * cell.STEP_NS for n in (2, 8)]
    assert all(p.sigma_px == pytest.approx(1.0) for p in result.picks)
    assert result.provenance["command"] == "surecut " + " ".join(given)
    again = from_json(to_json(result))
    assert to_json(again) == to_json(result)
    assert again.picks[0].pixel.shape == (2,)
    assert output.stat().st_size < 3_000_000


def test_report_lists_the_picks(optimised, tmp_path):
    output, _, _ = optimised
    html = tmp_path / "r.html"
    with pytest.raises(SystemExit):
        main(["report", str(output), "-o", str(html), "--json", str(tmp_path / "r.json")])
    text = html.read_text()
    assert "operator's picks" in text.replace("&#x27;", "'").replace("&#39;", "'")
    assert "m_left" in text
    assert json.loads((tmp_path / "r.json").read_text())["points"][0]["advice"]


def test_a_click_in_the_kinects_colour_image():
    """The image comes before the click, or with it; a click in a camera without image leaves none."""
    sensing = Sensing(load_rig(cell.RIG))
    picture = np.random.default_rng(3).integers(0, 255, (480, 640, 3), dtype=np.uint8)
    raw = RawPixels("bgr8", 640, 480, 3 * 640, False, picture.ravel())
    shown = Message("/b/rgb/image_raw", 5, 5, "b_rgb", ImageBody(raw, "/b/rgb/image_raw at 5 ns"))
    click = Pick(7, "b_rgb", "P1", "cut", np.array([320.0, 240.0]), np.array([320.0, 240.0]), np.eye(2))
    assert sensing._clicked((click,), None, []) == {}
    sensing._clicked((), None, [shown])
    found = sensing._clicked((click,), None, [])["b_rgb", 7, "P1"]
    assert found.corner_px == (320 - 106, 240 - 106)
