"""From the solved graph to the `Result`: points in {b}, poses, calibration, distances, consistency, provenance."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import gtsam
import numpy as np
from numpy.typing import NDArray

from ..factors import keys
from ..factors.board import mean_point
from ..factors.errors import ObservabilityError
from ..factors.geometry import ros_covariance
from ..factors.measurements import Event
from ..factors.rig import dump_rig
from . import dark_uncertainty
from .advice import advise
from .agreement import cloud_event
from .aside import Aside
from .batch import BatchSolution
from .board_inspection import FAMILY as CORNERS
from .calibration_rows import calibration_rows
from .consistency import contradicted_points, contradictions, judge
from .engine import Engine
from .known_distances import distance_name
from .marker_points import parse_point
from .motions import motions
from .mount_check import compared_with_cloud
from .pick_views import pick_records, pick_views
from .plain_tests import Plain, PlainTests
from .points_in_base import pipe_estimate, point_blocks, radius95
from .refusals import everything_rejected
from .result import (
    Advice,
    Consistency,
    DistanceEstimate,
    PickView,
    PipeEstimate,
    PointEstimate,
    PoseEstimate,
    Result,
)
from .surroundings import Surroundings, compact_map, nearest_surface, surroundings
from .trajectory import with_covariances

Float = NDArray[np.float64]
MANY = "lxq"
"""Kinds of variables of which there are many: landmarks, keyframes, corners."""


@dataclass(frozen=True, slots=True)
class _Rest:
    """Parts of a result that need no other but the points."""

    advice: dict[str, tuple[Advice, ...]]
    pick_views: tuple[PickView, ...]


class Summary:
    """Reads one solution. Every covariance comes from the same linear system.

    Args:
        plain: what may have begun before.
        past: the path of keyframes that have left the graph.
        apart: a copy of the process reads a part of it, where a second core is free.
    """

    def __init__(
        self,
        engine: Engine,
        solution: BatchSolution,
        plain: PlainTests,
        past: Sequence[PoseEstimate] = (),
        apart: bool = False,
    ) -> None:
        self._engine = engine
        self._plain = plain
        self._past = past
        self._apart = apart
        self._values = solution.values
        self._solution = solution
        self._active, self._system = solution.at.active, solution.at.system
        self._known_sigmas: dict[int, Float] = {}

    def result(
        self,
        between: tuple[tuple[str, str], ...],
        timing: dict[str, float],
        provenance: dict[str, str],
        memory: Callable[[], str] = str,
    ) -> Result:
        """
        Args:
            memory: makes the text from which a later run may begin.
        """
        engine = self._engine
        points = self._points()
        rest: Aside[_Rest] = Aside(self._apart, niceness=0)
        rest.begin(partial(self._rest, points))
        try:
            pipes = self._pipes(points)
            around = surroundings(engine, self._values, self._system)
            points = tuple(self._with_surface(p, pipes, around) for p in points)
            plain = self._plain.awaited(self._solution)
            consistency = self._consistency(plain)
            distances = self._distances(between)
            self._tell_corner_rms()
            poses = self._poses()
            calibration = calibration_rows(engine, self._values, self._sigmas)
            moved = motions(self._values, self._system, engine.odometry.keyframes_in(self._values))
            streaming = self._streaming_difference()
            remembered = memory()
            path = (*self._past, *with_covariances(plain.trajectory, self._keyframe_covariances()))
            other = rest.awaited()
        finally:
            rest.stop()
        return Result(
            points=points,
            poses=poses,
            trajectory=tuple(sorted(path, key=lambda pose: pose.stamp_ns)),
            pipes=pipes,
            calibration=calibration,
            distances=distances,
            consistency=consistency,
            rejected=(*everything_rejected(engine), *self._solution.rejected),
            events=tuple(sorted(engine.everything_told(), key=lambda e: e.stamp_ns)),
            streaming_difference_sigma=streaming,
            timing=timing,
            provenance=provenance,
            config_yaml=dump_rig(engine.rig),
            last_board_view_ns=engine.boards.last_seen_ns(),
            end_ns=engine.end_ns,
            advice=other.advice,
            pick_views=other.pick_views,
            picks=pick_records(engine),
            surroundings=compact_map(around),
            motions=moved,
            memory=remembered,
        )

    def _rest(self, points: tuple[PointEstimate, ...]) -> "_Rest":
        """Half of the work, of what changes nothing and is told to nobody before the end."""
        return _Rest(
            self._advice(points),
            pick_views(self._engine, self._values, self._system),
        )

    def _advice(self, points: tuple[PointEstimate, ...]) -> dict[str, tuple[Advice, ...]]:
        engine = self._engine
        if not engine.advises:
            return {}
        return advise(engine, self._values, self._system, self._active, points, self._solution.at.inflation)

    def _tell_corner_rms(self) -> None:
        """Distance of the accepted corners from where the solution puts them."""
        corners = [f for _, f, r in self._active if r.family == CORNERS and isinstance(f, gtsam.NoiseModelFactor)]
        if corners:
            rms = float(np.sqrt(np.mean([np.sum(f.unwhitenedError(self._values) ** 2) for f in corners])))
            text = f"{len(corners)} marker corners lie {rms:.2f} px (rms) from where the solution puts them"
            self._engine.events.append(Event(self._engine.end_ns, "corner_rms", text, "info", {"rms_px": rms}))

    # Points ---------------------------------------------------------------------------------------------------

    def _points(self) -> tuple[PointEstimate, ...]:
        engine, base = self._engine, self._engine.base
        known = [p for p in engine.pipes.points.values() if p.known]
        if known and not self._values.exists(base):
            raise ObservabilityError(engine.why_no_base())
        return tuple(self._point(p.id) for p in known)

    def _point(self, name: str) -> PointEstimate:
        point = self._engine.pipes.points[name]
        position, blocks = point_blocks(self._values, self._engine.base, keys.point(point.index))
        influence = self._system.influence(blocks)
        covariance = influence.T @ influence
        axis = None
        if point.on_axis and point.pipe is not None:
            axis = self._axis(self._engine.pipes.cylinders[point.pipe].index)
        return PointEstimate(
            id=point.id,
            role=point.role,
            frame=self._engine.stations.frame,
            position_m=position,
            covariance_m2=covariance,
            radius95_m=radius95(covariance),
            measurements=point.picks,
            axis=axis,
            pipe_id=point.pipe if point.on_axis else None,
            budget=self._budget(influence),
        )

    def _with_surface(
        self, point: PointEstimate, pipes: tuple[PipeEstimate, ...], around: Surroundings | None
    ) -> PointEstimate:
        """What is next to a point on a pipe. Without a pipe the map cannot be told from what is to be cut."""
        own = next((pipe for pipe in pipes if pipe.id == point.pipe_id), None)
        if own is None or around is None:
            return point
        key = keys.point(self._engine.pipes.points[point.id].index)
        return replace(point, nearest_surface=nearest_surface(around, point, own, key, self._values, self._system))

    def _axis(self, index: int) -> Float:
        o_T_b = self._values.atPose3(self._engine.base)
        span = self._values.atPoint3(keys.axis_end(index)) - self._values.atPoint3(keys.axis_start(index))
        return o_T_b.rotation().matrix().T @ (span / np.linalg.norm(span))

    def _budget(self, influence: Float) -> dict[str, Float]:
        """Share of every source in a covariance: with A the whitened Jacobian, J (A^T A)^-1 J^T is the sum over the
        rows of A of (J (A^T A)^-1 a_i)^2, so the sources' shares sum to it exactly."""
        names, group = self._sources()
        products = influence[:, :, None] * influence[:, None, :]
        shares = np.stack([np.bincount(group, p, len(names)) for p in products.reshape(len(group), -1).T], axis=-1)
        order = np.argsort(-np.trace(shares.reshape(-1, 3, 3), axis1=1, axis2=2), kind="stable")
        return {names[i]: np.asarray(shares[i].reshape(3, 3), np.float64) for i in order}

    def _sources(self) -> tuple[list[str], NDArray[np.int64]]:
        """Names of what the rows of the system come from, and which one each row (rows,) does."""
        place: dict[tuple[str, str], int] = {}
        group = [place.setdefault((r.family, r.source), len(place)) for _, _, r in self._active]
        names = [f"{family}: {source}" if source != family else family for family, source in place]
        return names, np.repeat(group, self._system.rows)

    def _pipes(self, points: tuple[PointEstimate, ...]) -> tuple[PipeEstimate, ...]:
        found = []
        for name, cylinder in self._engine.pipes.cylinders.items():
            if not cylinder.known or not self._values.exists(self._engine.base):
                continue
            on_it = [p.position_m for p in points if p.pipe_id == name]
            near = np.mean(on_it, axis=0) if on_it else np.zeros(3)
            found.append(
                pipe_estimate(
                    name,
                    self._engine.stations.frame,
                    cylinder.index,
                    self._engine.base,
                    near,
                    self._values,
                    self._system,
                )
            )
        return tuple(found)

    # Poses ----------------------------------------------------------------------------------------------------

    def _poses(self) -> tuple[PoseEstimate, ...]:
        engine = self._engine
        named = []
        if self._values.exists(self._engine.base):
            named.append(("b", engine.base, engine.end_ns))
        for station, move in enumerate(engine.stations.moves):
            if self._values.exists(keys.base(station)):
                named.append((f"b{station}", keys.base(station), move.start_ns))
        for board in engine.rig.boards:
            if engine.boards.known(board.id):
                named.append((board.id, engine.boards.key(board.id), engine.end_ns))
        last = engine.odometry.last_keyframe
        if last >= 0:
            named.append(("m", keys.keyframe(last), engine.odometry.keyframe_stamps[last]))
        found = []
        covariances = self._system.marginals([key for _, key, _ in named])
        for (name, key, stamp_ns), covariance in zip(named, covariances, strict=True):
            pose = self._values.atPose3(key)
            found.append(PoseEstimate(name, "o", stamp_ns, pose.matrix(), ros_covariance(pose, covariance)))
        return tuple(found)

    def _keyframe_covariances(self) -> dict[int, Float]:
        """Keyframes' own covariances by stamp, ns, shape (6, 6) each, rotation first, body frame."""
        there = self._engine.odometry.keyframes_in(self._values)
        return dict(zip(there.values(), self._system.marginals([keys.keyframe(i) for i in there]), strict=True))

    # Distances ------------------------------------------------------------------------------------------------

    def _sigmas(self, key: int) -> Float:
        """Standard deviations of one variable's components."""
        if key not in self._known_sigmas:  # then of all calibration and the like, which is hardly more work
            few = [k for k in self._system.columns if k == key or keys.kind(k) not in MANY]
            for k, covariance in zip(few, self._system.marginals(few), strict=True):
                self._known_sigmas[k] = np.sqrt(np.clip(np.diag(covariance), 0.0, None))
        return self._known_sigmas[key]

    def _distances(self, between: tuple[tuple[str, str], ...]) -> tuple[DistanceEstimate, ...]:
        rig = self._engine.rig
        found = []
        dark = self._dark_variance()
        asked = [(d.point_a, d.point_b, d.distance_m, d.sigma_m) for d in rig.distances]
        for a, b, given, given_sigma in [*asked, *((a, b, None, None) for a, b in between)]:
            estimate = self._distance(a, b)
            if estimate is None:
                if given is None:
                    raise ObservabilityError(f"distance {a} to {b}: one of the two markers was never placed by the log")
                continue
            length, sigma = estimate
            found.append(DistanceEstimate(f"{a} to {b}", length, float(np.hypot(sigma, dark**0.5)), given, given_sigma))
        return tuple(found)

    def _dark_variance(self) -> float:
        """Variance that the given distances show beyond the model; tells the user."""
        sigmas = {distance_name(d): d.sigma_m for d in self._engine.rig.distances}
        rows = [(i, sigmas[r.what]) for i, (_, _, r) in enumerate(self._active) if r.what in sigmas]
        given = np.array([s for _, s in rows])
        variance = dark_uncertainty.of_distances(self._system, [i for i, _ in rows], given)
        if variance > 0.0:
            self._engine.events.append(dark_uncertainty.event(variance, given, self._engine.end_ns))
        return variance

    def _distance(self, a: str, b: str) -> tuple[float, float] | None:
        points = [self._engine.distances.point_keys(parse_point(text, self._engine.rig)) for text in (a, b)]
        if points[0] is None or points[1] is None:
            return None
        difference = mean_point(self._values, points[0]) - mean_point(self._values, points[1])
        length = float(np.linalg.norm(difference))
        if length == 0.0:
            return 0.0, 0.0
        unit = (difference / length)[None, :]
        blocks = [(k, unit / len(points[0])) for k in points[0]] + [(k, -unit / len(points[1])) for k in points[1]]
        return length, float(np.sqrt(self._system.covariance(blocks)[0, 0]))

    # Consistency ----------------------------------------------------------------------------------------------

    def _consistency(self, plain: Plain) -> Consistency:
        paths = {t.record.what: t.sigma for t in plain.priors if t.record.family in ("mount", "known distances")}
        cylinders, ways = compared_with_cloud(self._engine, self._active, self._system, self._values)
        told = cloud_event(plain.without, self._engine.end_ns)
        if told is not None and "mount_wrong" not in {event.kind for event in self._engine.events}:
            self._engine.events.append(told)
        moved = {f"{point} without {family}": sigma for (point, family), sigma in plain.without.items()}
        priors = [*plain.priors, *cylinders]
        out, clicks = self._solution.rejected, {p.id: p.picks for p in self._engine.pipes.points.values()}
        contradicted = [*contradictions(plain.families, out), *contradicted_points(clicks, out)]
        return judge(plain.families, priors, {**paths, **ways, **moved}, contradicted)

    def _streaming_difference(self) -> dict[str, float]:
        """iSAM2 against the batch optimum over the same factors, in sigmas, worst by kind of variable."""
        first, last = self._solution.first_values, self._engine.state.values
        worst: dict[str, float] = {}
        names = {
            "b": "o_T_b",
            "f": "o_T_f",
            "p": "points",
            "x": "o_T_m",
            "k": "intrinsics",
            "e": "extrinsics",
            "h": "pages",
        }
        count = self._engine.odometry.last_keyframe
        moved = first.localCoordinates(last)
        for key in self._system.columns:
            kind = keys.kind(key)
            if kind not in names or (kind == "x" and key not in (keys.keyframe(count), keys.keyframe(count // 2))):
                continue
            delta = moved.at(key)
            sigma = np.maximum(self._sigmas(key), 1e-12)
            worst[names[kind]] = max(worst.get(names[kind], 0.0), float(np.max(np.abs(delta) / sigma)))
        return worst
