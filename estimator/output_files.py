"""Files that appear only when they are whole."""

import os
from pathlib import Path

from ..factors.errors import SurecutError


def write_text(path: Path, text: str) -> None:
    """Write a file; one that was there stays as it was unless the new one is whole.

    Raises:
        SurecutError: the folder is missing, no permission, or the disk is full.
    """
    write_bytes(path, text.encode())


def write_bytes(path: Path, data: bytes) -> None:
    """As `write_text`."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        with temporary.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        raise SurecutError(
            f"{path}: cannot be written ({error.strerror or error}); free space or choose another place"
        ) from error
