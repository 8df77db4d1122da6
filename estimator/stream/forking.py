"""How the processes of a stream are started: copies of one that has loaded everything they need, so that a stream is up
again within seconds of its death."""

import multiprocessing
from multiprocessing import forkserver
from multiprocessing.context import ForkServerContext, SpawnContext

from ..threads import single_threaded_children, use_one_thread

LOADED = ("track_process", "look_process", "graph_process")


Context = ForkServerContext | SpawnContext


def context() -> Context:
    """For processes and queues. Where the system cannot fork, each process loads for itself."""
    if not _forks():
        return multiprocessing.get_context("spawn")
    found = multiprocessing.get_context("forkserver")
    found.set_forkserver_preload([f"{__package__}.{name}" for name in LOADED])
    return found


def prepare() -> None:
    """Begins to load in the background; what the caller loads meanwhile costs no further time."""
    use_one_thread()
    if _forks():
        context()
        with single_threaded_children():
            forkserver.ensure_running()


def _forks() -> bool:
    return "forkserver" in multiprocessing.get_all_start_methods()
