"""The outlines of named pipes in pictures of keyframes: about a click at once, elsewhere once a pipe is known."""

from collections import defaultdict, deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import gtsam
import numpy as np
from numpy.typing import NDArray

from ..factors.measurements import OutlineSighting, Pick, Rejection
from ..frontends.pipe.pairs import OutlinePrior
from ..frontends.pipe.predict import part_in_sight, predict_outline
from ..frontends.pipe.silhouette import OutlineFinder, OutlineView, find_outlines
from .axis_spread import AxisSpread, axis_spread
from .engine import Engine
from .pipe_restart import begin_anew, clicked_places
from .pipe_widths import KeptView, PipeWidths
from .pipes import AXIS_ROLES, INSET_SHARE
from .sensors import PairImages

Float = NDArray[np.float64]

MOBILE = ("m_left", "m_right")
KEPT_BYTES = 120_000_000
"""Pictures of keyframes that are kept to look for a pipe's outline once it is known."""
OUTLINE_VIEWS = 16
"""Views per pipe and camera in which its outline is looked for: their errors are alike, more would not tell more."""
VIEWS_AT_ONCE = 4
"""Views that one call looks at, at most; the rest is for `go_on`, so that nobody has to wait long. The same for a
recording as in a stream, so that they answer alike: what is found later enters another estimate."""
OUTLINE_SPACING_M = 0.15
"""Views of a pipe nearer to each other than this tell nothing new."""
AXIS_SIGMA_M, DIRECTION_SIGMA_RAD = 0.006, 0.02
"""Sigmas with which the axis of a known pipe is looked for, at least."""
UNSURE = 2.0
"""Times these, across a view: there the pipe waits until more is known of it. Wrong edges would be found first, and
lead to others."""


@dataclass(frozen=True, slots=True)
class _View:
    """One picture in which a pipe's outline is to be looked for."""

    pipe: str
    camera: str
    pair: PairImages
    prior: OutlinePrior


@dataclass(slots=True)
class _Apart:
    """Views of one pipe by one camera that differ."""

    places: dict[int, Float] = field(default_factory=dict)
    """Where the camera stood, by stamp."""
    passed: set[int] = field(default_factory=set)
    """Stamps of views that are too near to one of these, or of no use."""


