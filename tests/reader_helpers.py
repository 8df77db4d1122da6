"""Logs opened as files and as pipes."""

import contextlib
import os
import threading
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

from surecut.io.reader import LogReader

Open = Callable[..., LogReader]
STREAMS: list[BinaryIO] = []


def from_file(path: Path, topics=None) -> LogReader:
    return LogReader(path, topics)


def from_pipe(path: Path, topics=None) -> LogReader:
    """The same bytes through a pipe: not seekable, in pieces."""
    end, start = os.pipe()

    def feed():
        with contextlib.suppress(BrokenPipeError), os.fdopen(start, "wb") as sink, path.open("rb") as source:
            while data := source.read(3000):
                sink.write(data)

    threading.Thread(target=feed, daemon=True).start()
    STREAMS.append(os.fdopen(end, "rb"))
    return LogReader(STREAMS[-1], topics)


def close_streams() -> None:
    """What `from_pipe` has opened."""
    while STREAMS:
        STREAMS.pop().close()
