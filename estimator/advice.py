"""What to measure next: candidate actions, each with the uncertainty that it is predicted to leave.

The predicted factors of an action join the linearised graph, with the noise that this run's own measurements had; the
point's covariance after it follows without a measurement being made. What the prediction takes for granted: the
estimate is near the truth, and the camera's place is held by landmarks of the map that are recognised there.
"""

from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import gtsam
import numpy as np
from numpy.typing import NDArray

from ..factors import keys
from . import advice_factors as factors
from .advice_places import Places, clicked_views
from .advice_scene import Active, Surroundings, View
from .advice_update import Joint, Predicted, measured_again
from .engine import Engine
from .linear import LinearSystem
from .pipes import AXIS_ROLES
from .points_in_base import point_blocks, radius95
from .report.text import utc
from .result import Advice, PointEstimate
from .surfaces import FAMILY as CLOUD

Float = NDArray[np.float64]

WORTH_TELLING = 0.001
"""Actions that gain less than this are left out, but for the best one."""
MORE_FRAMES = 4
"""How many times more Kinect images the action averages."""


@dataclass(frozen=True, slots=True)
class Plan:
    """One candidate."""

    kind: str
    """Of several plans of one kind the best is told."""
    action: str
    detail: str
    factors: list[Predicted]
    point: str | None = None
    """The point that it is about; None: it helps all."""
    values: gtsam.Values = field(default_factory=gtsam.Values)
    """New variables other than keyframes."""


def advise(
    engine: Engine,
    values: gtsam.Values,
    system: LinearSystem,
    active: Active,
    points: Sequence[PointEstimate],
    track_inflation: float = 1.0,
) -> dict[str, tuple[Advice, ...]]:
    """Advice for every point, best first.

    Args:
        active: the factors of `system`, in its order.
        track_inflation: variance of the tracks' errors over what they state.
    """
    if not points or not values.exists(keys.base(0)):
        return {}
    planner = Planner(Surroundings(engine, values, active), track_inflation)
    plans = list(planner.plans([p.id for p in points]))
    predicted = _predict(planner, plans, system, points)
    after = planner.more_frames(system, active, points)
    return {p.id: _ranked(p, [*predicted[p.id], *after.get(p.id, [])]) for p in points}


class Planner:
    """Makes the candidates of one run."""

    def __init__(self, scene: Surroundings, track_inflation: float) -> None:
        self.scene = scene
        self.places = Places(scene)
        self._engine = scene.engine
        self._inflation = track_inflation

    def plans(self, point_ids: Sequence[str]) -> Iterator[Plan]:
        for point_id in point_ids:
            yield from self._repeat(point_id)
            yield from self._recorded(point_id)
            yield from self._new_view(point_id)
        yield from self._boards()
        yield from self._mount()
        yield from self._second_board()

    def all_values(self, plan: Plan) -> gtsam.Values:
        """The estimate with the plan's new variables."""
        values = gtsam.Values(self.scene.values)
        for view in self.places.views:
            values.insert(view.key, view.o_T_m)
        values.insert(plan.values)
        return values

    # Picks ----------------------------------------------------------------------------------------------------

    def _repeat(self, point_id: str) -> Iterator[Plan]:
        point = keys.point(self._engine.pipes.points[point_id].index)
        for c in clicked_views(self.scene, point_id):
            again = factors.click(self.scene, point, c.key, c.o_T_c, c.camera)
            detail = f"once more in {c.camera} at {_moment(c.stamp_ns)}"
            yield Plan("repeat", f"Click {point_id} again", detail, [again], point_id)

    def _recorded(self, point_id: str) -> Iterator[Plan]:
        outlined = {s.stamp_ns for _, s in self._engine.pipes.outlined}
        for place, stamp_ns in self.places.recorded(point_id):
            found = self._pick_and_edges(point_id, place.view, stamp_ns not in outlined)
            detail = f"m_left at {_moment(stamp_ns)}, {place.text}"
            yield Plan("recorded", f"Click {point_id} in another image", detail, found, point_id)

    def _new_view(self, point_id: str) -> Iterator[Plan]:
        for place in self.places.round_the_pipe(point_id):
            found = [
                *factors.ties(self.scene, place.view, self._inflation),
                *self._pick_and_edges(point_id, place.view, True),
            ]
            yield Plan("view", f"View and click {point_id} from another side", place.text, found, point_id)

    def _pick_and_edges(self, point_id: str, view: View, with_edges: bool) -> list[Predicted]:
        known = self._engine.pipes.points[point_id]
        point = keys.point(known.index)
        found = [factors.click(self.scene, point, view.key, view.o_T_m, "m_left")]
        if with_edges and known.on_axis and known.pipe is not None and known.role in AXIS_ROLES:
            found += factors.edges(self.scene, known.pipe, point, view)
        return found

    # Boards, mount, Kinect ------------------------------------------------------------------------------------

    def _boards(self) -> Iterator[Plan]:
        for board in self._engine.rig.boards:
            if not self._engine.boards.known(board.id) or "m_right" not in self._engine.cameras:
                continue
            for place in self.places.before_board(board):
                seen = factors.board_view(self.scene, board, place.view)
                found = [*factors.ties(self.scene, place.view, self._inflation), *seen]
                yield Plan(f"board {board.id}", f"Look at board {board.id} again", place.text, found)

    def _mount(self) -> Iterator[Plan]:
        found = factors.mount_again(self.scene)
        mount = self._engine.rig.mount
        if found and mount is not None:
            sigma = f"{1e3 * mount.translation_sigma_m / 2:.2g} mm, {1e3 * mount.rotation_sigma_rad / 2:.2g} mrad"
            detail = f"{mount.board} to Kinect within {sigma}: half of now"
            yield Plan("mount", "Measure the mount again", detail, found)

    def _second_board(self) -> Iterator[Plan]:
        scene, rig = self.scene, self._engine.rig
        if not rig.boards or "b_rgb" not in self._engine.cameras or "m_right" not in self._engine.cameras:
            return
        place = self.places.between(factors.colour_camera(scene)[0])
        if place is None:
            return
        view, o_T_f, text = place
        new = gtsam.Values()
        found = factors.second_board(scene, new, rig.boards[0], o_T_f, view)
        action = "Add a board that both cameras see"
        detail = text
        yield Plan("second board", action, detail, [*factors.ties(scene, view, self._inflation), *found], None, new)

    def more_frames(
        self, system: LinearSystem, active: Active, points: Sequence[PointEstimate]
    ) -> dict[str, list[Advice]]:
        """More Kinect images averaged: the noise of its surfaces falls, what neighbours share stays."""
        cloud = self._engine.surfaces.cloud
        of_cloud = np.array([record.family == CLOUD for _, _, record in active])
        if cloud is None or not of_cloud.any():
            return {}
        total = cloud.sigma_m**2 + cloud.bias_m**2
        noise = np.clip(cloud.sigma_m**2 - cloud.bias_m**2, 0.0, None)
        gain = float(np.median(total / (total - noise * (1 - 1 / MORE_FRAMES))))
        rows = np.repeat(of_cloud, system.rows)
        told: dict[str, list[Advice]] = {}
        action = "Average more Kinect images"
        detail = f"{MORE_FRAMES} times as many while the machine stands still"
        blocks = {p.id: point_blocks(self.scene.values, keys.base(0), self._key(p.id))[1] for p in points}
        stacked = _stacked([blocks[p.id] for p in points])
        covariance = measured_again(system, rows, gain, stacked)
        for i, p in enumerate(points):
            part = covariance[3 * i : 3 * i + 3, 3 * i : 3 * i + 3]
            told[p.id] = [_told(p, action, detail, part)]
        return told

    def _key(self, point_id: str) -> int:
        return keys.point(self._engine.pipes.points[point_id].index)


