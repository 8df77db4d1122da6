"""Fixtures that several test modules share."""

from collections.abc import Iterator

from surecut.estimator.threads import use_one_thread

use_one_thread()  # as every command does, before NumPy is there: sums in another order can turn a gate's decision

import pytest  # noqa: E402
from reader_helpers import Open, close_streams, from_file, from_pipe  # noqa: E402


@pytest.fixture(params=[from_file, from_pipe])
def open_log(request) -> Iterator[Open]:
    """A log opened as a file, and as a pipe that is closed afterwards."""
    yield request.param
    close_streams()
