"""The robot cell: room, machine with Kinect and page, pipe, panel, clutter, lamps. World {w}: z up, metres.

The machine's chassis frame {c} stands on the floor under the Kinect, y forward, z up.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from . import textures
from .faults import PAGE_M, TrueRig
from .page import page_texture
from .rigid import inverse, looking, rigid, transform
from .scenario import Scenario
from .stage import Lamp
from .surfaces import Body, Patch, Rectangle, Texture, Tube, across, box, rod

Float = NDArray[np.float64]
PLACES = {"A": (-0.45, 1.85), "B": (0.05, 1.45), "C": (0.40, 2.00)}
"""Where the pipe stands before the Kinect, metres to the side of the board and ahead."""
KINECT_HEIGHT_M = 1.15


@dataclass(frozen=True, slots=True)
class PipeTruth:
    """The pipe that is cut, in {w}."""

    foot_m: Float
    axis: Float
    """Unit, upwards."""
    radius_m: float

    def at_height(self, z: float) -> Float:
        """Point on the axis at a height."""
        return self.foot_m + self.axis * (z - self.foot_m[2]) / self.axis[2]


@dataclass(frozen=True, slots=True)
class Cell:
    """Everything that stands in the cell."""

    bodies: list[Body]
    lamps: list[Lamp]
    pipe: PipeTruth
    points: dict[str, tuple[str, Float]]
    """Point id -> (role, place on the axis in {w})."""
    c_T_b: Float
    c_T_f: Float
    side: float
    room_m: tuple[float, float, float, float, float]
    """Left, right, back, front wall and the ceiling."""


def build_cell(scenario: Scenario, truth: TrueRig, side: float, rng: np.random.Generator) -> Cell:
    """Place everything. `side` is +1 or -1: on which side of the panel the mobile camera will go."""
    room = (
        -2.5 + rng.normal(0, 0.1),
        2.5 + rng.normal(0, 0.1),
        -1.7 + rng.normal(0, 0.1),
        3.5 + rng.normal(0, 0.1),
        2.8,
    )
    pitch = -rng.uniform(0.05, 0.14)
    # Where the page hangs is what was measured; the Kinect is off by the mount's error.
    c_T_b_nominal = looking((0, 0, KINECT_HEIGHT_M), 0.0, pitch)
    c_T_f = c_T_b_nominal @ inverse(truth.f_T_b)
    c_T_b = c_T_b_nominal
    pipe = _pipe_truth(scenario, side, rng)
    points = {"P1": ("cut", pipe.at_height(rng.uniform(1.12, 1.28)))}
    points["P2"] = ("grasp", pipe.at_height(points["P1"][1][2] - rng.uniform(0.22, 0.3)))
    bodies = [
        Body("room", [*_room(room, rng), *_clutter(room, pipe, side, rng), *_panel(scenario, pipe, rng)]),
        Body("pipe", _pipe(pipe, room[4], points, rng)),
        Body("machine", _machine(c_T_b, side, rng)),
        Body("page", _page(truth)),
    ]
    if scenario.pipe.second:
        bodies.append(Body("second_pipe", _second_pipe(pipe, side, room[4], rng)))
    if scenario.timeline.arm_moves:
        bodies += [Body("upper_arm", _arm(0.75, 0.06, rng)), Body("fore_arm", _arm(0.65, 0.045, rng))]
    return Cell(bodies, _lamps(room, scenario.light.level, rng), pipe, points, c_T_b, c_T_f, side, room)


def _pipe_truth(scenario: Scenario, side: float, rng: np.random.Generator) -> PipeTruth:
    diameter, tilt = rng.uniform(0.060, 0.110), rng.uniform(0.0, 0.3)
    if scenario.pipe.diameter_m is not None:
        diameter = scenario.pipe.diameter_m
    if scenario.pipe.tilt_rad is not None:
        tilt = scenario.pipe.tilt_rad
    x, y = PLACES[scenario.place]
    middle = np.array([side * x, y, 1.1]) + np.array([*rng.normal(0, 0.05, 2), 0])
    bearing = rng.uniform(0, 2 * np.pi)
    axis = np.array([np.sin(tilt) * np.cos(bearing), np.sin(tilt) * np.sin(bearing), np.cos(tilt)])
    return PipeTruth(middle - axis * 1.1 / axis[2], axis, diameter / 2)


def _pipe(
    pipe: PipeTruth, ceiling: float, points: dict[str, tuple[str, Float]], rng: np.random.Generator
) -> list[Patch]:
    """Floor to ceiling, with welded flanges above and below the cut, clamps and a branch."""
    look = textures.steel(rng.uniform(0.22, 0.38))
    top = pipe.at_height(ceiling)
    length = float(np.linalg.norm(top - pipe.foot_m))
    patches = [Patch(Tube(top, -pipe.axis, pipe.radius_m, length, 160), look, 0.0015, specular=rng.uniform(0.35, 0.6))]
    heights = [points["P2"][1][2] - rng.uniform(0.25, 0.4), points["P1"][1][2] + rng.uniform(0.22, 0.4)]
    for height in heights:
        centre = pipe.at_height(height)
        for offset, wide in ((0.012, 1.55), (-0.012, 1.55)):
            start = centre + pipe.axis * (offset - 0.010)
            flange = rod(start, start + pipe.axis * 0.02, wide * pipe.radius_m, look, 0.0015, 0.3)
            patches += flange
        patches += _bolts(centre, pipe, 1.28 * pipe.radius_m, look)
        patches += rod(centre - 0.09 * pipe.axis, centre + 0.09 * pipe.axis, 1.06 * pipe.radius_m, look, 0.0015, 0.3)
    away = np.array([*rng.normal(size=2), 0.0])
    away -= pipe.axis * (away @ pipe.axis)
    away /= np.linalg.norm(away)
    joint = pipe.at_height(heights[1] + rng.uniform(0.3, 0.5))
    patches += rod(joint, joint + away * 0.35, 0.55 * pipe.radius_m, look, 0.0015, 0.35)
    return patches


def _bolts(centre: Float, pipe: PipeTruth, radius_m: float, look: Texture) -> list[Patch]:
    first, second = across(pipe.axis)
    patches = []
    for angle in np.arange(8) * np.pi / 4:
        place = centre + radius_m * (np.cos(angle) * first + np.sin(angle) * second)
        patches += rod(place - 0.035 * pipe.axis, place + 0.035 * pipe.axis, 0.008, look, 0.002, 0.3, segments=12)
    return patches


def _second_pipe(pipe: PipeTruth, side: float, ceiling: float, rng: np.random.Generator) -> list[Patch]:
    """A neighbour 0.2 to 0.3 m behind, as the mobile camera sees it, and nearly parallel."""
    foot = pipe.foot_m + np.array([-side * rng.uniform(0.18, 0.26), rng.uniform(-0.1, 0.15), 0])
    axis = pipe.axis + rng.normal(0, 0.02, 3)
    top = foot + axis * ceiling / axis[2]
    return rod(foot, top, rng.uniform(0.03, 0.05), textures.steel(rng.uniform(0.22, 0.38)), 0.0015, 0.4)


def _panel(scenario: Scenario, pipe: PipeTruth, rng: np.random.Generator) -> list[Patch]:
    """A bare sheet between the Kinect and the pipe, wide enough for both of its cameras."""
    if not scenario.pipe.hidden:
        return []
    share = 0.75 / pipe.at_height(1.1)[1]
    reach = [pipe.at_height(z)[0] * share for z in (0.2, 1.9)]
    left, right = min(reach) - 0.11 - pipe.radius_m, max(reach) + 0.11 + pipe.radius_m
    size = (right - left, 0.03, rng.uniform(1.9, 2.1))
    look = textures.plain(rng.uniform(0.45, 0.65), 0.008, 0.02)
    return [
        *box(size, look, ((left + right) / 2, 0.72, size[2] / 2), 0.003),
        *box((0.05, 0.4, 0.05), textures.plain(0.3), (left + 0.05, 0.72, 0.025), 0.004),
        *box((0.05, 0.4, 0.05), textures.plain(0.3), (right - 0.05, 0.72, 0.025), 0.004),
    ]


def _wall(origin: tuple, right: tuple, width: float, height: float) -> Rectangle:
    return Rectangle(np.array(origin), np.array(right, dtype=float), np.array([0, 0, -1.0]), width, height)


def _room(room: tuple[float, float, float, float, float], rng: np.random.Generator) -> list[Patch]:
    left, right, back, front, top = room
    wide, deep = right - left, front - back
    walls = [
        _wall((left, front, top), (1, 0, 0), wide, top),
        _wall((right, front, top), (0, -1, 0), deep, top),
        _wall((right, back, top), (-1, 0, 0), wide, top),
        _wall((left, back, top), (0, 1, 0), deep, top),
    ]
    patches = []
    for wall in walls:
        tint = (rng.uniform(0.6, 0.8), rng.uniform(0.7, 0.85), 1.0)
        look = textures.brick(rng.uniform(0.2, 0.42), (rng.uniform(0.18, 0.24), rng.uniform(0.06, 0.08)))
        patches.append(Patch(wall, look, 0.0025, tint))
        patches += _on_wall(wall, rng)
    floor = Rectangle(np.array([left, front, 0]), np.array([1.0, 0, 0]), np.array([0, -1.0, 0]), wide, deep)
    ceiling = Rectangle(np.array([left, back, top]), np.array([1.0, 0, 0]), np.array([0, 1.0, 0]), wide, deep)
    patches += [
        Patch(floor, textures.concrete(rng.uniform(0.25, 0.4)), 0.003),
        Patch(ceiling, textures.plain(0.4, 0.02, 0.08), 0.005),
    ]
    for y in np.arange(back + 0.6, front, rng.uniform(0.9, 1.2)):
        patches += box((wide, 0.12, 0.16), textures.plain(0.3, 0.03, 0.05), ((left + right) / 2, y, top - 0.08), 0.005)
    return patches


def _on_wall(wall: Rectangle, rng: np.random.Generator) -> list[Patch]:
    """Posters, conduits, cabinets and stripes on one wall."""
    patches = []
    out = np.cross(wall.ev, wall.eu)
    for u in np.arange(0.25, wall.width_m - 0.5, 0.62):
        if rng.random() < 0.8:
            size = rng.uniform(0.28, 0.6), rng.uniform(0.3, 0.75)
            v = rng.uniform(0.35, 1.5)
            origin = wall.origin + (u + rng.uniform(0, 0.1)) * wall.eu + v * wall.ev + 0.004 * out
            tint = (rng.uniform(0.5, 1), rng.uniform(0.6, 1), rng.uniform(0.5, 1))
            patches.append(Patch(Rectangle(origin, wall.eu, wall.ev, *size), textures.poster, 0.0015, tint))
    for _ in range(int(rng.integers(1, 3))):
        u, radius = rng.uniform(0.2, wall.width_m - 0.2), rng.uniform(0.012, 0.03)
        start = wall.origin + u * wall.eu + 0.05 * out
        end = start + wall.height_m * wall.ev
        patches += rod(start, end, radius, textures.plain(rng.uniform(0.2, 0.6)), 0.003, 0.05, segments=24)
    v = rng.uniform(0.25, 0.6)
    start = wall.origin + v * wall.ev + 0.07 * out + 0.05 * wall.eu
    end = start + (wall.width_m - 0.1) * wall.eu
    patches += rod(start, end, 0.02, textures.plain(rng.uniform(0.2, 0.6)), 0.003, 0.05, segments=24)
    origin = wall.origin + (wall.height_m - 0.25) * wall.ev + 0.003 * out + 0.3 * wall.eu
    patches.append(Patch(Rectangle(origin, wall.eu, wall.ev, rng.uniform(0.8, 2.0), 0.12), textures.stripes, 0.002))
    return patches


def _clutter(
    room: tuple[float, float, float, float, float], pipe: PipeTruth, side: float, rng: np.random.Generator
) -> list[Patch]:
    """Crates, cabinets and drums along the walls, and low things on the floor."""
    left, right, back, front, _ = room
    patches = []
    spots = [(x, front - 0.35) for x in np.arange(left + 0.4, right - 0.3, 0.75)]
    spots += [(left + 0.35, y) for y in np.arange(back + 0.5, front - 0.8, 0.8)]
    spots += [(right - 0.35, y) for y in np.arange(back + 0.5, front - 0.8, 0.8)]
    spots += [(x, back + 0.35) for x in np.arange(left + 0.9, right - 0.8, 0.8)]
    for x, y in spots:
        kind = rng.random()
        if kind < 0.45:
            patches += _crates(x, y, rng)
        elif kind < 0.65:
            patches += _cabinet(x, y, (left + right) / 2, (back + front) / 2, rng)
        elif kind < 0.85:
            patches += _drum(x, y, rng)
    for _ in range(7):
        x, y = rng.uniform(left + 0.8, right - 0.8), rng.uniform(0.9, front - 0.7)
        if np.hypot(*(np.array([x, y]) - pipe.at_height(0.2)[:2])) > 0.3:
            size = tuple(rng.uniform(0.12, 0.35, 3))
            turn = rng.uniform(0, np.pi)
            patches += box(size, textures.wood(rng.uniform(0.2, 0.45)), (x, y, size[2] / 2), 0.0025, yaw_rad=turn)
    return patches


def _crates(x: float, y: float, rng: np.random.Generator) -> list[Patch]:
    patches, base = [], 0.0
    for _ in range(int(rng.integers(1, 4))):
        size = (rng.uniform(0.35, 0.55), rng.uniform(0.35, 0.55), rng.uniform(0.25, 0.45))
        place = (x + rng.normal(0, 0.04), y + rng.normal(0, 0.04), base + size[2] / 2)
        tint = (rng.uniform(0.5, 0.7), rng.uniform(0.7, 0.9), 1.0)
        look = textures.wood(rng.uniform(0.22, 0.45))
        patches += box(size, look, place, 0.0025, tint, yaw_rad=rng.normal(0, 0.15))
        base += size[2]
    return patches


def _cabinet(x: float, y: float, towards_x: float, towards_y: float, rng: np.random.Generator) -> list[Patch]:
    size = (rng.uniform(0.4, 0.55), rng.uniform(0.35, 0.5), rng.uniform(1.0, 1.7))
    turn = np.round(np.arctan2(towards_x - x, -(towards_y - y)) / (np.pi / 2)) * np.pi / 2
    tint = (rng.uniform(0.6, 1), rng.uniform(0.7, 1), rng.uniform(0.6, 1))
    return box(size, textures.grille, (x, y, size[2] / 2), 0.0025, tint, yaw_rad=turn)


def _drum(x: float, y: float, rng: np.random.Generator) -> list[Patch]:
    radius, height = rng.uniform(0.2, 0.29), rng.uniform(0.7, 0.9)

    def look(width_m: float, height_m: float, texel_m: float, generator: np.random.Generator) -> textures.Image:
        image = textures.plain(rng_level, 0.01, 0.04)(width_m, height_m, texel_m, generator)
        for share in (0.3, 0.66):
            image[int(share * len(image)) : int(share * len(image)) + max(1, int(0.02 / texel_m))] *= 0.5
        textures.word(image, texel_m, generator, 0.15, 0.08)
        return image

    rng_level = rng.uniform(0.2, 0.5)
    tint = (rng.uniform(0.4, 1), rng.uniform(0.5, 1), rng.uniform(0.5, 1))
    top, bottom = np.array([x, y, height]), np.array([x, y, 0.0])
    return rod(top, bottom, radius, look, 0.0025, 0.06, 64, tint)


def _machine(c_T_b: Float, side: float, rng: np.random.Generator) -> list[Patch]:
    """Tracks, body, mast, the Kinect's housing behind its lenses, a holder for the page, two folded arms. In {c}."""
    metal, dark = textures.plain(rng.uniform(0.35, 0.55), 0.015, 0.05), textures.plain(0.12, 0.03, 0.03)
    yellow = (0.25, 0.75, 1.0)
    patches = [
        *box((0.75, 1.1, 0.5), metal, (0, -0.55, 0.55), 0.003, yellow),
        *box((0.5, 0.6, 0.25), textures.grille, (0, -0.7, 0.92), 0.003, yellow),
        *box((0.22, 1.3, 0.35), dark, (-0.5, -0.55, 0.175), 0.004),
        *box((0.22, 1.3, 0.35), dark, (0.5, -0.55, 0.175), 0.004),
        *box((0.08, 0.08, 0.6), metal, (0.0, -0.12, 0.82), 0.003, yellow),
        *box((side * 0.7, 0.03, 0.03) if side > 0 else (0.7, 0.03, 0.03), dark, (side * 0.2, -0.16, 1.08), 0.003),
    ]
    for patch in box((0.28, 0.06, 0.06), dark, (0.0125, 0.04, 0.0), 0.002):
        patches.append(_turned(patch, c_T_b @ rigid(Rotation.from_euler("x", -90, degrees=True))))
    for arm in (-1.0, 1.0):
        shoulder = np.array([arm * 0.32, 0.02, 0.72])
        elbow = shoulder + np.array([arm * 0.06, 0.38, -0.28])
        hand = elbow + np.array([-arm * 0.02, 0.12, 0.22])
        patches += rod(shoulder, elbow, 0.05, metal, 0.003, 0.1, 32, yellow)
        patches += rod(elbow, hand, 0.04, metal, 0.003, 0.1, 32, yellow)
        patches += rod(hand, hand + np.array([0, 0.08, 0.02]), 0.06, dark, 0.003, 0.1, 32)
    return patches


