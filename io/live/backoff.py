"""How long to wait before a link is tried again."""

import threading


class Backoff:
    """Twice as long each time, up to a bound; from the start again after a success."""

    def __init__(self, first_s: float = 0.25, longest_s: float = 5.0) -> None:
        self._first_s = first_s
        self._longest_s = longest_s
        self._next_s = first_s

    def wait(self, stopping: threading.Event) -> bool:
        """Wait; True when it was ended by `stopping`."""
        waited_s, self._next_s = self._next_s, min(2 * self._next_s, self._longest_s)
        return stopping.wait(waited_s)

    def succeeded(self) -> None:
        """The link stood."""
        self._next_s = self._first_s
