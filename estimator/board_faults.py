"""After the run: what of the boards contradicts the rig, by the final estimate; it is released and solved again."""

from dataclasses import dataclass
from typing import Any, Literal

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix, hstack

from ..factors import keys
from ..factors.board import page_factor, print_scale_prior, shift_directions, side_prior
from ..factors.chance import chi2_isf, normal_isf
from ..factors.measurements import Event, Rejection
from .batch import BatchSolution, solve
from .board_news import GEOMETRY, scale_words, side_words
from .boards import DISTANCES, FREE_SIDE_REL
from .corner_inset import Insets, corrected_corners, inset_directions
from .correlation import Active
from .engine import Engine
from .graph import Record, Update
from .linear import LinearSystem, deviate
from .result import CalibrationEstimate
from .sheet import Knock, Sheet

Float = NDArray[np.float64]

GATE_SIGMA = 4.0
"""What a page's side or scale has to be off by to be called wrong: one in 16 000 by chance."""
FREE_SCALE = 0.3
"""Sigma of the print scale of a page whose given size the log contradicts."""
MARKER_FALSE_ALARM = 1e-6
"""Probability that a marker in its place is called loose."""
KNOCK_FALSE_ALARM = 1e-6
"""Probability that a board that stands still is called knocked."""
SAME_PLACE = 1e-5
"""rad and m: nothing, against what any log shows."""
ROUNDS = 6


@dataclass(frozen=True, slots=True)
class Fault:
    """A statement about a board that the log contradicts."""

    kind: Literal["side", "side_restored", "scale", "marker", "rejoined"]
    excess: float
    """Deviation over what is tolerated, both in sigmas of one normal variable."""
    sheet: Sheet
    factor: int
    """Index in the factor log."""
    record: Record
    marker: int = -1
    shift_m: float = 0.0
    shift_sigma_m: float = 0.0

    @property
    def name(self) -> tuple[str, str, int]:
        return self.kind, self.sheet.board.id, self.marker


@dataclass(frozen=True, slots=True)
class _Look:
    """One solution, linearised."""

    engine: Engine
    solution: BatchSolution
    values: gtsam.Values
    active: Active
    system: LinearSystem
    insets: Insets
    C: csr_matrix
    """Whitened directions of the insets."""

    def find(self, what: str) -> tuple[int, int, Record] | None:
        """Position, index and record of a factor by its words."""
        rows = ((p, i, r) for p, (i, _, r) in enumerate(self.active) if r.what == what)
        return next(rows, None)


def settle_boards(engine: Engine, solution: BatchSolution) -> BatchSolution:
    """Releases what is wrong, the worst first, until the rest agrees; the boards' events then say the final figures.

    A wrong statement pulls others with it, so that only the worst one is taken at a time (Baarda 1968).
    """
    look = _correct_insets(_look(engine, solution))
    done: set[tuple[str, str, int]] = set()
    for _ in range(ROUNDS):
        found = [f for f in _faults(look) if f.name not in done]
        if not found:
            break
        worst = max(found, key=lambda f: f.excess)
        done.add(worst.name)
        look = _look(engine, _again(engine, look.solution, *_released(engine, worst, look.solution)))
    _tell(look)
    return look.solution


def _look(engine: Engine, solution: BatchSolution) -> _Look:
    active, system = solution.at.active, solution.at.system
    names, sigmas, C = inset_directions(engine.solver.log, active, system, solution.values, engine.boards)
    sides = [side_words(sheet.board.id) for sheet in engine.boards.sheets.values()]
    priors = [p for p, (_, _, r) in enumerate(active) if r.what in sides]
    columns = [_column(system, p, -_noise(active[p][1]).whiten(np.ones(1))[:, None]) for p in priors]
    shift = system.shift(csr_matrix(hstack([C, *columns])))
    return _Look(engine, solution, solution.values, active, system, Insets(names, sigmas, shift), C)


def _noise(factor: gtsam.NonlinearFactor) -> Any:
    assert isinstance(factor, gtsam.NoiseModelFactor)
    return factor.noiseModel()