def _turned(patch: Patch, a_T_b: Float) -> Patch:
    shape = patch.shape
    if not isinstance(shape, Rectangle):
        raise TypeError("only rectangles are turned")
    rotation = a_T_b[:3, :3]
    moved = Rectangle(
        transform(a_T_b, shape.origin), rotation @ shape.eu, rotation @ shape.ev, shape.width_m, shape.height_m
    )
    return Patch(moved, patch.texture, patch.texel_m, patch.tint_bgr, patch.specular)


def _page(truth: TrueRig) -> list[Patch]:
    """The printed page on a stiff backing. In {f}."""
    width, height = PAGE_M
    face = Rectangle(
        np.array([-width / 2, height / 2, 0]), np.array([1.0, 0, 0]), np.array([0, -1.0, 0]), width, height
    )
    backing = box((width + 0.03, height + 0.03, 0.006), textures.plain(0.25), (0, 0, -0.0045), 0.002)
    return [Patch(face, page_texture(truth.markers), 0.0002), *backing]


def _arm(length_m: float, radius_m: float, rng: np.random.Generator) -> list[Patch]:
    """A link along +y of its own frame."""
    look = textures.plain(rng.uniform(0.3, 0.5), 0.015, 0.05)
    start, end = np.zeros(3), np.array([0, length_m, 0])
    patches = rod(start, end, radius_m, look, 0.003, 0.15, 48, (0.25, 0.75, 1.0))
    patches += rod(
        start - np.array([0, 0.03, 0]), start + np.array([0, 0.07, 0]), 1.4 * radius_m, look, 0.003, 0.15, 48
    )
    stripe = 0.7 * end
    return patches + rod(stripe, stripe + np.array([0, 0.1, 0]), 1.05 * radius_m, textures.stripes, 0.002, 0.05, 48)


def _lamps(room: tuple[float, float, float, float, float], level: float, rng: np.random.Generator) -> list[Lamp]:
    left, right, back, front, top = room
    lamps = []
    for x, y in ((0.3, 0.75), (0.72, 0.6), (0.5, 0.2)):
        place = (left + x * (right - left), back + y * (front - back), top - 0.22)
        jitter = np.array([*rng.normal(0, 0.25, 2), 0])
        lamps.append(Lamp(np.array(place) + jitter, 0.35, level * rng.uniform(1.2, 2.4)))
    return lamps


__all__ = ["KINECT_HEIGHT_M", "PLACES", "Cell", "PipeTruth", "build_cell"]
