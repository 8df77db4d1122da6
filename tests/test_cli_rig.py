"""`surecut rig`: the commented example, a check of a file, the rig that a log carries."""

from pathlib import Path

import logmaker
import pytest
import yaml

from surecut.estimator.cli import main
from surecut.factors.rig import Camera, Gates, Kinect, Noise, Rig, Stereo, load_rig


def run(*arguments: str) -> int:
    with pytest.raises(SystemExit) as caught:
        main(arguments)
    return int(caught.value.code or 0)


def example(capsys) -> str:
    assert run("rig", "--example") == 0
    return capsys.readouterr().out


def test_the_example_shows_every_key_and_loads(capsys):
    text = example(capsys)
    rig = load_rig(text)
    assert isinstance(rig, Rig)
    # nothing is left to defaults: the example as written is the effective configuration
    assert yaml.safe_load(text) == rig.model_dump(mode="json", by_alias=True)
    assert text.count("#") > 30


def test_values_in_the_example_are_the_defaults(capsys):
    rig = load_rig(example(capsys))
    bare = Rig(boards=rig.boards)
    assert rig.cameras == bare.cameras
    assert rig.stereo == Stereo()
    assert rig.noise == Noise()
    assert rig.gates == Gates()
    assert rig.kinect.model_copy(update={"b_T_rgb": Kinect().b_T_rgb}) == Kinect()
    assert rig.picks_topic == bare.picks_topic
    assert rig.cameras.m_left.focal_sigma_rel == Camera(image_topic="a", info_topic="b").focal_sigma_rel
    assert rig.boards[0].model_copy(update={"markers": ()}).model_dump() == {
        **type(rig.boards[0])(id="f0", markers=rig.boards[0].markers).model_dump(),
        "markers": (),
    }


def test_a_file_is_checked_and_printed_in_full(tmp_path: Path, capsys):
    (tmp_path / "rig.yaml").write_text(logmaker.RIG)
    assert run("rig", str(tmp_path / "rig.yaml")) == 0
    assert load_rig(capsys.readouterr().out) == load_rig(logmaker.RIG)


@pytest.mark.parametrize(
    ("text", "match"),
    [
        (logmaker.RIG + "\nnoize: {}\n", "unknown key noize"),
        (logmaker.RIG + "\nstereo: {translation_sigma_m: -1}\n", "stereo.translation_sigma_m: .*(got -1)"),
        (logmaker.RIG.replace("[0, 0]}", "[0, 0]}, {id: 7, centre_m: [1, 0]}"), "marker id 7 stands twice"),
        ("- 1", "is no rig file"),
        ("a: [", "is no YAML"),
    ],
)
def test_mistakes_are_one_line(tmp_path: Path, capsys, text, match):
    import re

    (tmp_path / "rig.yaml").write_text(text)
    assert run("rig", str(tmp_path / "rig.yaml")) == 1
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    assert "rig.yaml" in err
    assert re.search(match.replace("(", r"\(").replace(")", r"\)"), err), err


def test_the_rig_of_a_log(tmp_path: Path, capsys):
    logmaker.write_log(tmp_path / "a.mcap", 1)
    assert run("rig", "--from", str(tmp_path / "a.mcap")) == 0
    assert load_rig(capsys.readouterr().out) == load_rig(logmaker.RIG)
    logmaker.write_log(tmp_path / "b.mcap", 1, rig=None)
    assert run("rig", "--from", str(tmp_path / "b.mcap")) == 1
    assert "carries no rig.yaml; give the rig file with --rig" in capsys.readouterr().err


def test_one_thing_at_a_time(tmp_path: Path):
    assert run("rig") == 2
    assert run("rig", "--example", "--from", "a.mcap") == 2
