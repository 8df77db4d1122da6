"""How far a detector's corners lie inside the true ones: told from the side length by views of different size."""

from dataclasses import dataclass
from typing import Any

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

TELLING = 0.1
"""Share of the prior's sigma below which the data have to bring the inset, or it stays frozen at zero: views of one
size tell a little by their perspective, and there the noise of the corners bends what they tell."""


@dataclass(frozen=True, slots=True)
class Insets:
    """One inset per camera and board."""

    names: list[tuple[str, str]]
    """Camera and board."""
    prior_sigma_px: Float
    shift: Shift
    """Of the insets, then of one error for each given side length."""

    def solution(self) -> tuple[Float, Float]:
        """Insets in px and their covariance: with their prior, the given side lengths believed."""
        k = len(self.names)
        information = self.shift.information[:k, :k] + np.diag(self.prior_sigma_px**-2)
        covariance = np.linalg.inv(information)
        return np.asarray(covariance @ self.shift.right[:k], float), np.asarray(covariance, float)

    def by_size_alone(self) -> tuple[Float, Float]:
        """Insets in px and their sigmas, no given side length believed: what views of different size tell."""
        k = len(self.names)
        information = self.shift.information.copy()
        information[:k, :k] += np.diag(self.prior_sigma_px**-2)
        information[k:, k:] += 1e-9 * np.diag(self.shift.alone[k:])
        covariance = np.linalg.inv(information)
        return np.asarray((covariance @ self.shift.right)[:k], float), np.sqrt(np.diag(covariance)[:k])

    def frozen(self) -> NDArray[np.bool_]:
        """Which of them the views do not tell from the side length."""
        return self.by_size_alone()[1] > TELLING * self.prior_sigma_px


class CornerRays:
    """From the middle of its marker outwards: the direction of every corner measurement, unit, in the image."""

    def __init__(self, log: FactorLog, values: gtsam.Values) -> None:
        self._values = values
        self._middles: dict[tuple[int, str, str], list[Float]] = {}
        for factor, record in zip(log.factors, log.records, strict=True):
            if record.family == FAMILY:
                self._middles.setdefault(_sighting(record), []).append(self._predicted(factor))

    def of(self, factor: Any, record: Record) -> Float:
        ray = self._predicted(factor) - np.mean(self._middles[_sighting(record)], axis=0)
        return ray / np.linalg.norm(ray)

    def _predicted(self, factor: Any) -> Float:
        """Pixel of the estimate: rays through noisy pixels would lean with the noise."""
        return factor.measured() + factor.unwhitenedError(self._values)


def _sighting(record: Record) -> tuple[int, str, str]:
    return record.stamp_ns, record.source, record.what.split(" corner ")[0]


def inset_directions(
    log: FactorLog, active: Active, system: LinearSystem, values: gtsam.Values, boards: Boards
) -> tuple[list[tuple[str, str]], Float, csr_matrix]:
    """Names, prior sigmas and whitened directions (rows, k) of all insets."""
    names = sorted(boards.corners.inset_sigma_px)
    rays = CornerRays(log, values)
    rows, columns, data = [], [], []
    factor: Any
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
    C = csr_matrix((data, (rows, columns)), shape=(len(system.b), len(names)))
    return names, np.array([boards.corners.inset_sigma_px[n] for n in names]), C


def corrected_corners(
    log: FactorLog, values: gtsam.Values, insets: dict[tuple[str, str], float]
) -> tuple[Update, list[int]]:
    """Corner factors with their pixels moved outwards, and the indices of those that they replace."""
    update, replaced, rays = Update(), [], CornerRays(log, values)
    factor: Any
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
