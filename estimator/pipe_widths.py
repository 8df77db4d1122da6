"""A pipe's width from the texture beside it in all kept views: known before its edges are looked for in any of them."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..factors.measurements import Event, Rejection
from ..frontends.pipe.texture_width import FEWEST_VIEWS, PipeView, TextureWidth, width_by_texture
from .engine import Engine
from .graph import Update
from .pipes import OUTLINE, WIDTH
from .sensors import PairImages

Float = NDArray[np.float64]

MORE_VIEWS = 1.5
"""So many times the views since the last measurement make another one worth while."""
WIDER_SIGMA = 3.0
"""An outline that texture contradicts by more is told of."""


@dataclass(frozen=True, slots=True)
class KeptView:
    """A kept picture in which a pipe should be seen."""

    pair: PairImages
    camera: str


class PipeWidths:
    """Measures widths anew as views come in, and keeps the graph's factor up to date."""

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        self._found: dict[str, TextureWidth] = {}
        self._views: dict[str, int] = {}
        """Views at the last measurement, found or not."""
        self._entered: dict[str, TextureWidth] = {}
        """What the graph holds."""

    def of(self, pipe: str) -> TextureWidth | None:
        """The width as it is known now."""
        return self._found.get(pipe)

    def measure(self, pipe: str, ends: tuple[Float, Float], kept: Sequence[KeptView], anew: bool) -> bool:
        """Measures a pipe's width if there are enough new views.

        Args:
            ends: of the part of its axis to look at, {o}.
            anew: measure with the same views too: the axis is known better.

        Returns:
            True where it has become known just now, or is another one than before: edges that were found without it
            want another look.
        """
        before = self._views.get(pipe, 0)
        if len(kept) < max(FEWEST_VIEWS, 0.0 if anew else MORE_VIEWS * before):
            return False
        self._views[pipe] = len(kept)
        found = width_by_texture([view for one in kept if (view := self._view(one, ends)) is not None])
        if found is None or self._narrower_than_edges(pipe, found):
            return False
        known = self._found.get(pipe)
        self._found[pipe] = found
        return known is None or abs(found.radius_m - known.radius_m) > np.hypot(found.sigma_m, known.sigma_m)

    def _narrower_than_edges(self, pipe: str, found: TextureWidth) -> bool:
        """Do edges that several views agree on lie outside a width? Then something on the pipe is restless, such as a
        label or a shadow: edges of something else would have to move with the pipe from view to view."""
        engine = self._engine
        axis = engine.pipes.axis(pipe)
        if axis is None or engine.pipes.cylinders[pipe].outlines < FEWEST_VIEWS:
            return False
        return axis[2] - found.radius_m > WIDER_SIGMA * found.sigma_m

    def _view(self, kept: KeptView, ends: tuple[Float, Float]) -> PipeView | None:
        where = self._engine.seen_from(kept.camera, kept.pair.stamp_ns)
        if where is None:
            return None
        a, b = (where.o_T_c.transformTo(end) for end in ends)
        camera = self._engine.cameras[kept.camera]
        return PipeView(kept.pair.of(kept.camera), camera, a, b, where.o_T_c.rotation().matrix())

    def forget(self, pipe: str) -> None:
        """It has left the graph: its width is measured anew."""
        for known in (self._found, self._views, self._entered):
            known.pop(pipe, None)

    def enter(self, pipe: str) -> None:
        """The present width into the graph, in the place of an earlier one."""
        found = self._found.get(pipe)
        if found is None or found is self._entered.get(pipe):
            return
        update = self._engine.pipes.width(pipe, found.radius_m, found.sigma_m, self._engine.end_ns)
        if not update.empty():
            self._entered[pipe] = found
            self._exchange(update, self._places(WIDTH, pipe))

    def forget_outlines(self, pipe: str, stamps: Iterable[int]) -> None:
        """Outlines that were found before the width was known, in pictures that can be looked at again."""
        engine, found = self._engine, self._found[pipe]
        again = set(stamps)
        gone = [(where, seen) for where, seen in engine.pipes.outlined_of(pipe) if seen.stamp_ns in again]
        if not gone:
            return
        axis = engine.pipes.axis(pipe)
        engine.pipes.take_back(pipe, again)
        self._exchange(Update(), self._places(OUTLINE, pipe, again))
        if axis is None:
            return
        off = (found.radius_m - axis[2]) / found.sigma_m
        if abs(off) > WIDER_SIGMA:
            text = (
                f"the first edges of {pipe} lie {1e3 * abs(found.radius_m - axis[2]):.0f} mm "
                f"{'within' if off > 0 else 'outside'} its outline, as the texture beside it shows in {found.views} "
                "views; they were looked for again"
            )
            engine.events.append(Event(engine.end_ns, "edges_within_pipe", text, "info", {"sigma": abs(off)}))
            engine.rejected += [
                Rejection(
                    seen.stamp_ns, OUTLINE, f"first outline of {pipe} in {seen.camera}",
                    "off the width that texture shows, sigmas", abs(off), WIDER_SIGMA,
                )
                for _, seen in gone
            ]  # fmt: skip

    def _places(self, family: str, pipe: str, stamps: set[int] | None = None) -> list[int]:
        """Places of a pipe's factors in the log."""
        return [
            index
            for index, _, record in self._engine.solver.log.active()
            if record.family == family and pipe in record.what.split() and (stamps is None or record.stamp_ns in stamps)
        ]

    def _exchange(self, update: Update, remove: list[int]) -> None:
        engine = self._engine
        engine.flush()
        engine.state.values = engine.solver.update(update, remove)
