"""Fixtures that several test modules share."""

from collections.abc import Iterator

import pytest
from reader_helpers import Open, close_streams, from_file, from_pipe


@pytest.fixture(params=[from_file, from_pipe])
def open_log(request) -> Iterator[Open]:
    """A log opened as a file, and as a pipe that is closed afterwards."""
    yield request.param
    close_streams()
