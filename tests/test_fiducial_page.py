"""The printable page: exact sizes in PDF and SVG, centres that the picture confirms, and a rig section that loads."""

import re

import cv2
import numpy as np
import pytest
import typer
from typer.testing import CliRunner

from surecut.estimator.commands.board import command, length_mm, marker_ids, page_size_mm, rig_section
from surecut.factors.errors import RigError
from surecut.factors.rig import load_rig
from surecut.frontends.fiducials.dictionaries import marker_dictionary
from surecut.frontends.fiducials.page import PAPERS_MM, as_pdf, as_svg, lay_out

PX_PER_MM = 6


def pdf_rectangles(data):
    """Page size and the filled rectangles in millimetres from the upper left corner, by the file's own numbers."""
    text = data.decode("latin-1")
    box = [float(v) for v in re.search(r"/MediaBox \[([^\]]*)\]", text)[1].split()]
    scale = [float(v) for v in re.search(r"([-0-9. ]+) cm", text)[1].split()]
    found = np.array(
        [[float(v) for v in r.split()] for r in re.findall(r"([-0-9.]+ [-0-9.]+ [-0-9.]+ [-0-9.]+) re", text)]
    )
    to_mm = 25.4 / 72.0
    x, y = found[:, 0] * scale[0], found[:, 1] * scale[3] + scale[5]
    top = box[3] - y
    sizes = np.column_stack([found[:, 2] * scale[0], -found[:, 3] * scale[3]])
    return np.array(box[2:]) * to_mm, np.column_stack([x, top, sizes]) * to_mm


def picture(rectangles, size_mm):
    image = np.full((round(size_mm[1] * PX_PER_MM), round(size_mm[0] * PX_PER_MM)), 255, np.uint8)
    for x, y, w, h in rectangles * PX_PER_MM:
        image[round(y) : round(y + h), round(x) : round(x + w)] = 0
    return image


@pytest.mark.parametrize(
    ("dictionary", "ids", "side", "paper"),
    [
        ("DICT_4X4_50", (0, 1, 2, 3), 75.0, "A4"),
        ("tag36h11", (7, 5, 9, 1, 4, 0), 60.0, "A3"),
        ("DICT_6X6_250", (12,), 96.0, "A5"),
    ],
)
def test_pdf_is_exact_and_shows_the_board(dictionary, ids, side, paper):
    page = lay_out(dictionary, ids, side, PAPERS_MM[paper])
    size, rectangles = pdf_rectangles(as_pdf(page))
    np.testing.assert_allclose(size, PAPERS_MM[paper], atol=1e-3)
    known = marker_dictionary(dictionary)
    corners, found, _ = cv2.aruco.ArucoDetector(known.opencv).detectMarkers(picture(rectangles, size))
    assert sorted(np.ravel(found)) == sorted(ids)
    places = {m.id: m.centre_m for m in page.board.markers}
    for marker, quad in zip(np.ravel(found), corners, strict=True):
        mm = (quad.reshape(4, 2) + 0.5) / PX_PER_MM
        centre = mm.mean(0) - np.array(size) / 2
        np.testing.assert_allclose(np.array(places[int(marker)]) * 1000, centre * [1, -1], atol=0.15)
        edges = np.linalg.norm(mm - np.roll(mm, 1, axis=0), axis=1)
        np.testing.assert_allclose(edges, side, atol=0.35)
        # corner 0 is the lower left one: the page frame has y up
        lower_left = mm[known.from_opencv[0]]
        assert lower_left[0] < mm.mean(0)[0]
        assert lower_left[1] > mm.mean(0)[1]


