"""Picks become points, outlines become pipes: what the operator named, in {o}."""

import gtsam
import numpy as np
from numpy.typing import NDArray

from ..factors import keys
from ..factors.measurements import OutlineSighting, Pick, Rejection
from ..factors.noise import floored, gaussian, robust, sigmas
from ..factors.pipe import (
    axis_gauge,
    inset_prior,
    line_planes,
    on_axis_factor,
    outline_factor,
    radius_prior,
    tangency_covariance,
)
from ..factors.projection import depth_factor, machine_projection, mobile_projection
from ..factors.rig import Pipe, Rig
from .graph import Record, State, Update
from .pipe_parts import PipeCylinder, PipePoint, SeenFrom, intersection

Float = NDArray[np.float64]

FAMILY = "picks"
OUTLINE = "pipe outline"
WIDTH = "pipe width"
AXIS_ROLES = ("cut", "grasp")
WIDE_RADIUS_M = (0.05, 0.04)
"""Pipes that are cut by hand-guided machines: 20 to 180 mm diameter within two sigma; a prior that decides nothing."""
GAUGE_HALF_LENGTH_M = 0.25
LEAST_SPAN_M = 0.1
"""Two picks nearer to each other give no direction."""
PART_M = 0.1
"""A pipe is taken to go on so far beyond its picks."""
EDGE_FLOOR_PX = 0.3
"""Shading and a background of like brightness move an edge: rms on rendered recordings, beyond what its fit says."""
INSET_SHARE = 0.05
"""Part of a pipe's radius by which its visible edges may lie within its outline, in all views alike: stripes of its
finish, highlights and shadow have edges along the pipe as well. Rms over pipes in rendered recordings: 4.5 %."""


