"""What the processes of a stream do for each other: they end with their parent, and let others go first."""

import ctypes
import gc
import multiprocessing
import os
import signal
import threading

LOOK_NICE, GRAPH_NICE = 5, 10
"""Niceness: the pose of the camera goes before markers and surfaces, and these before the graph."""


def end_with_parent() -> None:
    """Call once in the child: a parent that was killed cannot tell."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a keyboard tells all of them; the parent ends the others in order
    parent = multiprocessing.parent_process()
    if parent is None:
        return

    def watch() -> None:
        parent.join()
        os._exit(0)  # queues may be full, and nobody is left to read them

    threading.Thread(target=watch, name="surecut-parent", daemon=True).start()


def keep_loaded() -> None:
    """Call once all modules are loaded: what they hold stays, and looking through it for garbage would stop a pose for
    a tenth of a second."""
    gc.collect()
    gc.freeze()


def give_back() -> None:
    """Call after a large piece of work: memory that is free goes back to the system, where the C library can do that
    (glibc), so that what is resident is what is used."""
    try:
        ctypes.CDLL(None).malloc_trim(0)
    except (AttributeError, OSError, TypeError):  # another C library
        return


def give_way(niceness: int) -> None:
    """Call once in the child: others on the same cores go first."""
    try:
        os.nice(niceness)
    except (AttributeError, OSError):  # where there is no niceness, all are alike
        return
