"""Front ends in a process of their own see the same as in this one, and their end is told whatever it was."""

import subprocess
import sys
from pathlib import Path

import pytest
from sensed_digest import digest

from surecut.estimator import sensed_log
from surecut.estimator.optimise import rig_of
from surecut.estimator.sensed_log import SensedElsewhere, SensedHere, opened
from surecut.factors.errors import LogError, SurecutError
from surecut.io.reader import LogReader

SAMPLE = Path(__file__).parents[1] / "logs" / "sample.mcap"


def rig():
    with LogReader(SAMPLE) as reader:
        return rig_of(reader, None)


@pytest.fixture(params=[True, False], ids=["copies", "fresh"])
def forks(request, monkeypatch):
    """Processes that are copies of this one, and such as load for themselves."""
    if request.param and not sensed_log.may_fork():
        pytest.skip("this process has threads already, or the system makes no copies")
    monkeypatch.setattr(sensed_log, "may_fork", lambda: request.param)


def test_fresh_processes_see_the_same(monkeypatch):
    monkeypatch.setattr(sensed_log, "may_fork", lambda: False)
    with opened(SAMPLE, rig(), 1) as here, opened(SAMPLE, rig(), 2) as elsewhere:
        assert digest(elsewhere) == digest(here)
        assert elsewhere.report.sha256


def test_copies_of_a_process_see_the_same():
    here = Path(__file__).with_name("sensed_digest.py")
    told = subprocess.run([sys.executable, here, SAMPLE], capture_output=True, text=True, check=True).stdout.split()
    if told[0] == "False":
        pytest.skip("the system makes no copies")
    with opened(SAMPLE, rig(), 1) as recording:
        assert told[1] == digest(recording)


def test_an_error_of_the_front_ends_comes_across(tmp_path):
    broken = tmp_path / "no.mcap"
    broken.write_bytes(b"this is no recording" * 50)
    with SensedElsewhere(broken, rig()) as recording, pytest.raises(LogError, match="not an MCAP"):
        list(recording)
    with SensedHere(broken, rig()) as recording, pytest.raises(LogError, match="not an MCAP"):
        list(recording)


@pytest.mark.usefixtures("forks")
@pytest.mark.parametrize("which", [0, 1])
def test_a_killed_process_is_told(which, monkeypatch):
    monkeypatch.setattr(sensed_log, "AHEAD", 4)  # so that neither can have ended before
    with SensedElsewhere(SAMPLE, rig()) as recording:
        seen = iter(recording)
        next(seen)
        recording._processes[which].kill()
        with pytest.raises(SurecutError, match=r"sample.mcap: the process that reads it was killed \(exit code -9\)"):
            list(seen)