def _column(system: LinearSystem, position: int, block: Float) -> csr_matrix:
    """Directions (rows of one factor, k) as columns over all rows."""
    start, m, k = int(system.starts[position]), *block.shape
    i, j = np.meshgrid(np.arange(start, start + m), np.arange(k), indexing="ij")
    return csr_matrix((block.ravel(), (i.ravel(), j.ravel())), shape=(len(system.b), k))


def _again(engine: Engine, solution: BatchSolution, update: Update, remove: list[int]) -> BatchSolution:
    """The running solver and the batch one, with some factors exchanged."""
    engine.state.values = engine.solver.update(update, remove)
    engine.state.values = engine.solver.settle()
    return solve(engine.solver.log, solution.values, engine.rig.gates.robust_sigma)


# Corner inset -------------------------------------------------------------------------------------------------


def _correct_insets(look: _Look) -> _Look:
    """Corners that lie inside their markers are moved out, where views of different size show by how much."""
    engine = look.engine
    if not look.insets.names:
        return look
    value, sigma = look.insets.by_size_alone()
    frozen = look.insets.frozen()
    told = (np.abs(value) > GATE_SIGMA * sigma) & ~frozen
    for i, (camera, board) in enumerate(look.insets.names):
        prior = float(look.insets.prior_sigma_px[i])
        row = CalibrationEstimate(
            f"{board}.{camera}.corner_inset", "px", float(value[i]), float(sigma[i]), 0.0, prior, bool(frozen[i])
        )
        engine.boards.insets.append(row)
        if told[i]:
            text = (
                f"board {board}: its corners in {camera} lie {value[i]:.2f} +/- {sigma[i]:.2f} px inside the true "
                "ones; moved outwards"
            )
            values = {"inset_px": float(value[i]), "sigma_px": float(sigma[i])}
            engine.boards.news.say(engine.end_ns, "corner_inset", f"{board} {camera}", text, "info", **values)
    if not told.any():
        return look
    moved = {name: float(value[i]) for i, name in enumerate(look.insets.names) if told[i]}
    corrected = corrected_corners(engine.solver.log, look.values, moved)
    return _look(engine, _again(engine, look.solution, *corrected))


# What contradicts ---------------------------------------------------------------------------------------------


def _faults(look: _Look) -> list[Fault]:
    found: list[Fault | None] = []
    for sheet in look.engine.boards.sheets.values():
        if not sheet.page_known:
            continue
        found += [_side_fault(look, sheet), _scale_fault(look, sheet)]
        found += [_marker_fault(look, sheet, what) for what in sheet.pages]
        found += [_no_knock(look, sheet, knock) for knock in sheet.knocks]
    return [f for f in found if f is not None and f.excess > 1.0]


def _side_fault(look: _Look, sheet: Sheet) -> Fault | None:
    """The given side length against everything else; or one that was released too early."""
    place = look.find(side_words(sheet.board.id))
    if place is None:
        return None
    position, index, record = place
    if look.engine.boards.news.told("side_length_wrong", sheet.board.id):
        off, sigma = _side_off(look, sheet)
        inside = abs(off) / float(np.hypot(sigma, sheet.board.side_sigma_m)) < GATE_SIGMA
        return Fault("side_restored", 1e9, sheet, index, record) if inside else None
    W = _noise(look.active[position][1]).whiten(np.ones(1))
    C = csr_matrix(hstack([_column(look.system, position, -W[:, None]), look.C]))
    shift = look.system.shift(C)
    information = shift.information.copy()
    information[1:, 1:] += np.diag(look.insets.prior_sigma_px**-2)
    if information[0, 0] < 1e-6 * shift.alone[0]:
        return None
    covariance = np.linalg.inv(information)
    off = abs(float((covariance @ shift.right)[0])) / float(np.sqrt(covariance[0, 0]))
    return Fault("side", off / GATE_SIGMA, sheet, index, record)


def _side_off(look: _Look, sheet: Sheet) -> tuple[float, float]:
    """Side length less what the rig gives, times the print scale, and its sigma, the insets' doubt included."""
    side, scale = look.values.atVector(sheet.page)
    J = np.array([[1.0, -sheet.board.side_m]])
    inset, spread = look.insets.solution()
    through = J @ look.insets.shift.response[look.system.columns[sheet.page], : len(look.insets.names)]
    variance = look.system.covariance([(sheet.page, J)]) + through @ spread @ through.T
    return float(side - scale * sheet.board.side_m + (through @ inset)[0]), float(np.sqrt(variance[0, 0]))


