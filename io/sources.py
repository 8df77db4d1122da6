"""Where a recording's bytes come from: a file, the files of a rosbag2 folder, a URL, a pipe."""

import contextlib
import importlib
import importlib.util
import re
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO, cast

import yaml
import zstandard
from mcap.records import Attachment

from ..factors.errors import LogError
from .records import Record, RecordStream
from .summary import EMPTY, Summary, find_attachment, read_summary


class Part:
    """One MCAP file or stream of a recording.

    Args:
        path: a file, opened anew for each reading; None for `stream`, which can be read once.
    """

    def __init__(self, label: str, path: Path | None, stream: BinaryIO | None = None) -> None:
        self.label = label
        self.path = path
        self._stream = stream
        self._records: RecordStream | None = None
        self._hash: str | None = None

    @property
    def seekable(self) -> bool:
        """Whether one may jump in it: a plain file."""
        return self.path is not None and self.path.suffix != ".zstd"

    def records(self) -> Iterator[Record]:
        """The records from the start of a file, from where it is of a stream.

        Raises:
            LogError: it cannot be read, or is no MCAP.
        """
        with self._opened() as file:
            size = self.path.stat().st_size if self.path is not None and self.seekable else None
            self._records = RecordStream(file, self.label, size, self.summary().has_data_crc)
            try:
                yield from self._records
                if self._stream is None:
                    self._hash = self._records.sha256()
            except (OSError, zstandard.ZstdError) as error:
                raise LogError(f"{self.label}: cannot be read ({error}); copy it again") from error

    def warning(self) -> str | None:
        """What the last reading found damaged, in one line."""
        return self._records.report.line() if self._records is not None else None

    def summary(self) -> Summary:
        """Descriptions from the end of a file, empty where there are none."""
        if not self.seekable or self.path is None:
            return EMPTY
        with self.path.open("rb") as file:
            return read_summary(file)

    def attachment(self, name: str) -> Attachment | None:
        """An attachment of a plain file, without reading its messages."""
        if not self.seekable or self.path is None:
            return None
        try:
            with self.path.open("rb") as file:
                return find_attachment(file, name)
        except OSError as error:
            raise _unreadable(self.label, error) from error

    def sha256(self) -> str:
        """Hash of the (uncompressed) file; of a stream that of all its bytes, what is left of it included."""
        if self._stream is not None:
            self._records = self._records or RecordStream(self._stream, self.label)
            return self._records.sha256()
        if self._hash is None:
            with self._opened() as file:
                self._hash = RecordStream(file, self.label).sha256()
        return self._hash

    @contextlib.contextmanager
    def _opened(self) -> Iterator[BinaryIO]:
        """A file is closed after use, a stream is left to whom it belongs."""
        if self._stream is not None:
            yield self._stream
            return
        assert self.path is not None
        try:
            file = self.path.open("rb")
        except OSError as error:
            raise _unreadable(self.label, error) from error
        with file:
            if self.path.suffix == ".zstd":
                with zstandard.ZstdDecompressor().stream_reader(file, read_across_frames=True) as stream:
                    yield cast(BinaryIO, stream)
            else:
                yield file


def parts_of(source: Path | str | BinaryIO) -> list[Part]:
    """The files of a recording in their order.

    Raises:
        LogError: there is no such file, or a folder without a recording.
    """
    if not isinstance(source, Path | str):
        return [Part(str(getattr(source, "name", "input stream")), None, source)]
    if "://" in str(source):
        return [Part(str(source), None, _url(str(source)))]
    path = Path(source)
    try:
        if path.is_dir():
            return [Part(str(part), part) for part in _folder(path)]
        with path.open("rb"):
            pass
    except OSError as error:
        raise _unreadable(str(path), error) from error
    return [Part(str(path), path)]


def _folder(path: Path) -> list[Path]:
    """The recording's files in the order of `metadata.yaml`; without one, by the numbers in their names."""
    metadata = path / "metadata.yaml"
    names: list[str] = []
    if metadata.exists():
        try:
            names = list(yaml.safe_load(metadata.read_bytes())["rosbag2_bagfile_information"]["relative_file_paths"])
        except (yaml.YAMLError, UnicodeDecodeError, KeyError, TypeError) as error:
            raise LogError(
                f"{metadata}: is no description of a rosbag2 recording; remove it to read all files"
            ) from error
    found = [path / Path(str(name)).name for name in names] or sorted(
        [*path.glob("*.mcap"), *path.glob("*.mcap.zstd")], key=_natural
    )
    if not found:
        raise LogError(f"{path}: holds no .mcap file; give a recorded log")
    other = [part.name for part in found if not part.name.endswith((".mcap", ".mcap.zstd"))]
    if other:
        raise LogError(f"{path}: {other[0]} is no MCAP file; convert the recording with `ros2 bag convert`")
    missing = [part.name for part in found if not part.exists()]
    if missing:
        raise LogError(
            f"{path}: {missing[0]} is named in metadata.yaml and is not there; copy all files of the recording"
        )
    return found


def _natural(path: Path) -> list[tuple[int, str]]:
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", path.name)]


def _url(url: str) -> BinaryIO:
    if importlib.util.find_spec("fsspec") is None:
        raise LogError(f"{url}: reading URLs needs the package fsspec; install it, or copy the log here")
    fsspec = importlib.import_module("fsspec")  # optional

    try:
        return fsspec.open(url, "rb").open()
    except Exception as error:  # each protocol raises its own
        raise LogError(f"{url}: cannot be opened ({error})") from error


def _unreadable(label: str, error: OSError) -> LogError:
    return LogError(f"{label}: cannot be read ({error.strerror or error}); give a recorded .mcap log")
