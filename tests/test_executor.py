"""Serial, process pool and Dask give the same outcomes; failures and deaths are rows."""

import os

import pytest
from executor_tasks import square, square_or_die, threads

from surecut.estimator.executor import DaskExecutor, ProcessExecutor, SerialExecutor, choose_executor
from surecut.factors.errors import SurecutError


def as_rows(outcomes):
    return sorted((outcome.item, outcome.value, outcome.error) for outcome in outcomes)


EXPECTED = [
    (0, 0, None),
    (1, 1, None),
    (2, 4, None),
    (3, None, "log.mcap: is empty"),
    (4, None, "ValueError: two lines"),
    (5, 25, None),
]


@pytest.mark.parametrize("executor", [SerialExecutor(), ProcessExecutor(2)])
def test_values_and_reasons(executor):
    assert as_rows(executor.run(square, range(6))) == EXPECTED


def test_a_process_that_dies_is_a_row_and_the_others_go_on():
    rows = as_rows(ProcessExecutor(2).run(square_or_die, range(5)))
    assert [(item, value) for item, value, _ in rows] == [(0, 0), (1, 1), (2, None), (3, 9), (4, 16)]
    assert "died" in rows[2][2]


def test_children_are_single_threaded_and_the_parent_keeps_its_setting(monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "3")
    assert [outcome.value for outcome in ProcessExecutor(1).run(threads, [0])] == ["1"]
    assert os.environ["OMP_NUM_THREADS"] == "3"


def test_choice():
    assert choose_executor() == SerialExecutor()
    assert choose_executor(3) == ProcessExecutor(3)
    assert choose_executor(3, "tcp://127.0.0.1:1") == DaskExecutor("tcp://127.0.0.1:1")


@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::ResourceWarning")
def test_dask_on_a_real_scheduler_with_two_worker_processes():
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, host="127.0.0.1", dashboard_address=None
    ) as cluster:
        assert as_rows(DaskExecutor(cluster.scheduler_address).run(square, range(6))) == EXPECTED


@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::ResourceWarning")
def test_no_scheduler_is_one_line():
    pytest.importorskip("distributed")
    with pytest.raises(SurecutError, match="no Dask scheduler answers"):
        list(DaskExecutor("tcp://127.0.0.1:9", timeout_s=1.0).run(square, [1]))