def _scale_fault(look: _Look, sheet: Sheet) -> Fault | None:
    """The page's given size against everything else. A single marker has a side length, and no size beside it."""
    place = look.find(scale_words(sheet.board.id))
    alone = len({page.marker for page in sheet.pages.values()}) < 2
    if place is None or alone or look.engine.boards.news.told("print_scale_wrong", sheet.board.id):
        return None
    off = deviate(*look.system.standardised([place[0]])[0])
    return Fault("scale", off / GATE_SIGMA, sheet, place[1], place[2])


def _marker_fault(look: _Look, sheet: Sheet, what: str) -> Fault | None:
    """A marker that may shift and turn on its page: does that explain what is left of the board's residuals?"""
    place, page = look.find(what), sheet.pages[what]
    board = sheet.board
    alone = sum(p.epoch == page.epoch for p in sheet.pages.values()) < 3
    if place is None or page.marker in sheet.loose or alone:
        return None
    position, index, record = place
    noise = _noise(look.active[position][1])
    directions = shift_directions(sheet.marker(page.marker), board.side_m)
    block = -np.column_stack([noise.whiten(d) for d in directions.T])
    shift = look.system.shift(_column(look.system, position, block))
    if not shift.determined():
        return None
    value, covariance = shift.solution()
    # the page factor knows the tolerance of a marker's place; it is one of its turn as well
    covariance[2, 2] += (board.centre_sigma_m / board.side_m) ** 2
    total = float(value @ np.linalg.solve(covariance, value))
    off = deviate(total, 3)
    limit = normal_isf(MARKER_FALSE_ALARM / 2)
    length = float(np.linalg.norm(value[:2]))
    along = value[:2] / max(length, 1e-12)
    sigma = float(np.sqrt(along @ covariance[:2, :2] @ along))
    return Fault("marker", off / limit, sheet, index, record, page.marker, length, sigma)


def _no_knock(look: _Look, sheet: Sheet, knock: Knock) -> Fault | None:
    """A new place that the whole run does not tell from the old one."""
    moved = _moved(look, sheet, knock)
    place = look.find(side_words(sheet.board.id))
    if moved is None or place is None:
        return None
    delta, covariance = moved
    if delta @ np.linalg.solve(covariance, delta) > chi2_isf(KNOCK_FALSE_ALARM, 6):
        return None
    return Fault("rejoined", 2e9, sheet, -1, place[2], knock.epoch)


def _moved(look: _Look, sheet: Sheet, knock: Knock) -> tuple[Float, Float] | None:
    """Tangent of old_T_new (6,), rotation first, and its covariance."""
    old, new = (keys.board(sheet.index, e) for e in (knock.epoch - 1, knock.epoch))
    if not (old in look.system.columns and new in look.system.columns):
        return None
    between = look.values.atPose3(old).between(look.values.atPose3(new))
    J = np.hstack([-between.inverse().AdjointMap(), np.eye(6)])
    return gtsam.Pose3.Logmap(between), J @ look.system.joint([old, new]) @ J.T


# Release ------------------------------------------------------------------------------------------------------


def _released(engine: Engine, fault: Fault, solution: BatchSolution) -> tuple[Update, list[int]]:
    """The factor that says what is wrong, replaced by one that leaves it open."""
    update, sheet, boards = Update(), fault.sheet, engine.boards
    board, stamp_ns = sheet.board, fault.record.stamp_ns
    side, scale = solution.values.atVector(sheet.page)
    if fault.kind == "side":
        boards.news.reject_side(sheet, stamp_ns, GATE_SIGMA * fault.excess)
        boards.news.say_side(sheet, stamp_ns, float(side), 0.0)
        update.add(side_prior(sheet.page, float(side / scale), FREE_SIDE_REL * float(side)), fault.record)
    elif fault.kind == "side_restored":
        boards.news.unsay("side_length_wrong", board.id)
        update.add(side_prior(sheet.page, board.side_m, board.side_sigma_m), fault.record)
    elif fault.kind == "scale":
        boards.news.say(stamp_ns, "print_scale_wrong", board.id, "", "warning")
        rejection = Rejection(
            stamp_ns, DISTANCES, scale_words(board.id), "off by sigmas", GATE_SIGMA * fault.excess, GATE_SIGMA
        )
        engine.rejected.append(rejection)
        update.add(print_scale_prior(sheet.page, FREE_SCALE), fault.record)
    elif fault.kind == "rejoined":
        _rejoin(engine, sheet, fault, update)
        return update, []
    else:
        page = sheet.pages[fault.record.what]
        marker = sheet.marker(page.marker)
        factor = page_factor(
            board, marker, keys.board(sheet.index, page.epoch), sheet.page, page.slot, page.detection_m, loose=True
        )
        update.add(factor, fault.record)
        sheet.loose.add(page.marker)
        _tell_loose(engine, fault)
    return update, [fault.factor]


