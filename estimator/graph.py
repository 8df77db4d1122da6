"""The currency between sensors and solvers: factors with their provenance, and first guesses of new variables."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import gtsam
import numpy as np


@dataclass(frozen=True, slots=True)
class Record:
    """Where a factor comes from."""

    family: str
    """`marker corners`, `board geometry`, `known distances`, `stereo odometry`, `depth cloud`, `pipe outline`,
    `pipe width`, `picks`, `mount`, `colour view`, `calibration priors`, `gauge`."""
    source: str
    """Finer than the family: the camera, the board, or the calibration state whose prior it is."""
    stamp_ns: int
    what: str
    """The measurement in words."""
    rejectable: bool = True
    """False for priors and definitions, which are never thrown out as outliers."""
    camera: str | None = None


@dataclass(slots=True)
class Update:
    """Factors and guesses that belong together: they enter the graph in one step."""

    factors: list[gtsam.NonlinearFactor] = field(default_factory=list)
    records: list[Record] = field(default_factory=list)
    values: gtsam.Values = field(default_factory=gtsam.Values)

    def add(self, factor: gtsam.NonlinearFactor, record: Record) -> None:
        self.factors.append(factor)
        self.records.append(record)

    def guess(self, key: int, value: Any) -> None:
        self.values.insert(key, value)

    def extend(self, other: "Update") -> None:
        self.factors.extend(other.factors)
        self.records.extend(other.records)
        self.values.insert(other.values)

    def empty(self) -> bool:
        return not self.factors and self.values.size() == 0


class State:
    """What is believed now: the latest estimate and the guesses that have not been through the solver yet."""

    def __init__(self) -> None:
        self.values = gtsam.Values()

    def has(self, key: int) -> bool:
        return self.values.exists(key)

    def pose(self, key: int) -> gtsam.Pose3:
        return self.values.atPose3(key)

    def point(self, key: int) -> np.ndarray:
        return self.values.atPoint3(key)

    def vector(self, key: int) -> np.ndarray:
        return self.values.atVector(key)

    def intrinsics(self, key: int) -> gtsam.Cal3DS2:
        return self.values.atCal3DS2(key)


class FactorLog:
    """All factors ever added, in order, with the ones that are switched off."""

    def __init__(self) -> None:
        self.factors: list[gtsam.NonlinearFactor] = []
        self.records: list[Record] = []
        self.off: set[int] = set()
        self._graph = gtsam.NonlinearFactorGraph()
        self._in_graph, self._off_graph = 0, 0
        """How many factors the graph has taken, and how many were off then."""

    def append(self, update: Update) -> None:
        self.factors.extend(update.factors)
        self.records.extend(update.records)

    def replace(self, index: int, factor: gtsam.NonlinearFactor) -> None:
        """Another factor in the place of one that says the same, or a part of it."""
        self.factors[index] = factor
        self._off_graph = -1

    def replaced(self, factors: Mapping[int, gtsam.NonlinearFactor]) -> "FactorLog":
        """A log of its own, with other factors in the place of some."""
        other = FactorLog()
        other.factors = [factors.get(index, factor) for index, factor in enumerate(self.factors)]
        other.records, other.off = self.records, self.off
        return other

    def active(self) -> Iterator[tuple[int, gtsam.NonlinearFactor, Record]]:
        for index, (factor, record) in enumerate(zip(self.factors, self.records, strict=True)):
            if index not in self.off:
                yield index, factor, record

    def graph(self) -> gtsam.NonlinearFactorGraph:
        """The active factors in their order; to be read only, and until the next change."""
        if len(self.off) != self._off_graph:
            self._graph = gtsam.NonlinearFactorGraph()
            self._in_graph, self._off_graph = 0, len(self.off)
        for index in range(self._in_graph, len(self.factors)):
            if index not in self.off:
                self._graph.add(self.factors[index])
        self._in_graph = len(self.factors)
        return self._graph
