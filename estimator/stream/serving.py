"""The life of a front end's process: what comes is taken, and orders are handed on."""

import traceback
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import Any

import cv2

from ...factors.rig import Rig
from ...frontends.stereo.atlas import Atlas
from ...io.messages import Message
from ..sensing import Sensing
from .parent import end_with_parent, give_way, keep_loaded
from .settings import StreamSettings
from .thinning import Thinning
from .wire import Died, Order, Ready


class FrontEnd(ABC):
    """What does the work.

    Args:
        patient: nothing may be left out, however long it takes.
        onward: queue of the next process.
        out: line to the parent.
        calibrations: messages by topic that a fresh start has to be told again.
        atlas: what an earlier run saw.
    """

    def __init__(
        self,
        rig: Rig,
        settings: StreamSettings,
        patient: bool,
        onward: Any,
        out: Any,
        calibrations: Mapping[str, Message] | None = None,
        atlas: Atlas | None = None,
    ) -> None:
        self._settings = settings
        self._sensing = Sensing(rig, atlas)
        self._thinning = Thinning(onward, settings, patient)
        self._onward = onward
        self._out = out
        self.calibrations = dict(calibrations or {})
        self._sensing.calibrate([*self.calibrations.values()])

    @abstractmethod
    def take(self, item: Any, /) -> None:
        """One item of the queue; whatever is wrong with it is told."""


def serve(
    who: str,
    niceness: int,
    made: Callable[[Mapping[str, Message]], FrontEnd],
    inbox: Any,
    onward: Any,
    out: Any,
) -> None:
    """Until the order to finish. `inbox` and `onward` are queues between processes, `out` the line to the parent.

    Args:
        made: a front end that begins, told the calibrations that are known.
    """
    end_with_parent()
    keep_loaded()
    give_way(niceness)
    cv2.setNumThreads(1)
    try:
        loop = made({})
        out.put(Ready(who))
        while True:
            item = inbox.get()
            if not isinstance(item, Order):
                loop.take(item)
                continue
            onward.put(item)
            if item.what == "finish":
                return
            if item.what == "reset":
                loop = made(loop.calibrations)
    except Exception:
        out.put(Died(who, traceback.format_exc()))
