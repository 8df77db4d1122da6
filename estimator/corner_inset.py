"""How far a detector's corners lie inside the true ones: told from the side length by views of different size."""

from dataclasses import dataclass

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from ..factors.projection import machine_projection, mobile_projection
from .board_inspection import FAMILY
from .boards import Boards
from .correlation import Active
from .graph import FactorLog, Record, Update
from .linear import LinearSystem, Shift

Float = NDArray[np.float64]

TELLING = 0.5
"""Share of the prior's sigma below which the data have to bring the inset, or it stays frozen at zero."""


@dataclass(frozen=True, slots=True)
class Insets:
    """One inset per camera and board."""

    names: list[tuple[str, str]]
    """Camera and board."""
    prior_sigma_px: Float
    shift: Shift

    def solution(self) -> tuple[Float, Float]:
        """Insets in px and their covariance, with their prior."""
        information = self.shift.information + np.diag(self.prior_sigma_px**-2)
        covariance = np.linalg.inv(information)
        return covariance @ self.shift.right, covariance

    def frozen(self) -> NDArray[np.bool_]:
        """Which of them the geometry does not tell from the side length."""
        return np.sqrt(np.diag(self.solution()[1])) > TELLING * self.prior_sigma_px


class CornerRays:
    """From the middle of its marker outwards: the direction of every corner measurement, unit, in the image."""

    def __init__(self, log: FactorLog) -> None:
        self._middles: dict[tuple[int, str, str], list[Float]] = {}
        for factor, record in zip(log.factors, log.records, strict=True):
            if record.family == FAMILY:
                self._middles.setdefault(_sighting(record), []).append(factor.measured())

    def of(self, factor: gtsam.NonlinearFactor, record: Record) -> Float:
        ray = factor.measured() - np.mean(self._middles[_sighting(record)], axis=0)
        return ray / np.linalg.norm(ray)


def _sighting(record: Record) -> tuple[int, str, str]:
    return record.stamp_ns, record.source, record.what.split(" corner ")[0]


def inset_directions(
    log: FactorLog, active: Active, system: LinearSystem, values: gtsam.Values, boards: Boards
) -> tuple[list[tuple[str, str]], Float, csr_matrix]:
    """Names, prior sigmas and whitened directions (rows, k) of all insets."""
    names = sorted(boards.inset_sigma_px)
    rays = CornerRays(log)
    rows, columns, data = [], [], []
    for position, (_, factor, record) in enumerate(active):
        if record.family != FAMILY:
            continue
        camera, board = record.source.split(" ")[1:3]
        model = factor.noiseModel()
        residual = model.unweightedWhiten(factor.unwhitenedError(values))
        weight = np.sqrt(model.robust().weight(float(np.linalg.norm(residual))))
        start = int(system.starts[position])
        rows += [start, start + 1]
        columns += [names.index((camera, board))] * 2
        data += list(-weight * model.unweightedWhiten(rays.of(factor, record)))
    C = csr_matrix((data, (rows, columns)), shape=(system.A.shape[0], len(names)))
    return names, np.array([boards.inset_sigma_px[n] for n in names]), C


def corrected_corners(log: FactorLog, insets: dict[tuple[str, str], float]) -> tuple[Update, list[int]]:
    """Corner factors with their pixels moved outwards, and the indices of those that they replace."""
    update, replaced, rays = Update(), [], CornerRays(log)
    for index, factor, record in log.active():
        if record.family != FAMILY:
            continue
        camera, board = record.source.split(" ")[1:3]
        inset = insets.get((camera, board))
        if inset is None:
            continue
        px = factor.measured() + inset * rays.of(factor, record)
        model, used = factor.noiseModel(), factor.keys()
        if camera == "b_rgb":
            moved = machine_projection(px, model, used[0], used[2])
        else:
            moved = mobile_projection(camera, px, model, used[0], used[1] if camera == "m_left" else used[2])
        update.add(moved, record)
        replaced.append(index)
    return update, replaced
