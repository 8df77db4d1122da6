"""When a recording begins and ends, from its summary, without reading it through."""

import struct
from pathlib import Path

from mcap.exceptions import McapError
from mcap.reader import make_reader


def time_range(log: Path) -> tuple[int, int] | None:
    """First and last log time in ns; None where there is no summary (a stream, a damaged or a split recording)."""
    if not log.is_file():
        return None
    try:
        with log.open("rb") as stream:
            summary = make_reader(stream).get_summary()
    except (McapError, struct.error, UnicodeDecodeError, ValueError, OSError, KeyError):
        return None
    if summary is None or summary.statistics is None:
        return None
    return summary.statistics.message_start_time, summary.statistics.message_end_time