def _rejoin(engine: Engine, sheet: Sheet, fault: Fault, update: Update) -> None:
    """The board's two poses are one."""
    epoch = fault.marker
    old, new = (keys.board(sheet.index, e) for e in (epoch - 1, epoch))
    model = gtsam.noiseModel.Isotropic.Sigma(6, SAME_PLACE)
    what = f"board {sheet.board.id} stands where it stood"
    record = Record(GEOMETRY, what, fault.record.stamp_ns, what, rejectable=False)
    update.add(gtsam.BetweenFactorPose3(old, new, gtsam.Pose3(), model), record)
    sheet.knocks = [k for k in sheet.knocks if k.epoch != epoch]
    engine.boards.news.unsay("board_knocked", f"{sheet.board.id} {epoch}")


def _tell_loose(engine: Engine, fault: Fault) -> None:
    board, limit = fault.sheet.board, normal_isf(MARKER_FALSE_ALARM / 2)
    text = (
        f"board {board.id}: marker {fault.marker} is {1e3 * fault.shift_m:.1f} +/- {1e3 * fault.shift_sigma_m:.1f} mm "
        "off its place; its place on the page is not used"
    )
    stamp_ns = fault.record.stamp_ns
    values = {"marker": float(fault.marker), "shift_m": fault.shift_m, "sigma_m": fault.shift_sigma_m}
    engine.boards.news.say(stamp_ns, "marker_loose", f"{board.id} {fault.marker}", text, "warning", **values)
    what = fault.record.what
    engine.rejected.append(Rejection(stamp_ns, GEOMETRY, what, "off by sigmas", fault.excess * limit, limit))


# The last word ------------------------------------------------------------------------------------------------


def _tell(look: _Look) -> None:
    """The events of wrong sides, scales and knocks, with the final figures."""
    boards = look.engine.boards
    for sheet in boards.sheets.values():
        name = sheet.board.id
        event = boards.news.told("side_length_wrong", name)
        if event is not None:
            side = float(look.values.atVector(sheet.page)[0])
            boards.news.say_side(sheet, event.stamp_ns, side, _sigma(look, sheet, 0))
        event = boards.news.told("print_scale_wrong", name)
        if event is not None:
            _tell_scale(look, sheet, event)
        for knock in sheet.knocks:
            _tell_knock(look, sheet, knock)


def _sigma(look: _Look, sheet: Sheet, index: int) -> float:
    J = np.zeros((1, 2))
    J[0, index] = 1.0
    _, spread = look.insets.solution()
    through = J @ look.insets.shift.response[look.system.columns[sheet.page], : len(look.insets.names)]
    variance = look.system.covariance([(sheet.page, J)]) + through @ spread @ through.T
    return float(np.sqrt(variance[0, 0]))


def _tell_scale(look: _Look, sheet: Sheet, event: Event) -> None:
    scale, sigma = float(look.values.atVector(sheet.page)[1]), _sigma(look, sheet, 1)
    text = (
        f"board {sheet.board.id}: the page is printed at {100 * scale:.1f} +/- {100 * sigma:.1f} % of the size that "
        "the rig gives; used the log's"
    )
    values = {"scale": scale, "sigma": sigma}
    look.engine.boards.news.say(event.stamp_ns, "print_scale_wrong", sheet.board.id, text, "warning", **values)


def _tell_knock(look: _Look, sheet: Sheet, knock: Knock) -> None:
    moved = _moved(look, sheet, knock)
    if moved is not None:
        look.engine.boards.news.say_knock(sheet, knock, *moved)
