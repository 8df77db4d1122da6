"""Places from which a further view would help: round the pipe, before a board, in what was recorded already."""

from collections.abc import Iterator
from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray

from ..factors import keys
from ..factors.rig import Board
from .advice_scene import Surroundings, View, look_at
from .engine import Engine

Float = NDArray[np.float64]

TURNS_DEG = (60.0, 75.0, 90.0)
"""How far round the pipe a new view stands from the old ones."""
APART_DEG = 50.0
"""... and at least so far from every one of them."""
BOARD_TILT_DEG = 27.0
BOARD_DISTANCES_M = (1.0, 1.3, 1.6)
RECORDED = 4
PLACES_PER_SECOND_BOARD = 8


@dataclass(frozen=True, slots=True)
class Place:
    """A view with its description."""

    view: View
    text: str


@dataclass(frozen=True, slots=True)
class Clicked:
    """One view in which a point was clicked."""

    camera: str
    stamp_ns: int
    key: int
    o_T_c: gtsam.Pose3


def clicked_views(scene: Surroundings, point_id: str) -> list[Clicked]:
    """The views of a point's picks, newest first, one per image."""
    found: dict[tuple[str, int], Clicked] = {}
    for where, pick in scene.engine.pipes.clicked:
        if pick.point_id == point_id:
            pose = scene.values.atPose3(where.key)
            o_T_c = (
                pose if pick.camera == "m_left" else pose.compose(scene.values.atPose3(keys.extrinsics(pick.camera)))
            )
            found[pick.camera, pick.stamp_ns] = Clicked(pick.camera, pick.stamp_ns, where.key, o_T_c)
    return sorted(found.values(), key=lambda c: (-c.stamp_ns, c.camera))


