"""What happens to memory that is free again."""

import contextlib
import ctypes

_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3
"""Parameters of the GNU C library's `mallopt`."""
_LARGEST = 32 << 20
"""Arrays up to so many bytes come from the heap: the most that the library takes."""
_KEPT = 256 << 20


def keep_freed_memory() -> None:
    """This process and its copies keep freed memory for the next array, where the C library can be told to.

    Else every picture's memory goes back to the system, which clears it page by page for the next picture: a quarter of
    the time that a recording takes in the system. Not for processes that live long, whose memory others may want.
    """
    with contextlib.suppress(AttributeError, OSError, TypeError):
        library = ctypes.CDLL(None)
        library.mallopt(_MMAP_THRESHOLD, _LARGEST)
        library.mallopt(_TRIM_THRESHOLD, _KEPT)
