"""A run without end: keyframes beyond a limit leave the graph, and what they said about the rest stays as one prior.

{b}, {f}, boards, points, pipes, calibration and the landmarks that may be seen again live on. So the cost of an update
does not grow with the time that the run has taken.
"""

from collections import Counter
from collections.abc import Callable, Collection
from dataclasses import dataclass, field

import gtsam

from ..factors import keys
from ..factors.measurements import Rejection
from .batch import MINIMUM_VIEWS, orphans, outliers
from .engine import Engine
from .incremental import Cut
from .limits import Limits
from .linearised import linearise
from .marginal import FAMILY
from .observability import Undetermined
from .refusals import lists_of_rejections
from .run_away import run_away


@dataclass(slots=True)
class Bounded:
    """Keeps one engine within limits."""

    engine: Engine
    limits: Limits = field(default_factory=Limits)
    leaving: Callable[[Collection[int]], object] = lambda keyframes: None
    """Told of keyframes, by index, while the engine has them still."""
    first: int = 0
    """Index of the oldest keyframe in the graph."""
    refused: Counter[str] = field(default_factory=Counter)
    """All refused measurements whose words were dropped, by family."""
    rebuilt: int = 0
    _next: int | None = None
    """Keyframes before it leave next; their outliers are out already."""

    def tidy(self) -> bool:
        """After each bundle; True when keyframes have left the graph.

        The work is done in two parts, at successive bundles: nobody has to wait for both.
        """
        engine = self.engine
        if self._next is not None:
            first, self._next = self._next, None
            engine.flush()
            self._forget(first)
            return True
        count = engine.odometry.last_keyframe + 1 - self.first
        if count <= self.limits.keyframes:
            return False
        engine.flush()
        self._next = engine.odometry.last_keyframe + 1 - self.limits.keyframes + self.limits.step
        self._without_outliers(self._poses(self._next))
        return False

    def _poses(self, first: int) -> set[int]:
        """Keyframes before `first`, but for those on which something hangs that has not entered yet.

        Nor those that are adrift, unless they are too many: what has left cannot be turned by a radian any more.
        """
        engine = self.engine
        every = {k for k in engine.state.values.keys() if keys.kind(k) == "x"}
        adrift = {k for k in every if engine.adrift.holds(k)}
        held = engine.held_keyframes() | (adrift if len(adrift) <= self.limits.keyframes else set())
        return {k for k in every - held if keys.index(k) < first}

    def _forget(self, first: int) -> None:
        """All keyframes before `first` leave that can."""
        engine = self.engine
        poses = self._poses(first)
        if not poses:
            return
        self.leaving({keys.index(k) for k in poses})
        landmarks = self._landmarks_of(poses)
        cut = self._reduced(Cut(poses | landmarks.gone, landmarks.lonely, landmarks.split))
        self.refused_landmarks(cut.dropped)
        self.first = first
        self.rebuilt += 1
        engine.forget(cut.leaving | cut.dropped)
        self._shorten()

    def _reduced(self, cut: Cut) -> Cut:
        """Takes out what leaves; a landmark that turns out to be determined by nothing is given up with its views.

        Raises:
            ObservabilityError: something else than a landmark is not determined.
        """
        while True:
            try:
                self.engine.state.values = self.engine.solver.reduce(cut, self.engine.end_ns)
                return cut
            except Undetermined as error:
                smaller = cut.giving_up(error.key)
                if smaller is None or smaller.dropped == cut.dropped:
                    raise
                cut = smaller

    def _without_outliers(self, poses: set[int]) -> None:
        """What noise does not explain is not put into the prior, which nobody can take apart again; nor what is left
        of landmarks that are no points without it."""
        if not poses:
            return
        engine = self.engine
        log = engine.solver.log
        at = linearise(log, (), engine.solver.values(), engine.rig.gates.robust_sigma)
        mine = [(i, told) for i, told in outliers(at) if poses.intersection(log.factors[i].keys())]
        mine += [(i, told) for i, told in orphans(at, {i for i, _ in mine}) if log.records[i].family != FAMILY]
        log.off.update(i for i, _ in mine)
        engine.rejected += [told for _, told in mine]

    def _landmarks_of(self, poses: set[int]) -> "_Landmarks":
        """Landmarks that only these keyframes saw: those that go, and those without views enough to be points, or
        that have run away, wherever these are."""
        inside: Counter[int] = Counter()
        outside: Counter[int] = Counter()
        every: set[int] = set()
        bound: set[int] = set()
        """On a surface of the Kinect's: those factors know their variables by name."""
        for _, factor, record in self.engine.solver.log.active():
            involved = factor.keys()
            marks = [k for k in involved if keys.kind(k) == "l"]
            every.update(marks)
            if record.family == FAMILY:
                inside.update(dict.fromkeys(marks, MINIMUM_VIEWS))
            elif record.camera is not None and marks:
                (inside if poses.intersection(involved) else outside).update(marks)
            if isinstance(factor, gtsam.CustomFactor):
                bound.update(marks)
        seen = {k for k in every if not outside[k]}
        lonely = {k for k in every - bound if inside[k] + outside[k] < MINIMUM_VIEWS}
        lonely |= {k for k in seen if inside[k] < MINIMUM_VIEWS}
        lonely |= {k for k in self.engine.state.values.keys() if keys.kind(k) == "l" and k not in every}
        lonely |= run_away(self.engine.state)
        views = self.engine.odometry.observations
        known = sorted(seen - lonely, key=lambda k: -views.get(keys.index(k), 0))
        both = [k for k in every - seen - lonely if inside[k] >= MINIMUM_VIEWS and k not in bound]
        both.sort(key=lambda k: -(inside[k] * outside[k]))
        split = {k for k in both[self.limits.shared_landmarks :] if outside[k] >= MINIMUM_VIEWS}
        return _Landmarks(set(known[self.limits.map_landmarks :]), lonely, split)

    def refused_landmarks(self, lonely: set[int]) -> None:
        """Tells of the views that go with landmarks that are no points."""
        if lonely:
            stamp = self.engine.end_ns
            text = f"views of {len(lonely)} landmarks"
            reason = "landmarks with too few good views, or beyond what a pair can tell; views"
            self.engine.rejected.append(Rejection(stamp, "stereo odometry", text, reason, 1.0, MINIMUM_VIEWS))

    def _shorten(self) -> None:
        """Lists that only tell keep their newest entries."""
        engine, most = self.engine, self.limits.told
        for told in lists_of_rejections(engine):
            self.refused.update(r.family for r in told[:-most])
            del told[:-most]
        del engine.events[:-most]
        del engine.odometry.frames[: -self.limits.frames]


@dataclass(frozen=True, slots=True)
class _Landmarks:
    gone: set[int]
    lonely: set[int]
    split: set[int]
