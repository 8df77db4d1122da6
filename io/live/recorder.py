"""A recording of the estimate that can be read up to the last second, whatever happens to the process."""

import contextlib
import os
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import BinaryIO, cast

from ...factors.errors import LogError
from ..writer import McapSink
from .interfaces import LiveImage, LiveUpdate, OnCommand
from .outbox import Outbox, ThroughOutbox
from .tally import Tally
from .views import Entry, image_message, ros_messages

OpenFile = Callable[[Path], BinaryIO]
_RETRY_S = 2.0


class Recorder(ThroughOutbox):
    """An MCAP file of ROS 2 messages; every second its chunk is closed and the file is synchronised with the disk.

    When the disk is full (or the file cannot be written for another reason) the part that was written stays readable,
    what comes then is counted as dropped, and a new part (`NAME-1.mcap`, ...) is begun once writing works again. A new
    part is begun too where the file exists already: nothing is ever overwritten. Only what is on the disk counts as
    sent; what is lost with a chunk that could not be closed counts as dropped.

    A part is also ended after `part_s`: what a writer has to remember of a file grows with the file.

    Args:
        images: record the images too.
        attachments: name, media type and bytes, such as the rig, at the start of each part.
        open_file: opens a new file for writing, unbuffered.
    """

    def __init__(
        self,
        path: Path,
        *,
        images: bool = False,
        attachments: tuple[tuple[str, str, bytes], ...] = (),
        flush_s: float = 1.0,
        part_s: float = 3600.0,
        open_file: OpenFile | None = None,
    ) -> None:
        self._path = path
        self._attachments = attachments
        self._open_file = open_file or _create
        self._tally = Tally()
        self._outbox = Outbox(
            "surecut-recorder",
            self._write,
            self._tally,
            tick=self._flush,
            tick_s=flush_s,
            images=images,
            maximum_updates=256,
            maximum_image_bytes=32 << 20,
        )
        self._part_s = part_s
        self._part = 0
        self._begun_s = 0.0
        self._file: _Whole | None = None
        self._sink: McapSink | None = None
        self._sound = 0
        """Bytes of the file that are on the disk and end with a whole chunk."""
        self._unsound = 0
        """Updates and images that were written after them."""
        self._retry_s = 0.0
        self._status = "not started"
        self._closing = threading.Lock()

    @property
    def name(self) -> str:
        return f"recording {self._path}"

    def status(self) -> str:
        """One line for people."""
        return f"{self.name}: {self._status}"

    def start(self, on_command: OnCommand | None = None) -> None:
        """
        Raises:
            LogError: the file cannot be created.
        """
        try:
            self._begin()
        except OSError as error:
            reason = error.strerror or str(error)
            raise LogError(f"{self._path}: cannot be created ({reason}); choose another place for it") from error
        self._outbox.start()

    def stop(self) -> None:
        self._outbox.stop()
        with self._closing:
            self._finish()

    def counters(self) -> Mapping[str, int]:
        return self._outbox.counters()

    def _write(self, item: LiveUpdate | LiveImage) -> None:
        entries = [image_message(item)] if isinstance(item, LiveImage) else list(ros_messages(item))
        with self._closing:
            if not self._ready():
                self._tally.add("dropped")
                return
            try:
                self._unsound += 1
                self._append(entries, item.stamp_ns)
            except (OSError, LogError) as error:
                self._give_up(error)

    def _append(self, entries: list[Entry], stamp_ns: int) -> None:
        assert self._sink is not None
        for topic, type_name, message in entries:
            self._sink.write(topic, type_name, message, stamp_ns)

    def _flush(self) -> None:
        with self._closing:
            if self._sink is None or self._file is None:
                return  # the next update tries again
            try:
                self._sink.flush()
                os.fsync(self._file.fileno())
                self._sound = self._file.tell()
                self._settle("sent")
                if time.monotonic() - self._begun_s > self._part_s:
                    self._finish()
            except (OSError, LogError) as error:
                self._give_up(error)

    def _finish(self) -> None:
        """End the part in order."""
        sink, file = self._sink, self._file
        self._sink = self._file = None
        if sink is None or file is None:
            return
        try:
            sink.close()
            os.fsync(file.fileno())
            self._status = "finished"
            self._settle("sent")
        except (OSError, LogError) as error:
            self._status = str(error)
            self._tally.add("errors")
            self._settle("dropped")
        finally:
            _close(file)

    def _settle(self, fate: str) -> None:
        """Count what was written since the file was last whole."""
        if self._unsound:
            self._tally.add(fate, number=self._unsound)
        self._unsound = 0

    def _ready(self) -> bool:
        """Whether there is a file to write to; begins a new part when it is time to try."""
        if self._sink is not None:
            return True
        if time.monotonic() < self._retry_s:
            return False
        try:
            self._begin()
        except (OSError, LogError) as error:
            self._status = str(error)
            self._retry_s = time.monotonic() + _RETRY_S
            return False
        return True

    def _begin(self) -> None:
        path = self._free_path()
        file = _Whole(self._open_file(path))
        try:
            sink = McapSink(cast(BinaryIO, file), chunk_size=1 << 20)
            for name, media_type, data in self._attachments:
                sink.attach(name, media_type, data)
            sink.flush()
            os.fsync(file.fileno())
        except (OSError, LogError):
            _close(file)
            path.unlink(missing_ok=True)
            raise
        self._file, self._sink, self._sound = file, sink, file.tell()
        self._begun_s = time.monotonic()
        self._status = f"writing {path.name}"

    def _free_path(self) -> Path:
        """The first part that does not exist: a process that was killed and started again overwrites nothing."""
        path = self._path
        while path.exists():
            self._part += 1
            path = self._path.with_stem(f"{self._path.stem}-{self._part}")
        return path

    def _give_up(self, error: Exception) -> None:
        """Leave the part as it was when it was last whole."""
        self._status = str(error)
        self._tally.add("errors")
        self._settle("dropped")
        file, self._sink, self._file = self._file, None, None
        self._retry_s = time.monotonic() + _RETRY_S
        if file is not None:
            with contextlib.suppress(OSError):  # the reader finds the end by itself too
                os.ftruncate(file.fileno(), self._sound)
            _close(file)


class _Whole:
    """An unbuffered file that writes everything or raises: what is not on the disk is nowhere."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self.fileno = file.fileno
        self.close = file.close
        self.name = getattr(file, "name", "recording")
        self._position = 0

    def write(self, data: bytes) -> int:
        view = memoryview(data)
        while view:
            written = self._file.write(view)
            self._position += written
            view = view[written:]
        return len(data)

    def tell(self) -> int:
        return self._position

    def flush(self) -> None:
        """Nothing is buffered."""


def _create(path: Path) -> BinaryIO:
    return cast(BinaryIO, path.open("xb", buffering=0))


def _close(file: _Whole) -> None:
    with contextlib.suppress(OSError):
        file.close()
