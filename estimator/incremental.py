"""The running solver: iSAM2 over the factors as they come."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import count

import gtsam
import numpy as np
from numpy.typing import NDArray

from ..factors import keys
from .graph import FactorLog, Record, Update
from .marginal import FAMILY, GaussianPrior, carried, gaussian_of, joint_of, marginal, renamed, without
from .newton import Elimination, gain
from .observability import Undetermined, determined
from .run_away import blamed

Float = NDArray[np.float64]

# Relinearise when a variable moved by more than this, per component of its tangent (m, rad, px): small against any
# sigma that is ever reported, so that the incremental solution stays within a tenth of a sigma of the batch one.
_THRESHOLDS = {
    "x": [1e-4] * 3 + [1e-4] * 3,
    "f": [1e-4] * 3 + [1e-4] * 3,
    "b": [1e-4] * 3 + [1e-4] * 3,
    "e": [1e-5] * 3 + [2e-5] * 3,
    "l": [1e-3] * 3,
    "q": [1e-4] * 3,
    "p": [2e-4] * 3,
    "u": [2e-4] * 3,
    "v": [2e-4] * 3,
    "h": [1e-5, 1e-4],
    "r": [1e-4],
    "w": [1e-4],
    "k": [0.01, 0.01, 1.0, 0.01, 0.01, 1e-4, 1e-4, 1e-4, 1e-4],
    "d": [2e-4, 2e-4],
    "g": [1e-5, 1e-5, 1e-4],
}

RELINEARIZE_EVERY = 10
"""Updates between relinearisations: calibration states tie everything together, so that each one costs a fair part
of a batch solution; `settle` makes up for what is left at the end."""

SETTLED = 0.2
"""Gain in half the chi-square of a step after which iSAM2 takes the last one: what that leaves is a small part of it,
shared among all variables."""

SETTLE_ROUNDS = 8
"""Steps at the end, at most: it takes that many where much was learnt last."""
MOVED_ROUNDS = 3
"""Steps after a part of the map was moved."""

MOST_DROPPED = 50
"""Landmarks that one update may lose: wrong matches come one at a time, a graph that falls apart is another matter."""


@dataclass(frozen=True, slots=True)
class Cut:
    """What leaves the graph, and how."""

    leaving: set[int]
    """Keys; what their factors say about the others stays, as one Gaussian factor."""
    dropped: set[int]
    """Keys that go with all of their factors, as if they had never been measured."""
    split: set[int]
    """Landmarks that stay, of which the factors of what leaves are taken for those of another point."""

    def within(self, values: gtsam.Values) -> "Cut":
        """The same for the variables that there are."""
        return Cut(*({key for key in part if values.exists(key)} for part in (self.leaving, self.dropped, self.split)))

    def giving_up(self, key: int) -> "Cut | None":
        """The same without a landmark that nothing determines; None where the key is no landmark's."""
        if keys.kind(key) == keys.kind(keys.landmark_before(0)):
            key = keys.landmark(keys.index(key))
        if keys.kind(key) != "l":
            return None
        return Cut(self.leaving - {key}, self.dropped | {key}, self.split - {key})


