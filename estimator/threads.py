"""Threads of the numeric libraries: work is shared among processes, and threads beneath them wait for each other.

Two processes on two cores took 20 s of processor time with one thread each for what took them 35 s with two.
"""

import os
from collections.abc import Iterator
from contextlib import contextmanager

VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def use_one_thread() -> None:
    """For this process, unless the user has set it otherwise; before NumPy is imported."""
    for name in VARIABLES:
        os.environ.setdefault(name, "1")


@contextmanager
def single_threaded_children() -> Iterator[None]:
    """Processes started meanwhile run their numeric libraries with one thread: the jobs share the cores already."""
    before = {name: os.environ.get(name) for name in VARIABLES}
    os.environ.update(dict.fromkeys(VARIABLES, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
