"""The graph's half of the stream: what the front ends saw in, answers out, within bounds of memory and time."""

import time
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...factors import keys
from ...factors.errors import ObservabilityError, SurecutError
from ...factors.measurements import Pick
from ...factors.rig import Rig, sha256_of
from ..aside import Aside
from ..bounded import Bounded
from ..bundle import Bundle
from ..decision import Decision, decide
from ..pipeline import Pipeline
from ..points_in_base import pipe_estimate, point_blocks, radius95
from ..result import PipeEstimate, PointEstimate, PoseEstimate, Result
from ..sensing import Sensed
from ..validated_range import ValidatedRange
from .audits import Audits
from .calibration import departures, held, hold
from .drift import Drift
from .glances import Glance
from .knocks import Knocks
from .memory import Memory, recall, remember, save
from .parent import give_back
from .posterior import Posterior
from .settings import S, StreamSettings
from .settled import Settled
from .trust import grown
from .wire import Answer, Place

Float = NDArray[np.float64]

PICTURES = 50
"""Cut-outs of clicks that are kept."""
EVENTS = 50


class GraphLoop:
    """One engine for hours.

    Args:
        tell: takes each answer.
        memory: what an earlier run knew.
        checkpoint: file that is kept up to date; None for none.
        apart: somebody waits for answers: they come by the computer's clock too, and the audit and the checkpoint are
            made by copies of the process.
    """

    def __init__(
        self,
        rig: Rig,
        settings: StreamSettings,
        tell: Callable[[Answer], object],
        memory: Memory | None = None,
        checkpoint: Path | None = None,
        validated: ValidatedRange | None = None,
        apart: bool = False,
    ) -> None:
        self.rig = rig
        self._settings = settings
        self._tell = tell
        self._checkpoint = checkpoint
        self._validated = validated
        self._rig_sha256 = sha256_of(rig)
        self.pipeline = Pipeline(rig)
        self.engine = self.pipeline.engine
        self._bounded = Bounded(self.engine, settings.limits)
        if memory is not None:
            recall(self.engine, memory)
            self._bounded.first = memory.keyframes
        self._knocks = Knocks(self.engine)
        self._drift = Drift(self.engine)
        self._settled = Settled(self.engine)
        self._audits = Audits(self.engine, settings.audit_period_ns, apart)
        self._saving: Aside[str] = Aside(apart)
        self._live = apart
        self._told_s = 0.0
        """When an answer was last due, by the computer's clock."""
        self._next_answer_ns = 0
        self._saved_s = time.monotonic()
        self._kept_points: frozenset[str] = frozenset()
        """Ids of points in the checkpoint."""
        self._answer: Answer | None = None
        self._changed = memory is not None
        self._first_ns: int | None = None
        self.counts: Counter[str] = Counter()

    # In -------------------------------------------------------------------------------------------------------

    def take(self, sensed: Sensed, busy: bool = False) -> None:
        """Everything of one stamp.

        Args:
            busy: more is waiting: answers may be rarer.
        """
        if self._first_ns is None:
            self._first_ns = sensed.stamp_ns
        before, told = self.engine.odometry.last_keyframe, self._told()
        drifted = self._drift.see(sensed.bundle.frame)
        try:
            self.pipeline.take(sensed)
        except ObservabilityError as error:
            self.counts["undetermined"] += 1
            self.counts["failures"] += 1
            raise SurecutError(f"at {sensed.stamp_ns} ns: {error}") from error
        new = self.engine.odometry.last_keyframe > before
        clicked = bool(sensed.bundle.picks)
        drifted |= new and self._off_its_place(sensed.bundle)
        self._changed |= new or clicked or drifted or self._told() != told
        self.counts["frames"] += sensed.bundle.frame is not None
        self.counts["keyframes"] += new
        self.counts["picks"] += len(sensed.bundle.picks)
        self._answer_when_due(sensed.stamp_ns, clicked or drifted, busy)
        if self._bounded.tidy():
            give_back()
        self._answer_when_due(sensed.stamp_ns, False, busy)

    def _off_its_place(self, bundle: Bundle) -> bool:
        """A keyframe is a glance too: True when it changes what is suspected."""
        left = tuple(sighting for sighting in bundle.sightings if sighting.camera == "m_left")
        if bundle.frame is None or not left:
            return False
        try:
            return self._knocks.see(Glance(bundle.frame, left))
        except ObservabilityError:
            self.counts["undetermined"] += 1
            return False

    def _told(self) -> tuple[int, int]:
        """Changes with each factor that enters or leaves."""
        log = self.engine.solver.log
        return len(log.factors), len(log.off)

    def look_back(self, sensed: Sensed) -> bool:
        """A click in a frame that has passed."""
        taken = self.pipeline.look_back(sensed)
        self.counts["picks" if taken else "picks_too_late"] += len(sensed.bundle.picks)
        self._changed |= taken
        self._answer_when_due(self.engine.end_ns, True, False)
        return taken

    def glance(self, glance: Glance) -> None:
        """Markers in a frame that is no keyframe."""
        try:
            changed = self._knocks.see(glance)
        except ObservabilityError:
            self.counts["undetermined"] += 1
            return
        self.counts["glances"] += 1
        self._changed |= changed
        if changed:
            self.answer(glance.frame.stamp_ns)

    def unplaced(self, sensed: Sensed) -> list[Pick]:
        """Clicks in pictures that have passed, of which nothing is known any more."""
        engine = self.engine
        if engine.waiting:
            return []  # a board may yet tell where these were made
        passed = [p for p in sensed.bundle.picks if p.camera != "b_rgb" and p.stamp_ns < engine.end_ns]
        found = [p for p in passed if p.stamp_ns not in engine.keyframe_at]
        self.counts["picks_too_late"] += len(found)
        return found

    def freeze(self, on: bool) -> str:
        """Holds the calibration, or lets it go."""
        there = held(self.engine)
        if on and not there:
            self.engine.state.values = self.engine.solver.update(hold(self.engine))
        if not on and there:
            self.engine.state.values = self.engine.solver.switch_off(there)
        self._changed = True
        return "the calibration is held" if on else "the calibration may move"

    # Out ------------------------------------------------------------------------------------------------------

    def _answer_when_due(self, stamp_ns: int, at_once: bool, busy: bool) -> None:
        period = self._settings.answer_period_ns
        if self._next_answer_ns - stamp_ns > 2 * period:
            self._next_answer_ns = 0  # the clock was set back
        waited = time.monotonic() - self._told_s >= period / S
        if stamp_ns < self._next_answer_ns and not at_once and not (waited and self._live):
            return
        if busy and not (waited or at_once):
            return  # what waits passes faster than it was measured
        self._next_answer_ns = stamp_ns + period
        self.answer(stamp_ns)
        self._told_s = time.monotonic()

    def settle(self) -> None:
        """Takes the engine itself to its optimum, which takes as long as several answers."""
        self.engine.flush()
        self.engine.state.values = self.engine.solver.settle()
        self._changed = True

    def mark_changed(self) -> None:
        """The next answer is made anew."""
        self._changed = True

    def answer(self, stamp_ns: int) -> Answer | None:
        """Tells what is known now; None while nothing is."""
        self._changed |= self._audits.take()
        if self._changed or self._answer is None:
            self._audits.begin_when_due(stamp_ns)
            self._audits.take()
            made = self._made(stamp_ns)
            if made is None:
                return None
            self._answer, self._changed = made, False
        else:
            decisions = self._decisions(self._answer, stamp_ns)
            self._answer = replace(
                self._answer, stamp_ns=stamp_ns, decisions=decisions, last_tie_ns=self.engine.boards.last_seen_ns()
            )
        self._answer = replace(
            self._answer,
            counts=self._counted(),
            cpu_s=time.process_time(),
            suspects=(*self._knocks.suspects, *self._drift.suspects),
        )
        self._tell(self._answer)
        return self._answer

    def _made(self, stamp_ns: int) -> Answer | None:
        engine, state = self.engine, self.engine.state
        if state.values.size() == 0:
            return None
        last = keys.keyframe(engine.odometry.last_keyframe)
        newest = [last] if state.has(last) else []
        try:
            posterior = self._settled.posterior(newest)
            self.counts["settling_steps"] = self._settled.steps
        except ObservabilityError:
            self.counts["undetermined"] += 1
            return None
        points, consistency = self._points(posterior), self._audits.consistency()
        answer = Answer(
            stamp_ns=stamp_ns,
            keyframe_ns=engine.odometry.keyframe_stamps[-1] if newest else None,
            places=self._places(posterior, newest),
            points=points,
            joint_m2=self._joint(posterior, [point.id for point in points]),
            pipes=self._pipes(posterior),
            calibration=departures(engine, posterior),
            events=tuple(sorted(engine.everything_told(), key=lambda e: e.stamp_ns)[-EVENTS:]),
            last_tie_ns=engine.boards.last_seen_ns(),
            consistent=consistency.passed,
            reasons=consistency.reasons,
        )
        self._forget_pictures()
        return replace(answer, decisions=self._decisions(answer, stamp_ns))

    def _places(self, posterior: Posterior, newest: list[int]) -> dict[str, Place]:
        named = {board.id: self.engine.boards.key(board.id) for board in self.rig.boards}
        named = {"b": keys.base(0), **named, **({"m": newest[0]} if newest else {})}
        return {
            name: Place(posterior.values.atPose3(key).matrix(), posterior.marginal(key) * self._audits.widening(name))
            for name, key in named.items()
            if key in posterior.columns
        }

    def _points(self, posterior: Posterior) -> tuple[PointEstimate, ...]:
        base, found = keys.base(0), []
        for point in self.engine.pipes.points.values():
            key = keys.point(point.index)
            if not point.known or base not in posterior.columns or key not in posterior.columns:
                continue
            position, blocks = point_blocks(posterior.values, base, key)
            covariance = posterior.covariance(blocks) * self._audits.widening(point.id)
            axis = self._axis(posterior, point.pipe) if point.on_axis else None
            found.append(
                PointEstimate(
                    id=point.id,
                    role=point.role,
                    frame="b",
                    position_m=position,
                    covariance_m2=covariance,
                    radius95_m=radius95(covariance),
                    measurements=point.picks,
                    axis=axis,
                    pipe_id=point.pipe if point.on_axis else None,
                )
            )
        return tuple(found)

    def _joint(self, posterior: Posterior, names: list[str]) -> Float:
        """Covariance of points in {b} together: they share machine, board and calibration."""
        rows: list[tuple[int, Float]] = []
        wide = np.sqrt([self._audits.widening(name) for name in names])
        for i, name in enumerate(names):
            key = keys.point(self.engine.pipes.points[name].index)
            for variable, block in point_blocks(posterior.values, keys.base(0), key)[1]:
                whole = np.zeros((3 * len(names), block.shape[1]))
                whole[3 * i : 3 * i + 3] = wide[i] * block
                rows.append((variable, whole))
        return posterior.covariance(rows) if rows else np.zeros((0, 0))

    def _axis(self, posterior: Posterior, pipe: str | None) -> Float | None:
        cylinder = self.engine.pipes.cylinders.get(pipe or "")
        if cylinder is None or keys.axis_start(cylinder.index) not in posterior.columns:
            return None
        values = posterior.values
        span = values.atPoint3(keys.axis_end(cylinder.index)) - values.atPoint3(keys.axis_start(cylinder.index))
        turned = values.atPose3(keys.base(0)).rotation().matrix().T @ span
        return turned / np.linalg.norm(turned)

    def _pipes(self, posterior: Posterior) -> tuple[PipeEstimate, ...]:
        base, found = keys.base(0), []
        for name, cylinder in self.engine.pipes.cylinders.items():
            if not cylinder.known or not {base, keys.radius(cylinder.index)} <= posterior.columns.keys():
                continue
            o_T_b = posterior.values.atPose3(base)
            places = [o_T_b.transformTo(p) for p in self.engine.pipes.places(name)]
            near = np.mean(places, axis=0) if places else np.zeros(3)
            found.append(pipe_estimate(name, "b", cylinder.index, base, near, posterior.values, posterior))
        return tuple(found)

    def _decisions(self, answer: Answer, now_ns: int) -> tuple[Decision, ...]:
        """The cut plan's verdicts, with what the time since the last look at a board adds."""
        if not self.rig.cut_plan:
            return ()
        tie = answer.last_tie_ns
        age_s = 0.0 if tie is None else (now_ns - tie) / S
        points = []
        for p in answer.points:
            covariance = grown(p.covariance_m2, p.position_m, age_s, self._settings)
            points.append(replace(p, covariance_m2=covariance, radius95_m=radius95(covariance)))
        start = PoseEstimate("m", "o", self._first_ns or now_ns, np.eye(4), None)
        result = Result(
            points=tuple(points), poses=(), trajectory=(start,), pipes=answer.pipes, calibration=(), distances=(),
            consistency=self._audits.consistency(), rejected=(), events=answer.events, streaming_difference_sigma={},
            timing={}, provenance={}, config_yaml="", last_board_view_ns=tie, end_ns=now_ns,
        )  # fmt: skip
        return decide(result, self.rig, self._validated)

    def _forget_pictures(self) -> None:
        pictures = self.engine.pick_images
        for key in list(pictures)[:-PICTURES]:
            del pictures[key]
        del self.engine.picks[:-1000]

    def _counted(self) -> dict[str, int]:
        failed = {"audits_failed": self._audits.failed} if self._audits.failed else {}
        return {**self.counts, **failed}

    # Memory ---------------------------------------------------------------------------------------------------

    def checkpoint_when_due(self) -> None:
        """Writes the file every few seconds; a full disk is counted, not fatal."""
        now = time.monotonic()
        points = frozenset(point.id for point in self._answer.points) if self._answer is not None else frozenset()
        # a new point is kept at once: a death a second later must not cost the operator's clicks
        waited = now - self._saved_s >= self._settings.checkpoint_period_s or points != self._kept_points
        due = self._checkpoint is not None and waited
        try:
            if due and not self._saving.busy() and not self.engine.graph.unsolved:
                self._saved_s, self._kept_points = now, points
                self._saving.begin(self._written)
            if self._saving.taken() is not None:
                self.counts["checkpoints"] += 1
        except SurecutError:
            self.counts["checkpoint_errors"] += 1

    def save(self) -> str:
        """Writes the checkpoint now.

        Raises:
            SurecutError: there is no place for it, nothing to remember, or the disk is full.
        """
        self._saving.stop()
        text = self._written()
        self.counts["checkpoints"] += 1
        return text

    def close(self) -> None:
        """Ends what copies of the process still do."""
        self._audits.stop()
        self._saving.stop()

    def _written(self) -> str:
        if self._checkpoint is None:
            raise SurecutError("there is no file to save to; start with --checkpoint FILE")
        memory = remember(self.engine)
        if memory is None:
            raise SurecutError("nothing to remember yet: no board has a place")
        save(memory, self._checkpoint, self._rig_sha256, self._answer)
        return f"saved to {self._checkpoint}"