class Pipes:
    """All pipe points and pipes of one run."""

    def __init__(self, rig: Rig, state: State) -> None:
        self._rig = rig
        self._state = state
        self.points: dict[str, PipePoint] = {}
        self.cylinders: dict[str, PipeCylinder] = {p.id: PipeCylinder(i, p) for i, p in enumerate(rig.pipes)}
        self.rejected: list[Rejection] = []
        self.clicked: list[tuple[SeenFrom, Pick]] = []
        """Picks that are in the graph, in the order of their entry."""
        self.outlined: list[tuple[SeenFrom, OutlineSighting]] = []
        """Outlines that are in the graph."""

    def held_keyframes(self) -> set[int]:
        """Keys of the poses on which picks and outlines wait."""
        points = {where.key for point in self.points.values() for where, _ in point.held}
        return points | {where.key for cylinder in self.cylinders.values() for where, _ in cylinder.held}

    def forget(self, poses: set[int]) -> None:
        """These have left the graph; what was seen from them stays there."""
        self.clicked = [(where, pick) for where, pick in self.clicked if where.key not in poses]
        self.outlined = [(where, seen) for where, seen in self.outlined if where.key not in poses]

    def pipe_of(self, point_id: str) -> str:
        """The pipe that a point is on."""
        for pipe in self._rig.pipes:
            if point_id in pipe.points or not pipe.points:
                return pipe.id
        return "pipe0"

    def pick(self, pick: Pick, seen_from: SeenFrom, depth_m: tuple[float, float] | None) -> Update:
        """A click. `depth_m` is the depth of the surface under it and its sigma, where it could be measured."""
        point = self._point(pick)
        point.held.append((seen_from, pick))
        update = Update()
        if not point.known:
            start = self._start(point, depth_m)
            if start is None:
                return update
            update.guess(keys.point(point.index), start)
            point.known = True
        for where, held in point.held:
            self._observe(point, where, held, update)
        point.held.clear()
        if depth_m is not None and pick.camera == "m_left":
            self._observe_depth(point, seen_from, pick, depth_m, update)
        self._attach(point, update)
        return update

    def _point(self, pick: Pick) -> PipePoint:
        if pick.point_id not in self.points:
            pipe = self.pipe_of(pick.point_id) if pick.role in AXIS_ROLES else None
            self.points[pick.point_id] = PipePoint(len(self.points), pick.point_id, pick.role, pipe)
        return self.points[pick.point_id]

    def _start(self, point: PipePoint, depth_m: tuple[float, float] | None) -> Float | None:
        """Where the point begins: from two rays with parallax, or from a measured depth."""
        rays = [self.ray(where, pick.camera, pick.px) for where, pick in point.held]
        place = intersection(rays)
        if place is not None:
            return place
        if depth_m is None:
            return None
        origin, direction = rays[-1]
        radius = WIDE_RADIUS_M[0] if point.role in AXIS_ROLES else 0.0
        forward = point.held[-1][0].o_T_c.rotation().matrix()[:, 2]
        return origin + direction * ((depth_m[0] + radius) / float(direction @ forward))

    def ray(self, where: SeenFrom, camera: str, px: Float) -> tuple[Float, Float]:
        """Origin and direction in {o} of what is seen at a pixel."""
        K = self._state.intrinsics(keys.intrinsics(camera)).K()
        direction = where.o_T_c.rotation().matrix() @ np.linalg.solve(K, np.array([px[0], px[1], 1.0]))
        return where.o_T_c.translation(), direction / np.linalg.norm(direction)

    def _observe(self, point: PipePoint, where: SeenFrom, pick: Pick, update: Update) -> None:
        covariance = floored(pick.covariance_px2, self._rig.noise.pick_floor_px)
        model = robust(gaussian(covariance), self._rig.gates.robust_sigma)
        key = keys.point(point.index)
        if pick.camera == "b_rgb":
            factor = machine_projection(pick.px, model, where.key, key)
        else:
            factor = mobile_projection(pick.camera, pick.px, model, where.key, key)
        what = f"pick {pick.point_id} in {pick.camera}"
        update.add(factor, Record(FAMILY, f"picks {pick.point_id}", pick.stamp_ns, what, camera=pick.camera))
        self.clicked.append((where, pick))
        point.picks += 1
        point.stamp_ns = max(point.stamp_ns, pick.stamp_ns)

    def _observe_depth(
        self, point: PipePoint, where: SeenFrom, pick: Pick, depth_m: tuple[float, float], update: Update
    ) -> None:
        """The surface's depth under a click. A point on the axis lies a radius behind it, and radii are only roughly
        known until the pipe's outline is seen: for it this says little, but enough to place one click."""
        mean, sigma = depth_m
        if point.role in AXIS_ROLES:
            mean, sigma = mean + WIDE_RADIUS_M[0], float(np.hypot(sigma, WIDE_RADIUS_M[1]))
        model = robust(sigmas([sigma]), self._rig.gates.robust_sigma)
        what = f"stereo depth under pick {pick.point_id}"
        factor = depth_factor(where.key, keys.point(point.index), mean, model)
        update.add(factor, Record(FAMILY, f"depth under {pick.point_id}", pick.stamp_ns, what, camera=pick.camera))

    # Pipes ----------------------------------------------------------------------------------------------------

    def outline(self, sighting: OutlineSighting, seen_from: SeenFrom) -> Update:
        """Two edges of a pipe in one image."""
        cylinder = self._cylinder(sighting.pipe_id)
        cylinder.held.append((seen_from, sighting))
        update = Update()
        if not cylinder.known and not self._start_pipe(cylinder, update):
            return update
        for where, held in cylinder.held:
            self._observe_outline(cylinder, where, held, update)
        cylinder.held.clear()
        for point in self.points.values():
            self._attach(point, update)
        return update

    def _cylinder(self, pipe_id: str) -> PipeCylinder:
        if pipe_id not in self.cylinders:
            self.cylinders[pipe_id] = PipeCylinder(len(self.cylinders), Pipe(id=pipe_id))
        return self.cylinders[pipe_id]

    def _start_pipe(self, cylinder: PipeCylinder, update: Update) -> bool:
        """First axis and radius from the outlines and a point on the pipe."""
        anchor = next((p for p in self.points.values() if p.known and p.pipe == cylinder.pipe.id), None)
        if anchor is None or not self._state.has(keys.point(anchor.index)):
            return False
        place = self._state.point(keys.point(anchor.index))
        direction = self._direction(cylinder, place)
        if direction is None:
            return False
        widths = [self._radius(where, sighting, place) for where, sighting in cylinder.held]
        radius = float(np.median(widths))
        self._enter_pipe(cylinder, place, direction, radius, cylinder.held[0][1].stamp_ns, update)
        return True

    def begin(self, pipe_id: str, middle: Float, direction: Float, radius_m: float, stamp_ns: int) -> Update:
        """A pipe that something else than edges has shown: its axis about a point of {o}; its picks lie on it now."""
        update, cylinder = Update(), self._cylinder(pipe_id)
        self._enter_pipe(cylinder, middle, direction / np.linalg.norm(direction), radius_m, stamp_ns, update)
        for point in self.points.values():
            self._attach(point, update)
        return update

    @staticmethod
    def _enter_pipe(
        cylinder: PipeCylinder, place: Float, direction: Float, radius: float, stamp_ns: int, update: Update
    ) -> None:
        """Axis and radius as variables, with what is known of any pipe."""
        i = cylinder.index
        ends = [place - GAUGE_HALF_LENGTH_M * direction, place + GAUGE_HALF_LENGTH_M * direction]
        for key, end in zip((keys.axis_start(i), keys.axis_end(i)), ends, strict=True):
            update.guess(key, end)
            record = Record("gauge", "axis gauge", stamp_ns, "place along the axis", rejectable=False)
            update.add(axis_gauge(key, end, direction), record)
        update.guess(keys.radius(i), np.array([np.clip(radius, 0.005, 0.5)]))
        nominal = cylinder.pipe.nominal_diameter_m
        mean, sigma = (nominal / 2, cylinder.pipe.diameter_sigma_m / 2) if nominal else WIDE_RADIUS_M
        record = Record("calibration priors", "pipe radius", stamp_ns, "radius prior", rejectable=False)
        update.add(radius_prior(i, mean, sigma), record)
        cylinder.known = True

    def _direction(self, cylinder: PipeCylinder, place: Float) -> Float | None:
        """The axis lies in the middle plane of every outline: the direction across all their normals.

        One view fixes only the angle in the image; two views, or two points on the pipe, fix the direction. With one
        view the axis is taken across the line of sight, for a start.
        """
        rows = []
        for where, sighting in cylinder.held:
            middle, _ = self._planes(where, sighting)
            rows.append(middle)
        others = [
            self._state.point(keys.point(p.index))
            for p in self.points.values()
            if p.known and p.pipe == cylinder.pipe.id and self._state.has(keys.point(p.index))
        ]
        normals = np.array(rows)
        _, singular, vectors = np.linalg.svd(normals)
        if len(rows) >= 2 and singular[1] > 0.1 * singular[0]:
            return vectors[-1]
        spans = [o - place for o in others if np.linalg.norm(o - place) > 0.05]
        if spans:
            return spans[0] / np.linalg.norm(spans[0])
        sight = place - cylinder.held[-1][0].o_T_c.translation()
        direction = np.cross(normals[-1], sight)
        length = float(np.linalg.norm(direction))
        return direction / length if length > 1e-6 else None

    def _planes(self, where: SeenFrom, sighting: OutlineSighting) -> tuple[Float, Float]:
        """Normal of the middle plane (3,) and both outward normals (2, 3), in {o}."""
        K = self._state.intrinsics(keys.intrinsics(sighting.camera)).K()
        normals, _ = line_planes(sighting.lines, K)
        o_n = normals @ where.o_T_c.rotation().matrix().T
        middle = o_n[0] - o_n[1]
        return middle / np.linalg.norm(middle), o_n

    def _radius(self, where: SeenFrom, sighting: OutlineSighting, place: Float) -> float:
        _, normals = self._planes(where, sighting)
        distance = normals @ (place - where.o_T_c.translation())
        return float(-np.mean(distance))

    def _observe_outline(
        self, cylinder: PipeCylinder, where: SeenFrom, sighting: OutlineSighting, update: Update
    ) -> None:
        i = cylinder.index
        start, end = (
            update.values.atPoint3(k) if update.values.exists(k) else self._state.point(k)
            for k in (keys.axis_start(i), keys.axis_end(i))
        )
        a, b = where.o_T_c.transformTo(start), where.o_T_c.transformTo(end)
        if a[2] < 0.1 or b[2] < 0.1:
            self.rejected.append(
                Rejection(
                    sighting.stamp_ns,
                    OUTLINE,
                    f"outline of {cylinder.pipe.id} in {sighting.camera}",
                    "axis behind the camera, m",
                    float(min(a[2], b[2])),
                    0.1,
                )
            )
            return
        K = self._state.intrinsics(keys.intrinsics(sighting.camera)).K()
        self._open_inset(i, sighting.stamp_ns, update)
        for edge in range(2):
            # Lines are positive outside the pipe; the factor wants the axis on the positive side.
            line, own = -sighting.lines[edge], sighting.covariance[edge] + np.diag([EDGE_FLOOR_PX**2, 0.0])
            covariance = tangency_covariance(line, own, sighting.foot_px[edge], K, a, b)
            model = robust(gaussian(covariance), self._rig.gates.robust_sigma)
            factor = outline_factor(sighting.camera, line, model, where.key, i)
            what = f"edge {edge} of {cylinder.pipe.id} in {sighting.camera}"
            source = f"outline {sighting.camera}"
            update.add(factor, Record(OUTLINE, source, sighting.stamp_ns, what, camera=sighting.camera))
        self.outlined.append((where, sighting))
        cylinder.outlines += 1

    def _open_inset(self, pipe: int, stamp_ns: int, update: Update) -> None:
        key = keys.inset(pipe)
        if update.values.exists(key) or self._state.has(key):
            return
        thickness = keys.radius(pipe)
        radius = update.values.atVector(thickness) if update.values.exists(thickness) else self._state.vector(thickness)
        update.guess(key, np.zeros(1))
        record = Record("calibration priors", "pipe edges", stamp_ns, "inset of a pipe's edges", rejectable=False)
        update.add(inset_prior(pipe, INSET_SHARE * float(radius[0])), record)

    def _attach(self, point: PipePoint, update: Update) -> None:
        """Puts a point on the axis of its pipe, once both are known."""
        if not point.known or point.on_axis or point.pipe is None:
            return
        cylinder = self.cylinders.get(point.pipe)
        if cylinder is None or not cylinder.known:
            return
        factor = on_axis_factor(keys.point(point.index), cylinder.index)
        record = Record("gauge", "on axis", point.stamp_ns, f"point {point.id} is on the axis", rejectable=False)
        update.add(factor, record)
        point.on_axis = True

    def axis(self, pipe_id: str) -> tuple[Float, Float, float] | None:
        """Axis points in {o} and radius of a pipe as believed now."""
        cylinder = self.cylinders.get(pipe_id)
        if cylinder is None or not cylinder.known or not self._state.has(keys.radius(cylinder.index)):
            return None
        i = cylinder.index
        radius = float(self._state.vector(keys.radius(i))[0])
        return self._state.point(keys.axis_start(i)), self._state.point(keys.axis_end(i)), radius

    def known_part(self, pipe_id: str) -> tuple[Float, Float] | None:
        """The part of a pipe's axis about its picks, {o}: by its cylinder, or before there is one by two picks."""
        places, axis = self.places(pipe_id), self.axis(pipe_id)
        if axis is not None:
            start, direction = axis[0], axis[1] - axis[0]
        else:
            spans = [place - places[0] for place in places[1:]]
            direction = max(spans, key=lambda span: float(np.linalg.norm(span)), default=np.zeros(3))
            if np.linalg.norm(direction) < LEAST_SPAN_M:
                return None
            start = places[0]
        direction = direction / np.linalg.norm(direction)
        along = [float((p - start) @ direction) for p in places] or [0.0]
        return start + (min(along) - PART_M) * direction, start + (max(along) + PART_M) * direction

    def width(self, pipe_id: str, radius_m: float, sigma_m: float, stamp_ns: int) -> Update:
        """A radius that was measured by something else than edges; empty while there is no cylinder."""
        update, cylinder = Update(), self.cylinders.get(pipe_id)
        if cylinder is not None and cylinder.known:
            record = Record(WIDTH, "texture beside the pipe", stamp_ns, f"width of {pipe_id} by texture")
            model = robust(sigmas([sigma_m]), self._rig.gates.robust_sigma)
            update.add(gtsam.PriorFactorVector(keys.radius(cylinder.index), np.array([radius_m]), model), record)
        return update

    def outlined_of(self, pipe_id: str) -> list[tuple[SeenFrom, OutlineSighting]]:
        """Outlines of one pipe that are in the graph."""
        return [(where, seen) for where, seen in self.outlined if seen.pipe_id == pipe_id]

    def take_back(self, pipe_id: str, stamps: set[int]) -> None:
        """Outlines that leave the graph again."""
        before = len(self.outlined)
        self.outlined = [p for p in self.outlined if not (p[1].pipe_id == pipe_id and p[1].stamp_ns in stamps)]
        self.cylinders[pipe_id].outlines -= before - len(self.outlined)

    def begin_anew(self, pipe_id: str) -> None:
        """Axis and outlines have left the graph; its points and their clicks are there still."""
        cylinder = self.cylinders[pipe_id]
        cylinder.known, cylinder.outlines = False, 0
        cylinder.held.clear()
        self.outlined = [(where, seen) for where, seen in self.outlined if seen.pipe_id != pipe_id]
        for point in self.points.values():
            if point.pipe == pipe_id:
                point.on_axis = False

    def named(self) -> list[str]:
        """Pipes that something is known of."""
        return list(dict.fromkeys([*self.cylinders, *(p.pipe for p in self.points.values() if p.pipe is not None)]))

    def places(self, pipe_id: str) -> list[Float]:
        """Points on a pipe as believed now, in {o}."""
        on_it = [p for p in self.points.values() if p.known and p.pipe == pipe_id]
        return [self._state.point(keys.point(p.index)) for p in on_it if self._state.has(keys.point(p.index))]

    def held_back(self) -> list[Rejection]:
        """Picks and outlines that never entered."""
        picks = [
            Rejection(p.stamp_ns, FAMILY, f"pick {p.point_id} in {p.camera}", "one ray and no depth; views", 1.0, 2.0)
            for point in self.points.values()
            for _, p in point.held
        ]
        outlines = [
            Rejection(
                s.stamp_ns, OUTLINE, f"outline of {c.pipe.id} in {s.camera}", "no point on the pipe; outlines", 1.0, 1.0
            )
            for c in self.cylinders.values()
            for _, s in c.held
        ]
        return picks + outlines
