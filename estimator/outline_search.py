"""The outlines of named pipes in pictures of keyframes: about a click at once, elsewhere once a pipe is known."""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..factors.measurements import OutlineSighting, Pick, Rejection
from ..frontends.pipe.pairs import OutlinePrior
from ..frontends.pipe.predict import predict_outline
from ..frontends.pipe.silhouette import OutlineFinder
from .engine import Engine
from .pipes import AXIS_ROLES
from .sensors import PairImages

Float = NDArray[np.float64]

MOBILE = ("m_left", "m_right")
KEPT_BYTES = 120_000_000
"""Pictures of keyframes that are kept to look for a pipe's outline once it is known."""
OUTLINE_VIEWS = 16
"""Views per pipe and camera in which its outline is looked for: their errors are alike, more would not tell more."""
OUTLINE_SPACING_M = 0.15
"""Views of a pipe nearer to each other than this tell nothing new."""
OUTLINE_PRIOR = (0.006, 0.02, 0.004)
"""Sigmas of axis [m], direction [rad] and radius [m] with which a known pipe's outline is looked for. The radius's is
measured, not derived: with half, three quarters and one pixel at the pipe's range edges within the pipe took its
outline's place in one of twenty rendered recordings, see docs/kinect.md."""
PART_M = 0.1
"""A pipe is taken to go on so far beyond its picks."""


@dataclass(frozen=True, slots=True)
class _View:
    """One picture in which a pipe's outline is to be looked for."""

    pipe: str
    camera: str
    pair: PairImages
    prior: OutlinePrior


class OutlineSearch:
    """Keeps pictures, and looks for pipes in them where the engine's estimate says that they are."""

    def __init__(self, engine: Engine, views_at_once: int | None = None) -> None:
        """
        Args:
            views_at_once: views of known pipes that one call looks at, at most; the rest is for `go_on`, so that nobody
                has to wait long. None for all.
        """
        self._engine = engine
        self._at_once = views_at_once
        self._ahead: deque[_View] = deque()
        """Views that have been chosen and not looked at."""
        self._found: list[OutlineSighting | Rejection] = []
        """In those before them. They enter together, as if there had been no wait."""
        self._finders: dict[str, OutlineFinder] = {}
        self._kept: deque[PairImages] = deque()
        self._kept_bytes = 0
        self._looked: dict[str, dict[int, Float]] = {}
        """Where the camera stood in views whose outline was looked for, by pipe and camera, and stamp."""
        self._passed: dict[str, set[int]] = {}
        """Stamps of views too near to one of these."""

    def see(self, pair: PairImages, picks: Sequence[Pick]) -> None:
        """A keyframe's pictures, and the clicks in them."""
        self._kept.append(pair)
        self._kept_bytes += pair.nbytes
        while self._kept_bytes > KEPT_BYTES or self._kept[0].stamp_ns not in self._engine.keyframe_at:
            self._kept_bytes -= self._kept.popleft().nbytes
        clicked = [pick for pick in picks if pick.role in AXIS_ROLES and pick.camera in MOBILE]
        for pick in clicked:
            self._about(pick, pair)
        if clicked:
            self._engine.flush()
        if not self._ahead:
            for pipe in list(self._engine.pipes.cylinders):
                axis = self._engine.pipes.axis(pipe)
                if axis is not None:
                    for camera in MOBILE:
                        self._choose(pipe, axis, camera)
        self.go_on()

    def go_on(self, to_the_end: bool = False) -> None:
        """Looks at views that are chosen; where there are none, nothing happens."""
        number = len(self._ahead)
        if self._at_once is not None and not to_the_end:
            number = min(number, self._at_once)
        for _ in range(number):
            view = self._ahead.popleft()
            finder = self._finder(view.camera)
            self._found.append(finder.find(view.pair.stamp_ns, view.pipe, view.pair.of(view.camera), view.prior))
        if self._found and not self._ahead:
            for found in self._found:
                self._take(found)
            self._found.clear()
            self._engine.flush()

    def _about(self, pick: Pick, pair: PairImages) -> None:
        """The outline about a click."""
        pipe = self._engine.pipes.pipe_of(pick.point_id)
        click = float(np.sqrt(pick.covariance_px2.trace() / 2))
        prior = OutlinePrior(pick.px, click)
        self._take(self._finder(pick.camera).find(pair.stamp_ns, pipe, pair.of(pick.camera), prior))
        where = self._engine.seen_from(pick.camera, pair.stamp_ns)
        if where is not None:
            looked = self._looked.setdefault(f"{pipe} {pick.camera}", {})
            looked[pair.stamp_ns] = where.o_T_c.translation()

    def _choose(self, pipe: str, axis: tuple[Float, Float, float], camera: str) -> None:
        """Views for a known pipe's outline that differ from those already used."""
        looked = self._looked.setdefault(f"{pipe} {camera}", {})
        passed = self._passed.setdefault(f"{pipe} {camera}", set())
        ends = _part_of_axis(self._engine.pipes.places(pipe), axis)
        for pair in [kept for kept in self._kept if kept.stamp_ns not in looked and kept.stamp_ns not in passed]:
            if len(looked) >= OUTLINE_VIEWS:
                break
            where = self._engine.seen_from(camera, pair.stamp_ns)
            if where is None:
                continue
            place = where.o_T_c.translation()
            if looked and (np.linalg.norm(place - np.array([*looked.values()]), axis=1) < OUTLINE_SPACING_M).any():
                passed.add(pair.stamp_ns)
                continue
            a, b = (where.o_T_c.transformTo(end) for end in ends)
            prior = predict_outline(self._engine.cameras[camera], a, b, axis[2], *OUTLINE_PRIOR)
            if prior is not None:
                looked[pair.stamp_ns] = place
                self._ahead.append(_View(pipe, camera, pair, prior))

    def _take(self, found: OutlineSighting | Rejection) -> None:
        if isinstance(found, OutlineSighting):
            self._engine.add_outline(found)
        else:
            self._engine.rejected.append(found)

    def _finder(self, camera: str) -> OutlineFinder:
        if camera not in self._finders:
            self._finders[camera] = OutlineFinder(self._engine.cameras[camera])
        return self._finders[camera]


def _part_of_axis(places: list[Float], axis: tuple[Float, Float, float]) -> tuple[Float, Float]:
    """The part of an axis about the picked points, in {o}."""
    direction = (axis[1] - axis[0]) / np.linalg.norm(axis[1] - axis[0])
    along = [float((p - axis[0]) @ direction) for p in places] or [0.0]
    return axis[0] + (min(along) - PART_M) * direction, axis[0] + (max(along) + PART_M) * direction