class OutlineSearch:
    """Keeps pictures, and looks for pipes in them where the engine's estimate says that they are."""

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        self._ahead: deque[_View] = deque()
        """Views that have been chosen and not looked at."""
        self._found: list[OutlineSighting | Rejection] = []
        """In those before them. They enter together, as if there had been no wait."""
        self._clicked = False
        """Is there a click that widths have not been measured with?"""
        self._at_last = False
        """Will nothing more be known of the pipes?"""
        self._spreads: dict[str, AxisSpread | None] = {}
        """How well axes are known at this look; None: not determined."""
        self._sure: set[str] = set()
        """Pipes whose axes are known better, from all sides, than they are looked for at best."""
        self._finders: dict[str, OutlineFinder] = {}
        self._widths = PipeWidths(engine)
        self._kept: deque[PairImages] = deque()
        self._kept_bytes = 0
        self._looked: defaultdict[tuple[str, str], _Apart] = defaultdict(_Apart)
        """Views whose outline was looked for, by pipe and camera."""
        self._shown: defaultdict[tuple[str, str], _Apart] = defaultdict(_Apart)
        """Views that show the pipe, likewise."""

    def see(self, pair: PairImages, picks: Sequence[Pick]) -> None:
        """A keyframe's pictures, and the clicks in them."""
        self._kept.append(pair)
        self._kept_bytes += pair.nbytes
        while self._kept_bytes > KEPT_BYTES or self._kept[0].stamp_ns not in self._engine.keyframe_at:
            self._kept_bytes -= self._kept.popleft().nbytes
        clicked = [pick for pick in picks if pick.role in AXIS_ROLES and pick.camera in MOBILE]
        anew = self._begin_anew_where_astray() if clicked else set()
        for pick in clicked:
            pipe = self._engine.pipes.pipe_of(pick.point_id)
            if pipe not in anew and self._widths.of(pipe) is None:
                self._about(pick, pair)
        if clicked:
            self._engine.flush()
            self._clicked = True
        if not self._ahead:
            self._look()
        self.go_on()

    def go_on(self, to_the_end: bool = False) -> None:
        """Looks at views that are chosen; where there are none, nothing happens."""
        number = len(self._ahead)
        if not to_the_end:
            number = min(number, VIEWS_AT_ONCE)
        views = [self._ahead.popleft() for _ in range(number)]
        self._found += find_outlines([self._outline_view(view) for view in views])
        if self._found and not self._ahead:
            for found in self._found:
                self._take(found)
            self._found.clear()
            self._engine.flush()
            self._enter_widths()

    def complete(self) -> None:
        """No more pictures will come: the widths with all that is known of the axes, and the edges by them."""
        self.go_on(to_the_end=True)
        self._begin_anew_where_astray()
        self._clicked = self._at_last = True
        self._look()
        self.go_on(to_the_end=True)

    def _begin_anew_where_astray(self) -> set[str]:
        """Pipes that clicks show elsewhere: what was found about them was something else. All their clicks are looked
        at again, this picture's too.

        Returns:
            Which ones.
        """
        engine, anew = self._engine, set[str]()
        for pipe in [pipe for pipe, cylinder in engine.pipes.cylinders.items() if cylinder.known]:
            engine.flush()
            places = clicked_places(engine, pipe)
            if not places:
                continue
            anew.add(pipe)
            begin_anew(engine, pipe, places)
            self._forget(pipe)
            pairs = {pair.stamp_ns: pair for pair in self._kept}
            for _, pick in engine.pipes.clicked:
                if pick.stamp_ns in pairs and pick.camera in MOBILE and engine.pipes.pipe_of(pick.point_id) == pipe:
                    self._about(pick, pairs[pick.stamp_ns])
            engine.flush()
        return anew

    def _forget(self, pipe: str) -> None:
        """All that has been found and chosen about a pipe."""
        self._ahead = deque(view for view in self._ahead if view.pipe != pipe)
        self._found = [one for one in self._found if isinstance(one, Rejection) or one.pipe_id != pipe]
        self._widths.forget(pipe)
        self._spreads.pop(pipe, None)
        self._sure.discard(pipe)
        for camera in MOBILE:
            self._looked[pipe, camera] = _Apart()
            self._shown[pipe, camera] = _Apart()

    def _look(self) -> None:
        """Measures widths, and chooses the views to look at."""
        pipes, anew = self._engine.pipes, self._clicked
        self._clicked = False
        self._spreads.clear()
        for pipe in pipes.named():
            ends = pipes.known_part(pipe)
            if ends is not None:
                self._measure_width(pipe, ends, anew)
                for camera in MOBILE:
                    self._choose(pipe, camera)
        self._enter_widths()

    def _enter_widths(self) -> None:
        for pipe in self._engine.pipes.named():
            self._widths.enter(pipe)

    def _measure_width(self, pipe: str, ends: tuple[Float, Float], anew: bool) -> None:
        if anew:
            for shown in self._shown.values():
                shown.passed.clear()
        views = [KeptView(pair, camera) for camera in MOBILE for pair in self._differing(pipe, camera, ends)]
        if self._widths.measure(pipe, ends, views, anew):
            # What was found without knowing the width is looked for again.
            stamps = {pair.stamp_ns for pair in self._kept}
            self._widths.forget_outlines(pipe, stamps)
            self._spreads.pop(pipe, None)
            self._sure.discard(pipe)
            for camera in MOBILE:
                looked = self._looked[pipe, camera]
                looked.places = {s: place for s, place in looked.places.items() if s not in stamps}
                looked.passed.clear()

    def _differing(self, pipe: str, camera: str, ends: tuple[Float, Float]) -> list[PairImages]:
        """Kept pictures that show a part of a pipe, each from somewhere else."""
        shown, model = self._shown[pipe, camera], self._engine.cameras[camera]
        for pair, o_T_c in self._elsewhere(shown, camera):
            if part_in_sight(model, *(o_T_c.transformTo(end) for end in ends)):
                shown.places[pair.stamp_ns] = o_T_c.translation()
            else:
                shown.passed.add(pair.stamp_ns)
        return [pair for pair in self._kept if pair.stamp_ns in shown.places]

    def _elsewhere(self, views: _Apart, camera: str) -> Iterator[tuple[PairImages, gtsam.Pose3]]:
        """Kept pictures from somewhere else than the views that are there, and `o_T_c`; whoever takes one enters it."""
        for pair in [p for p in self._kept if p.stamp_ns not in views.places and p.stamp_ns not in views.passed]:
            if len(views.places) >= OUTLINE_VIEWS:
                return
            where = self._engine.seen_from(camera, pair.stamp_ns)
            if where is None:
                continue
            if _near(where.o_T_c.translation(), views.places):
                views.passed.add(pair.stamp_ns)
            else:
                yield pair, where.o_T_c

    def _about(self, pick: Pick, pair: PairImages) -> None:
        """The outline about a click."""
        pipe = self._engine.pipes.pipe_of(pick.point_id)
        click = float(np.sqrt(pick.covariance_px2.trace() / 2))
        prior = OutlinePrior(pick.px, click)
        self._take(self._finder(pick.camera).find(pair.stamp_ns, pipe, pair.of(pick.camera), prior))
        where = self._engine.seen_from(pick.camera, pair.stamp_ns)
        if where is not None:
            self._looked[pipe, pick.camera].places[pair.stamp_ns] = where.o_T_c.translation()

    def _choose(self, pipe: str, camera: str) -> None:
        """Views for a known pipe's outline that differ from those already used."""
        expected = self._expected(pipe)
        if expected is None:
            return
        ends, radius, radius_sigma = expected
        looked, model = self._looked[pipe, camera], self._engine.cameras[camera]
        for pair, o_T_c in self._elsewhere(looked, camera):
            a, b = (o_T_c.transformTo(end) for end in ends)
            sigma = radius_sigma or unmeasured_sigma(radius, 0.5 * float(a[2] + b[2]), model.fx)
            prior = predict_outline(model, a, b, radius, AXIS_SIGMA_M, DIRECTION_SIGMA_RAD, sigma)
            if prior is None:
                continue
            across = self._sigmas_across(pipe, o_T_c.translation(), ends)
            if across is None:
                continue
            prior = predict_outline(model, a, b, radius, *across, sigma)
            if prior is not None:
                looked.places[pair.stamp_ns] = o_T_c.translation()
                self._ahead.append(_View(pipe, camera, pair, prior))

    def _sigmas_across(self, pipe: str, camera: Float, part: tuple[Float, Float]) -> tuple[float, float] | None:
        """Sigmas of an axis's place (m) and direction (rad) with which it is looked for; None where it had better wait.

        Args:
            camera: place of the camera in {o}.
        """
        least = AXIS_SIGMA_M, DIRECTION_SIGMA_RAD
        if pipe in self._sure or self._engine.pipes.axis(pipe) is None:  # then two clicks and a width place it
            return least
        if pipe not in self._spreads:
            self._spreads[pipe] = axis_spread(self._engine, pipe)
        spread = self._spreads[pipe]
        if spread is None:
            return None
        if np.less(spread.worst(part), least).all():
            self._sure.add(pipe)
        across = spread.across(camera, part)
        if not self._at_last and np.greater(across, UNSURE * np.array(least)).any():
            return None
        return max(across[0], least[0]), max(across[1], least[1])

    def _expected(self, pipe: str) -> tuple[tuple[Float, Float], float, float] | None:
        """Part of the axis, radius and the radius's sigma (0: not measured), with which outlines are looked for."""
        width, axis = self._widths.of(pipe), self._engine.pipes.axis(pipe)
        ends = self._engine.pipes.known_part(pipe)
        if ends is None or (axis is None and width is None):
            return None
        if axis is not None and width is None:
            return ends, axis[2], 0.0
        assert width is not None
        if axis is None:
            ends = ends[0] + width.offset_m, ends[1] + width.offset_m
        return ends, width.radius_m, width.sigma_m

    def _take(self, found: OutlineSighting | Rejection) -> None:
        if isinstance(found, OutlineSighting):
            self._engine.add_outline(found)
        else:
            self._engine.rejected.append(found)

    def _outline_view(self, view: _View) -> OutlineView:
        image, finder = view.pair.of(view.camera), self._finder(view.camera)
        return OutlineView(finder, view.pair.stamp_ns, view.pipe, image, view.prior)

    def _finder(self, camera: str) -> OutlineFinder:
        if camera not in self._finders:
            self._finders[camera] = OutlineFinder(self._engine.cameras[camera])
        return self._finders[camera]


def unmeasured_sigma(radius_m: float, range_m: float, focal_px: float) -> float:
    """Sigma of a radius that nothing but edges has shown: they may lie within the pipe, and are a pixel wide."""
    return float(np.hypot(INSET_SHARE * radius_m, range_m / focal_px))


def _near(place: Float, others: dict[int, Float]) -> bool:
    if not others:
        return False
    return bool((np.linalg.norm(place - np.array([*others.values()]), axis=1) < OUTLINE_SPACING_M).any())