def _predict(
    planner: Planner, plans: list[Plan], system: LinearSystem, points: Sequence[PointEstimate]
) -> dict[str, list[Advice]]:
    """The best plan of each kind for each point."""
    values, engine = planner.scene.values, planner.scene.engine
    blocks = {p.id: point_blocks(values, keys.base(0), keys.point(engine.pipes.points[p.id].index))[1] for p in points}
    touched = {key for block in blocks.values() for key, _ in block}
    touched |= {int(key) for plan in plans for p in plan.factors for key in p.factor.keys()}
    joint = Joint.of(system, sorted(touched & set(system.columns)))
    best: dict[str, dict[str, Advice]] = defaultdict(dict)
    for plan in plans:
        rows = joint.rows(plan.factors, planner.all_values(plan))
        for p in points:
            if plan.point not in (None, p.id):
                continue
            told = _told(p, plan.action, plan.detail, joint.after(rows, blocks[p.id]))
            if plan.kind not in best[p.id] or told.gain > best[p.id][plan.kind].gain:
                best[p.id][plan.kind] = told
    return {p.id: list(best[p.id].values()) for p in points}


def _told(point: PointEstimate, action: str, detail: str, covariance: Float) -> Advice:
    radius = radius95(covariance)
    gain = 1.0 - radius / point.radius95_m if point.radius95_m > 0 else 0.0
    return Advice(action, detail, radius, gain)


def _moment(stamp_ns: int) -> str:
    """Time of day with hundredths, which tells an image from the next one; the date is that of the recording."""
    text = utc(stamp_ns)
    if not text.endswith(" UTC"):
        return text
    return f"{text.split()[1]}.{stamp_ns // 10_000_000 % 100:02d} UTC"


def _ranked(point: PointEstimate, told: list[Advice]) -> tuple[Advice, ...]:
    ranked = sorted(told, key=lambda a: (-a.gain, a.action))
    return tuple(a for i, a in enumerate(ranked) if a.gain >= WORTH_TELLING or (i == 0 and a.gain > 0))


def _stacked(blocks: list[list[tuple[int, Float]]]) -> list[tuple[int, Float]]:
    """Blocks of several points below each other."""
    rows = 3 * len(blocks)
    found = []
    for i, block in enumerate(blocks):
        for key, J in block:
            full = np.zeros((rows, J.shape[1]))
            full[3 * i : 3 * i + 3] = J
            found.append((key, full))
    return found
