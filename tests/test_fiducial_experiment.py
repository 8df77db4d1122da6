"""The paper's fiducial experiment: a small one anew, and the page that the large one wrote."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from surecut.estimator import cli
from surecut.factors.errors import SurecutError
from surecut.simulation.commands.experiment import distances_of, size_of
from surecut.simulation.fiducial_experiment import METHODS, Depth, Outcome, Setup, run_experiment
from surecut.simulation.fiducial_plot import draw
from surecut.simulation.fiducial_table import as_json, as_section, rows, rows_of_json, with_section

PAGE = Path(__file__).parents[1] / "docs" / "fiducial.md"
SMALL = Setup(
    distances_m=(0.6, 1.0), images=1, size_px=(480, 360), focal_px=400.0, focal_error_rel=0.01, focal_sigma_rel=0.01
)


@pytest.fixture(scope="module")
def small():
    return run_experiment(SMALL)


def test_every_marker_by_every_method(small):
    assert len(small.depths) == 2 * 2 * 4 * len(METHODS)
    assert {row.count for row in rows(small.depths)} == {4}


def test_the_joint_depth_holds_with_a_wrong_side_and_a_wrong_focal_length(small):
    for row in (r for r in rows(small.depths) if r.method == "joint"):
        # one per cent too long: one per cent too far, and the sigma says so
        assert abs(row.mean_m - 0.01 * row.distance_m) < 0.002
        assert row.spread_m < 0.002
        assert row.inside95 == 1.0
        assert row.rotation_rad < np.deg2rad(0.5)
    assert {e.kind for e in small.told} == {"side_length_wrong"}
    assert len(small.told) == 2


def test_the_chain_behaves_as_the_paper_says(small):
    found = {(r.typed_side_m, r.method, r.distance_m): r for r in rows(small.depths)}
    for distance in SMALL.distances_m:
        # raw: too far with the right side, a third too near with 50 mm for 75; S repairs both to the same depth
        assert found[0.075, "raw", distance].mean_m > 0.01 * distance
        assert abs(found[0.05, "raw", distance].mean_m / distance + 1 / 3) < 0.05
        right, wrong = (found[side, "times S", distance].mean_m for side in (0.075, 0.05))
        assert abs(right - wrong) < 0.001


def test_figures_of_known_errors():
    depths = [
        Depth(1.0, k, 0.075, "joint", 0, 1.0 + error, 1.0, 0.001, 0.01)
        for k, error in enumerate((0.001, -0.003, 0.002))
    ]
    (row,) = rows(depths)
    assert (row.count, row.inside95) == (3, pytest.approx(1 / 3))
    assert (row.mean_m, row.spread_m, row.worst_m) == pytest.approx((0.0, 0.005, 0.003))


def test_json_and_pictures(small):
    text = as_json(small)
    assert rows_of_json(text) == rows(small.depths)
    assert json.loads(text)["setup"]["focal_error_rel"] == 0.01
    assert b"<svg" in draw(small, ".svg")
    assert draw(small, ".png").startswith(b"\x89PNG")
    with pytest.raises(SurecutError, match="svg"):
        draw(small, ".jpg")


def test_a_section_takes_the_place_of_its_predecessor():
    def section(setup, error):
        depth = Depth(1.0, 0, 0.075, "joint", 0, 1.0 + error, 1.0, 0.001, 0.01)
        return as_section(setup, rows(Outcome(setup, (depth,), ()).depths), "No event.")

    right, wrong = replace(SMALL, focal_error_rel=0.0), SMALL
    page = "# Title\n\nWords.\n"
    for setup, error in ((right, 0.001), (wrong, 0.002), (right, 0.003)):
        page = with_section(page, section(setup, error))
    assert page.startswith("# Title\n\nWords.\n\n## Focal length right, sigma 1 %\n")
    assert re.findall(r"\+\d\.\d", page) == ["+3.0", "+2.0"]


def test_arguments():
    assert distances_of("400,1200,400") == (0.4, 0.8, 1.2)
    assert size_of("640x480") == (640, 480)
    for wrong in ("400,1200", "1200,400,100", "0,1,1", "a,b,c"):
        with pytest.raises(SurecutError, match=r"such as|have to rise"):
            distances_of(wrong)
    with pytest.raises(SurecutError, match="1920x1080"):
        size_of("1920")


def test_a_picture_of_an_unknown_kind_is_refused_before_the_work(capsys):
    with pytest.raises(SystemExit) as caught:
        cli.main(["experiment", "fiducial", "--plot", "a.gif"])
    assert caught.value.code == 1
    assert "a.gif" in capsys.readouterr().err


# The page ------------------------------------------------------------------------------------------------------------


def tables():
    """Sections of the page: heading to (mean, spread) of the joint columns in mm and degrees, by distance."""
    found = {}
    for section in PAGE.read_text(encoding="utf-8").split("\n## ")[1:]:
        lines = re.findall(r"^\| (\d+) \|(.*)\|$", section, re.MULTILINE)
        joint = [(float(z), [c.strip() for c in rest.split("|")][-2:]) for z, rest in lines]
        if joint:
            found[section.partition("\n")[0]] = [(z, *map(float, d.split(" / ")), float(t)) for z, (d, t) in joint]
    return found


def test_the_page_holds_what_is_asked():
    right, wrong = tables().values()
    assert len(right) == len(wrong) == 18  # nine distances, two side lengths
    for z, mean, spread, turned in right:
        assert 400 <= z <= 1200
        assert abs(mean) <= 2.0
        assert spread <= 2.0
        assert turned < 0.3
    for z, mean, spread, turned in wrong:
        assert abs(mean) < 1.96 * 0.01 * z
        assert spread <= 2.0
        assert turned < 0.3


def test_the_page_names_commands_that_exist():
    commands = re.findall(r"^surecut (.*)$", PAGE.read_text(encoding="utf-8"), re.MULTILINE)
    assert commands
    for command in commands:
        with pytest.raises(SystemExit) as caught:
            cli.main([*command.split("#")[0].split(), "--help"])
        assert not caught.value.code
