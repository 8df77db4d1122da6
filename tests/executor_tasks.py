"""Tasks that a spawned process can import, whatever started the tests."""

import os
import signal
import time

from surecut.factors.errors import LogError


def square(item):
    if item == 3:
        raise LogError("log.mcap: is empty")
    if item == 4:
        raise ValueError("two\nlines")
    return item * item


def square_or_die(item):
    if item == 2:
        os.kill(os.getpid(), signal.SIGKILL)
    time.sleep(0.05)
    return item * item


def threads(item):
    return os.environ.get("OMP_NUM_THREADS")