class Incremental:
    """iSAM2 with the bookkeeping that lets single measurements be switched off again."""

    def __init__(self) -> None:
        self._isam = gtsam.ISAM2(_parameters())
        self._slots: list[int | None] = []
        """iSAM2's index of each factor of the log."""
        self._values = gtsam.Values()
        self._relocated = False
        self._unheld: set[int] = set()
        """Landmarks that nothing determined when covariances were last asked for, until the solver begins anew."""
        self.log = FactorLog()
        self.dropped: list[int] = []
        """Landmarks that were given up: wrong matches had driven them to where nothing determines them."""

    def update(self, update: Update, remove: Iterable[int] = ()) -> gtsam.Values:
        """Takes the new factors and guesses, switches off the factors `remove`, and returns the estimate.

        Raises:
            ObservabilityError: a variable other than a landmark is not determined by the factors, at any
                linearisation.
        """
        graph = gtsam.NonlinearFactorGraph()
        for factor in update.factors:
            graph.add(factor)
        removed = [i for i in remove if i not in self.log.off]
        slots = [slot for i in removed if (slot := self._slots[i]) is not None]
        first = self._isam.getFactorsUnsafe().size()
        self.log.append(update)
        self.log.off.update(removed)
        if self._relocated:
            self._values.insert(update.values)
            self._begin(self._values)
            return self.settle(MOVED_ROUNDS)
        try:
            with determined():
                self._isam.update(graph, update.values, slots)
            self._slots += range(first, first + len(update.factors))
            self._values = self._isam.calculateEstimate()
        except Undetermined:
            self._values.insert(update.values)
            self._restart()
        return gtsam.Values(self._values)

    def _restart(self) -> None:
        """Starts iSAM2 anew; landmarks that stay undetermined are given up, one after the other."""
        for _ in range(MOST_DROPPED):
            try:
                self._rebuild()
            except Undetermined as error:
                key = blamed(error.key, self._values)
                if keys.kind(key) != "l":
                    raise
                self._drop(key)
            else:
                return
        self._rebuild()

    def _drop(self, landmark: int) -> None:
        """A landmark behind the cameras that saw it has no residual, and nothing brings it back."""
        self.dropped.append(landmark)
        self._erase({landmark})

    def exchange(self, factors: Mapping[int, gtsam.NonlinearFactor]) -> None:
        """Other factors over the same variables, by place in the log; `settle` or the next update begins anew."""
        for index, factor in factors.items():
            self.log.replace(index, factor)
        self._relocated = True

    def give_up(self, gone: Collection[int], places: Mapping[int, Float]) -> gtsam.Values:
        """Takes variables out with all of their factors, and begins anew at the next update with points elsewhere.

        Args:
            places: of points, shape (3,), by key.
        """
        self._erase({key for key in gone if self._values.exists(key)})
        for key, place in places.items():
            self._values.update(key, np.asarray(place, np.float64))
        self._relocated = True
        return gtsam.Values(self._values)

    def _erase(self, gone: set[int]) -> None:
        for index, factor, record in [row for row in self.log.active() if not gone.isdisjoint(row[1].keys())]:
            prior = joint_of(factor, self._values) if record.family == FAMILY else None
            rest = None if prior is None else without(prior, gone)
            if rest is None:
                self.log.off.add(index)
            else:  # what is known of everything else does not go with it
                self.log.replace(index, rest.factor())
        for key in gone:
            self._values.erase(key)

    def _rebuild(self) -> None:
        """Starts iSAM2 anew from a damped batch optimum.

        A linearisation far from the optimum can be singular although the problem is not: new landmarks and axes start
        from rough guesses. Levenberg-Marquardt gets across. And what hangs on a motion prior of a metre is held a
        billion times less than what its landmarks hold, of which Cholesky's squares leave nothing: from here on it is
        QR. What is singular for both is not observable.
        """
        graph = gtsam.NonlinearFactorGraph()
        self._slots = []
        for index, factor in enumerate(self.log.factors):
            off = index in self.log.off
            self._slots.append(None if off else graph.size())
            if not off:
                graph.add(factor)
        optimiser = gtsam.LevenbergMarquardtOptimizer(graph, self._values, gtsam.LevenbergMarquardtParams())
        with determined():
            values = optimiser.optimize()
            self._isam = gtsam.ISAM2(_parameters("QR"))
            self._isam.update(graph, values)
            self._values = self._isam.calculateEstimate()

    def values(self) -> gtsam.Values:
        """The estimate over the factors of the log."""
        return self._values

    def switch_off(self, remove: Iterable[int]) -> gtsam.Values:
        """Takes factors out again, by their places in the log."""
        return self.update(Update(), remove)

    def reduce(self, cut: Cut, stamp_ns: int) -> gtsam.Values:
        """Takes variables out of the graph and starts iSAM2 anew on the rest.

        Raises:
            ObservabilityError: a variable that leaves, or a landmark that stays, is not determined.
        """
        values = self._stepped(cut.dropped)
        cut = cut.within(values)  # the step may have cost a landmark
        past = {key: keys.landmark_before(keys.index(key)) for key in cut.split}
        for key, before in past.items():
            values.insert(before, values.atPoint3(key))
        gone = {*cut.leaving, *past.values()}
        absorbed: list[gtsam.NonlinearFactor] = []
        log = FactorLog()
        for _, factor, record in self.log.active():
            involved = set(factor.keys())
            if record.family == FAMILY:
                left = without(joint_of(factor, values), cut.dropped)
                absorbed += [] if left is None else [renamed(left, past).factor()]
            elif involved & cut.dropped:
                continue
            elif involved & cut.leaving:
                torn = [past.get(key, key) for key in factor.keys()]
                absorbed.append(factor.rekey(torn) if involved & cut.split else factor)
            else:
                log.factors.append(factor)
                log.records.append(record)
        with determined():
            prior = marginal(absorbed, values, gone)
        what = f"what earlier keyframes said about {len(prior.keys)} variables"
        log.factors.append(prior.factor())
        log.records.append(Record(FAMILY, FAMILY, stamp_ns, what, rejectable=False))
        for key in gone | cut.dropped:
            values.erase(key)
        self.log = log
        self._begin(values)
        return gtsam.Values(self._values)

    def _stepped(self, dropped: set[int]) -> gtsam.Values:
        """The estimate one full Newton step on: what leaves is frozen where it is taken. iSAM2 would need several times
        as long for it, and is begun anew afterwards.

        Args:
            dropped: variables whose measurements do not count any more.

        Raises:
            Undetermined: a landmark. It can be given up in a fraction of the time that getting across takes.
        """
        graph = self._without(dropped)
        try:
            with determined():
                return self._values.retract(graph.linearize(self._values).optimize())
        except Undetermined as error:
            key = blamed(error.key, self._values, dropped)
            if keys.kind(key) == "l":
                raise Undetermined(key) from error
            self._restart()
            return gtsam.Values(self._values)

    def _without(self, dropped: set[int]) -> gtsam.NonlinearFactorGraph:
        """The active factors, but for what is about some variables."""
        if not dropped:
            return self.log.graph()
        graph = gtsam.NonlinearFactorGraph()
        for _, factor, record in self.log.active():
            if not dropped.intersection(factor.keys()):
                graph.add(factor)
            elif record.family == FAMILY:
                left = without(joint_of(factor, self._values), dropped)
                if left is not None:
                    graph.add(left.factor())
        return graph

    def _begin(self, values: gtsam.Values) -> None:
        """iSAM2 anew on all factors, linearised at `values`."""
        self._unheld.clear()
        self._relocated = False
        self._isam = gtsam.ISAM2(_parameters())
        self._values = values
        try:
            with determined():
                self._isam.update(self.log.graph(), values)
        except Undetermined:
            self._restart()
            return
        places = count()
        self._slots = [None if i in self.log.off else next(places) for i in range(len(self.log.factors))]
        self._values = self._isam.calculateEstimate()

    def relocate(self, values: gtsam.Values, moved: Collection[int], correction: gtsam.Pose3) -> gtsam.Values:
        """Values that no step would reach, because a part of the map has been found to lie elsewhere.

        The next update brings what holds it there; the solver begins anew with that.

        Args:
            values: with `correction` from the left on what is moved.
        """
        for index, factor, _ in [row for row in self.log.active() if row[2].family == FAMILY]:
            if not set(factor.keys()).isdisjoint(moved):
                self.log.replace(index, carried(joint_of(factor, self._values), moved, correction).factor())
        self._values, self._relocated = values, True
        return gtsam.Values(values)

    def settle(self, rounds: int = SETTLE_ROUNDS) -> gtsam.Values:
        """Newton steps from its own latest estimate until that stays nearly where it is, at most `rounds` of them; the
        last one is taken by iSAM2, begun anew.

        While it runs it relinearises what has moved far enough, now and then; what many small moves make together,
        up to a fifth of a sigma, is made up for here. That takes a fraction of the time that relinearising in place
        takes, because the elimination is ordered for the whole graph.
        """
        graph, elimination = self.log.graph(), Elimination()
        for _ in range(rounds - 1):
            linear = graph.linearize(self._values)
            try:
                step = elimination.solved(linear)
            except Undetermined:
                break  # beginning anew gets across, or gives up a landmark
            self._values = self._values.retract(step)
            if not gain(linear, step) > SETTLED:
                break
        self._begin(self._values)
        return gtsam.Values(self._values)

    def joint_covariance(self, wanted: Sequence[int]) -> Float:
        """Joint covariance of some variables, in the order of `wanted`.

        Raises:
            ObservabilityError: one of them is not determined, or another variable that is no landmark's.
        """
        joint = self.joint_gaussian(wanted)
        try:
            covariance = np.linalg.inv(joint.H)
        except np.linalg.LinAlgError as error:
            weakest = int(np.abs(np.linalg.eigh(joint.H)[1][:, 0]).argmax())
            raise Undetermined(int(np.repeat(joint.keys, joint.widths)[weakest])) from error
        ends = np.cumsum(joint.widths)
        columns = {k: np.arange(end - w, end) for k, w, end in zip(joint.keys, joint.widths, ends, strict=True)}
        chosen = np.concatenate([columns[key] for key in wanted])
        return np.asarray(covariance[np.ix_(chosen, chosen)], np.float64)

    def stepped(self, values: gtsam.Values) -> gtsam.Values:
        """One Newton step on from values, which are not taken over.

        Raises:
            ObservabilityError: a variable is not determined there.
        """
        with determined():
            return values.retract(self._without(self._unheld).linearize(values).optimize())

    def joint_gaussian(self, wanted: Collection[int], at: gtsam.Values | None = None) -> GaussianPrior:
        """Joint Gaussian of some variables, all others eliminated; those that no factor touches are left out.

        Landmarks that nothing determines at this linearisation, such as those behind the cameras that saw them, say
        nothing: they are passed over.

        Args:
            at: where to linearise; None for the estimate.

        Raises:
            ObservabilityError: another variable is not determined.
        """
        at = self._values if at is None else at
        for _ in range(MOST_DROPPED):
            try:
                with determined():
                    return gaussian_of(self._without(self._unheld.difference(wanted)), at, wanted)
            except Undetermined as error:
                key = blamed(error.key, at, self._unheld)
                if keys.kind(key) != "l" or key in wanted:
                    raise
                self._unheld.add(key)
        with determined():
            return gaussian_of(self._without(self._unheld.difference(wanted)), at, wanted)


def _parameters(factorisation: str = "CHOLESKY") -> gtsam.ISAM2Params:
    parameters = gtsam.ISAM2Params()
    parameters.setFactorization(factorisation)
    thresholds = gtsam.ISAM2ThresholdMap()
    for letter, values in _THRESHOLDS.items():
        thresholds.insert((letter, np.array(values)))
    parameters.setRelinearizeThreshold(thresholds)
    parameters.relinearizeSkip = RELINEARIZE_EVERY
    return parameters