class Places:
    """Proposes views; keeps the landmarks that they share and the number of new keyframes."""

    def __init__(self, scene: Surroundings) -> None:
        self._scene = scene
        self._engine: Engine = scene.engine
        self._shared: set[int] = set()
        self.views: list[View] = []
        """All new keyframes."""

    def _new(self, o_T_m: gtsam.Pose3) -> View | None:
        view = self._scene.view(len(self.views), o_T_m, self._shared)
        if view is not None:
            self.views.append(view)
        return view

    def round_the_pipe(self, point_id: str) -> Iterator[Place]:
        """From beside the views that clicked the point, at their distance."""
        scene, known = self._scene, self._engine.pipes.points[point_id]
        o_p = scene.values.atPoint3(keys.point(known.index))
        views = [c for c in clicked_views(scene, point_id) if c.camera != "b_rgb"]
        if not views:
            return
        mean = np.mean([_unit(c.o_T_c.translation() - o_p) for c in views], axis=0)
        middle = max(views, key=lambda c: float(_unit(c.o_T_c.translation() - o_p) @ mean))
        axis = self._axis(known.pipe) if known.on_axis else middle.o_T_c.rotation().matrix()[:, 1]
        for turn in TURNS_DEG:
            for sign in (1.0, -1.0):
                eye = o_p + gtsam.Rot3.AxisAngle(axis, np.radians(sign * turn)).rotate(middle.o_T_c.translation() - o_p)
                if min(_apart_deg(eye, c.o_T_c.translation(), o_p) for c in views) < APART_DEG:
                    continue
                if scene.hidden(eye, o_p, scene.radius_of(known.pipe)):
                    continue
                view = self._new(look_at(eye, o_p, middle.o_T_c.rotation().matrix()[:, 1]))
                if view is not None:
                    away = float(np.linalg.norm(eye - o_p))
                    beside = _side(middle.o_T_c, eye)
                    yield Place(view, f"{turn:.0f}° {beside} round it, {away:.1f} m away")

    def _axis(self, pipe: str | None) -> Float:
        i = self._engine.pipes.cylinders[pipe or ""].index
        return _unit(self._scene.values.atPoint3(keys.axis_end(i)) - self._scene.values.atPoint3(keys.axis_start(i)))

    def recorded(self, point_id: str) -> list[tuple[Place, int]]:
        """Keyframes that show the point and were not clicked, with their stamps; those furthest from the others."""
        scene, known = self._scene, self._engine.pipes.points[point_id]
        o_p = scene.values.atPoint3(keys.point(known.index))
        views = clicked_views(scene, point_id)
        used = {c.key for c in views}
        furthest = max((float(np.linalg.norm(c.o_T_c.translation() - o_p)) for c in views), default=1.5)
        found: list[tuple[float, Place, int]] = []
        for i, stamp_ns in self._engine.odometry.keyframes_in(scene.values).items():
            pose = scene.values.atPose3(keys.keyframe(i))
            away = float(np.linalg.norm(pose.translation() - o_p))
            if keys.keyframe(i) in used or away > 1.5 * furthest or not scene.pixels("m_left", pose, o_p[None])[1][0]:
                continue
            apart = min((_apart_deg(pose.translation(), c.o_T_c.translation(), o_p) for c in views), default=90.0)
            text = f"{apart:.0f}° from the clicks"
            found.append((apart, Place(View(keys.keyframe(i), pose), text), stamp_ns))
        found.sort(key=lambda f: -f[0])
        clear = (f for f in found if not scene.hidden(f[1].view.o_T_m.translation(), o_p, scene.radius_of(known.pipe)))
        return [(place, stamp_ns) for _, (_, place, stamp_ns) in zip(range(RECORDED), clear, strict=False)]

    def before_board(self, board: Board) -> Iterator[Place]:
        """The whole board from 1 m or a little more, tilted to one of its four sides."""
        scene = self._scene
        o_T_f = scene.values.atPose3(self._engine.boards.key(board.id))
        corners = np.array([o_T_f.transformFrom(np.array([*m.centre_m, 0.0])) for m in board.markers])
        last = scene.values.atPose3(keys.keyframe(self._engine.odometry.last_keyframe))
        tilt = np.radians(BOARD_TILT_DEG)
        for x, y, name in ((1, 0, "right"), (-1, 0, "left"), (0, 1, "upper"), (0, -1, "lower")):
            direction = np.array([np.sin(tilt) * x, np.sin(tilt) * y, np.cos(tilt)])
            for distance in BOARD_DISTANCES_M:
                eye = o_T_f.transformFrom(distance * direction)
                pose = look_at(eye, o_T_f.translation(), last.rotation().matrix()[:, 1])
                if not all(scene.pixels(c, pose, corners)[1].all() for c in ("m_left", "m_right")):
                    continue
                view = self._new(pose)
                if view is not None:
                    yield Place(view, f"from {distance:.1f} m, {BOARD_TILT_DEG:.0f}° off, to its {name} side")
                break

    def between(self, o_T_rgb: gtsam.Pose3) -> tuple[View, gtsam.Pose3, str] | None:
        """A place for a further board that the Kinect's colour camera and a keyframe's place both look at."""
        scene = self._scene
        there = [*self._engine.odometry.keyframes_in(scene.values)]
        some = there[:: max(1, len(there) // PLACES_PER_SECOND_BOARD)]
        eyes = [scene.values.atPose3(keys.keyframe(i)) for i in some]
        options = []
        for x in (0.0, -0.35, 0.35):
            for z in (1.2, 1.6):
                spot = o_T_rgb.transformFrom(np.array([x, 0.0, z]))
                if scene.hidden(o_T_rgb.translation(), spot, 0.0):
                    continue
                for eye in eyes:
                    away = float(np.linalg.norm(eye.translation() - spot))
                    open_deg = _apart_deg(eye.translation(), o_T_rgb.translation(), spot)
                    if 0.7 < away < 1.8 and open_deg < 100 and not scene.hidden(eye.translation(), spot, 0.0):
                        options.append((abs(away - 1.0) + open_deg / 100, spot, eye, z))
        for _, spot, eye, z in sorted(options, key=lambda o: o[0]):
            view = self._new(look_at(eye.translation(), spot, eye.rotation().matrix()[:, 1]))
            if view is not None:
                middle = _unit(_unit(eye.translation() - spot) + _unit(o_T_rgb.translation() - spot))
                facing = look_at(spot + middle, spot, o_T_rgb.rotation().matrix()[:, 1])
                # The page's x points right, y up and z out of it, to those who look at it.
                page = gtsam.Rot3(facing.rotation().matrix() @ np.diag([1.0, -1.0, -1.0]))
                return view, gtsam.Pose3(page, spot), f"{z:.1f} m before the Kinect, halfway to the camera"
        return None


def _unit(v: Float) -> Float:
    return v / np.linalg.norm(v)


def _apart_deg(a: Float, b: Float, apex: Float) -> float:
    """Angle between two directions from a point."""
    return float(np.degrees(np.arccos(np.clip(_unit(a - apex) @ _unit(b - apex), -1, 1))))


def _side(o_T_c: gtsam.Pose3, eye: Float) -> str:
    """Where a place lies, to somebody who looks through a camera."""
    x, y, _ = o_T_c.transformTo(eye)
    if abs(x) >= abs(y):
        return "to the right" if x > 0 else "to the left"
    return "downwards" if y > 0 else "upwards"
