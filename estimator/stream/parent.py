"""A child process ends with its parent, however that ended: a killed parent cannot tell."""

import multiprocessing
import os
import threading


def end_with_parent() -> None:
    """Call once in the child."""
    parent = multiprocessing.parent_process()
    if parent is None:
        return

    def watch() -> None:
        parent.join()
        os._exit(0)  # queues may be full, and nobody is left to read them

    threading.Thread(target=watch, name="surecut-parent", daemon=True).start()
