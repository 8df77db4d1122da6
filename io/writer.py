"""Write a log: ROS 2 CDR in MCAP, one encoding per file, so that rosbag2, rosbags, evo, Foxglove and Rerun read it.

A file appears under its name only when it is whole; equal input gives equal bytes.
"""

import contextlib
import os
import struct
from collections.abc import Iterator, Mapping
from itertools import count
from pathlib import Path
from types import TracebackType
from typing import IO, Any, BinaryIO, Literal, Self

from mcap.writer import CompressionType, Writer

from ..factors.errors import LogError
from .schemas import schema, typestore

Compression = Literal["zstd", "lz4", "none"]
_COMPRESSION = {"zstd": CompressionType.ZSTD, "lz4": CompressionType.LZ4, "none": CompressionType.NONE}

# Quality of service as rosbag2 writes it. Static frames are latched (transient local), so that a replay shows them to
# late listeners; everything else is left to the player's defaults.
_LATCHED = """- history: 1
  depth: 1
  reliability: 1
  durability: 1
  deadline:
    sec: 0
    nsec: 0
  lifespan:
    sec: 0
    nsec: 0
  liveliness: 1
  liveliness_lease_duration:
    sec: 0
    nsec: 0
  avoid_ros_namespace_conventions: false"""


class McapSink:
    """A log being written; use as a context manager.

    Leaving the block in order finishes the file; leaving it by an exception removes what was written, and a file of
    that name that was there before stays as it was.

    Args:
        target: a path, or an open binary stream (a pipe or socket: pass `chunk_size=None` for low latency).
        chunk_size: bytes per chunk before compression; None writes every message at once, uncompressed.

    Raises:
        LogError: the file cannot be created or written (folder missing, no permission, disk full).
    """

    def __init__(
        self,
        target: Path | str | BinaryIO,
        *,
        profile: str = "ros2",
        compression: Compression = "zstd",
        chunk_size: int | None = 1 << 20,
    ) -> None:
        self._path = Path(target) if isinstance(target, str | Path) else None
        self._temporary: Path | None = None
        self._label = str(self._path or getattr(target, "name", "output stream"))
        self._channels: dict[str, tuple[int, str]] = {}
        self._schemas: dict[str, int] = {}
        self._sequences: dict[int, int] = {}
        self._closed = False
        with self._told():
            self._file = _Counting(self._create() if isinstance(target, str | Path) else target)
        self._writer = Writer(
            self._file,  # pyright: ignore[reportArgumentType]  # needs write, tell and flush, no more
            compression=_COMPRESSION[compression],
            chunk_size=chunk_size or 1,
            use_chunking=chunk_size is not None,
            enable_data_crcs=chunk_size is None,  # chunks have checksums of their own
        )
        try:
            with self._told():
                self._writer.start(profile=profile, library="surecut")
        except BaseException:
            self.abort()
            raise

    def write(self, topic: str, type_name: str, message: Any, log_time_ns: int) -> None:
        """Append one message (see `build`), of a type that `schemas.typestore` knows.

        Raises:
            LogError: one topic with two types, a message that does not fit its type, or the disk is full.
        """
        channel = self._channel(topic, type_name)
        try:
            data = bytes(typestore().serialize_cdr(message, type_name))
        except (struct.error, ValueError, TypeError, AttributeError, AssertionError) as error:
            raise LogError(f"{self._label}: a message for {topic} is no {type_name} ({error})") from error
        sequence = self._sequences.get(channel, 0)
        self._sequences[channel] = sequence + 1
        with self._told():
            self._writer.add_message(channel, log_time_ns, data, log_time_ns, sequence)

    def attach(self, name: str, media_type: str, data: bytes | str, log_time_ns: int = 0) -> None:
        """Add a file to the log, such as `rig.yaml`."""
        content = data.encode() if isinstance(data, str) else data
        with self._told():
            self._writer.add_attachment(log_time_ns, log_time_ns, name, media_type, content)

    def metadata(self, name: str, values: Mapping[str, str]) -> None:
        """Add a record of names and values."""
        with self._told():
            self._writer.add_metadata(name, dict(values))

    def flush(self) -> None:
        """Finish the chunk: what was written before survives a crash of this process and reaches a pipe's reader."""
        with self._told():
            self._writer.flush()

    def close(self) -> None:
        """Finish the file and give it its name. Nothing happens the second time."""
        if self._closed:
            return
        try:
            with self._told():
                self._writer.finish()
                self._file.flush()
                if self._path is not None and self._temporary is not None:
                    os.fsync(self._file.stream.fileno())
                    self._file.stream.close()
                    os.replace(self._temporary, self._path)
        except BaseException:
            self.abort()
            raise
        self._closed = True

    def abort(self) -> None:
        """Give up: remove what was written. A stream is left as it is."""
        self._closed = True
        if self._temporary is not None:
            with contextlib.suppress(OSError):
                self._file.stream.close()
            self._temporary.unlink(missing_ok=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        if kind is None:
            self.close()
        else:
            self.abort()

    def _channel(self, topic: str, type_name: str) -> int:
        known = self._channels.get(topic)
        if known is not None:
            if known[1] != type_name:
                raise LogError(f"{self._label}: topic {topic} holds {known[1]}, not {type_name}; use another topic")
            return known[0]
        try:
            definition = schema(type_name)
        except KeyError:
            raise LogError(f"{self._label}: there is no message type {type_name} (topic {topic})") from None
        with self._told():
            if type_name not in self._schemas:
                self._schemas[type_name] = self._writer.register_schema(type_name, "ros2msg", definition.text.encode())
            qos = _LATCHED if topic.endswith("tf_static") else ""
            metadata = {"offered_qos_profiles": qos, "topic_type_hash": definition.type_hash}
            channel = self._writer.register_channel(topic, "cdr", self._schemas[type_name], metadata)
        self._channels[topic] = (channel, type_name)
        return channel

    def _create(self) -> IO[bytes]:
        """A new file beside the target, in the same file system so that renaming it is one step."""
        assert self._path is not None
        for attempt in count():
            temporary = self._path.with_name(f".{self._path.name}.{os.getpid()}-{attempt}.part")
            with contextlib.suppress(FileExistsError):
                file = temporary.open("xb")
                self._temporary = temporary
                return file
        raise AssertionError

    @contextlib.contextmanager
    def _told(self) -> Iterator[None]:
        """File errors as one line."""
        try:
            yield
        except BrokenPipeError:
            raise
        except OSError as error:
            reason = error.strerror or str(error)
            kept = "; nothing was overwritten" if self._path is not None and self._path.exists() else ""
            raise LogError(
                f"{self._label}: cannot be written ({reason}); free space or choose another place{kept}"
            ) from error


class _Counting:
    """A stream that knows its position: pipes and sockets cannot tell theirs."""

    def __init__(self, stream: IO[bytes]) -> None:
        self.stream = stream
        self._position = 0

    def write(self, data: bytes) -> int:
        self.stream.write(data)
        self._position += len(data)
        return len(data)

    def tell(self) -> int:
        return self._position

    def flush(self) -> None:
        self.stream.flush()