def test_edges_and_ruler_to_the_hundredth_of_a_millimetre():
    page = lay_out("DICT_4X4_50", (0, 1, 2, 3), 75.0, PAPERS_MM["A4"])
    _, rectangles = pdf_rectangles(as_pdf(page))
    left = (page.board.markers[0].centre_m[0] * 1000 + 105.0) - 37.5
    top = (148.5 - page.board.markers[0].centre_m[1] * 1000) - 37.5
    first = rectangles[(rectangles[:, 0] < left + 75) & (rectangles[:, 1] < top + 75) & (rectangles[:, 2] > 1)]
    np.testing.assert_allclose([first[:, 0].min(), first[:, 1].min()], [left, top], atol=0.01)
    np.testing.assert_allclose((first[:, 0] + first[:, 2]).max() - left, 75.0, atol=0.01)
    np.testing.assert_allclose((first[:, 1] + first[:, 3]).max() - top, 75.0, atol=0.01)
    ruler = np.array(page.ruler)
    ticks = ruler[1:, 0] + ruler[1:, 2] / 2
    assert ticks.max() - ticks.min() == pytest.approx(100.0, abs=1e-9)
    assert len(ticks) == 101


def test_svg_says_the_same_as_pdf():
    page = lay_out("DICT_5X5_100", (0, 1), 50.0, PAPERS_MM["A5"])
    svg = as_svg(page)
    assert 'width="148mm" height="210mm" viewBox="0 0 148 210"' in svg
    drawn = re.findall(r"M([-0-9.]+) ([-0-9.]+)h([-0-9.]+)v([-0-9.]+)h", svg)
    _, rectangles = pdf_rectangles(as_pdf(page))
    np.testing.assert_allclose(np.array(drawn, float), rectangles, atol=2e-3)


def test_markers_keep_a_white_rim():
    for count in range(1, 13):
        page = lay_out("DICT_4X4_50", tuple(range(count)), 40.0, PAPERS_MM["A4"])
        centres = np.array([m.centre_m for m in page.board.markers]) * 1000
        cell = 40.0 / 6
        for k in range(count):
            apart = np.abs(np.delete(centres, k, 0) - centres[k]).max(1) - 40.0
            assert (apart >= 2 * cell - 1e-6).all()
        assert (np.abs(centres) + 20.0 + cell <= np.array(PAPERS_MM["A4"]) / 2 + 1e-6).all()


def test_the_rig_section_loads():
    page = lay_out("tag36h11", (3, 4), 60.0, PAPERS_MM["A4"], "f7")
    assert load_rig(rig_section(page.board)).boards == (page.board,)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("DICT_4X4_50", (0, 50), 30.0), "ids 0 to 49"),
        (("DICT_4X4_50", (0, 0), 30.0), "each id once"),
        (("DICT_4X4_50", (0, 1, 2, 3), 120.0), "do not fit"),
        (("DICT_9X9", (0,), 30.0), "not known"),
    ],
)
def test_what_cannot_be_printed(arguments, says):
    with pytest.raises(RigError, match=says):
        lay_out(*arguments, PAPERS_MM["A4"])


def test_words_of_the_command_line():
    assert [length_mm(t) for t in ("75mm", "7.5 cm", "0.075m", "1in")] == [75.0, 75.0, 75.0, 25.4]
    assert marker_ids("0-3,7, 9-9") == (0, 1, 2, 3, 7, 9)
    assert page_size_mm("letter") == (215.9, 279.4)
    assert page_size_mm("300x400mm") == (300.0, 400.0)
    for wrong in ("75", "-3mm", "0mm", "mm", "1e3mm"):
        with pytest.raises(RigError):
            length_mm(wrong)
    for wrong in ("", "a", "3-1", "1,,2"):
        with pytest.raises(RigError):
            marker_ids(wrong)


def test_the_command_writes_all_files(tmp_path):
    out = tmp_path / "board.pdf"
    app = typer.Typer()
    app.command()(command)
    result = CliRunner().invoke(app, ["--ids", "0-3", "--side", "75mm", "--page", "A4", "-o", str(out), "--svg"])
    assert result.exit_code == 0, result.output
    assert out.read_bytes().startswith(b"%PDF-")
    assert out.with_suffix(".svg").read_text().startswith("<svg")
    assert out.with_suffix(".yaml").read_text() == result.output
    assert len(load_rig(result.output).boards[0].markers) == 4
