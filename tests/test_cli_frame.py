"""The command line's frame: lazy commands, one line for errors, exit statuses."""

import subprocess
import sys
from importlib.metadata import EntryPoint

import pytest

from surecut.estimator import cli
from surecut.factors.errors import LogError

MODULE = '''"""Does a thing.

More.
"""
import typer
from surecut.factors.errors import LogError

def command(how: str = "well", count: int = 1) -> None:
    """Do a thing."""
    if how == "badly":
        raise LogError("log.mcap: first line\\n  second line")
    if how == "brokenly":
        raise KeyError("a defect")
    if how == "interrupted":
        raise KeyboardInterrupt
    print("done", how)

app = typer.Typer()

@app.command()
def first() -> None:
    print("first done")

@app.command()
def second() -> None:
    print("second done")
'''


@pytest.fixture(autouse=True)
def _commands(tmp_path, monkeypatch):
    (tmp_path / "planted.py").write_text(MODULE)
    (tmp_path / "never.py").write_text('"""Costs much to import."""\nraise RuntimeError\n')
    monkeypatch.syspath_prepend(tmp_path)
    points = [
        EntryPoint("do", "planted:command", cli.GROUP),
        EntryPoint("many", "planted:app", cli.GROUP),
        EntryPoint("never", "never:command", cli.GROUP),
        EntryPoint("absent", "not_there.at_all:command", cli.GROUP),
    ]
    monkeypatch.setattr(cli, "entry_points", lambda group: points)


def status(*arguments: str) -> int:
    with pytest.raises(SystemExit) as caught:
        cli.main(arguments)
    return int(caught.value.code or 0)


def test_a_command_runs(capsys):
    assert status("do", "--how", "fast") == 0
    assert capsys.readouterr().out == "done fast\n"


def test_sub_commands_run(capsys):
    assert status("many", "second") == 0
    assert capsys.readouterr().out == "second done\n"


def test_help_imports_no_command(capsys):
    assert status("--help") == 0
    out = capsys.readouterr().out
    assert "Costs much to import." in out
    assert "Does a thing." in out
    assert "absent" in out


def test_an_error_is_one_line_and_status_1(capsys):
    assert status("do", "--how", "badly") == 1
    captured = capsys.readouterr()
    assert captured.err == "surecut: log.mcap: first line second line\n"
    assert captured.out == ""


def test_a_defect_keeps_its_traceback():
    with pytest.raises(KeyError, match="a defect"):
        cli.main(["do", "--how", "brokenly"])


def test_an_interruption_is_130():
    assert status("do", "--how", "interrupted") == 130


@pytest.mark.parametrize("arguments", [["nothing"], ["do", "--no-such-option"], ["do", "--count", "many"], ["do", "x"]])
def test_wrong_usage_is_2(arguments, capsys):
    assert status(*arguments) == 2
    assert "Usage" in capsys.readouterr().err


def test_version(capsys):
    assert status("--version") == 0
    assert capsys.readouterr().out.startswith("surecut 0.")


def test_errors_are_joined_to_one_line():
    assert cli.one_line(LogError("a\n\tb  c")) == "a b c"


def test_help_is_fast():
    """No numeric or vision library is loaded for the list of commands."""
    code = (
        "import sys\nfrom surecut.estimator.cli import main\ntry:\n    main(['--help'])\nexcept SystemExit:\n    pass\n"
        "heavy = {'numpy', 'cv2', 'gtsam', 'open3d', 'mcap', 'pydantic'} & set(sys.modules)\n"
        "sys.exit(repr(heavy) if heavy else 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stderr
