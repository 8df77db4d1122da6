"""The last answer in a checkpoint: what a stream can say at once after a restart, before its graph is up again.

It carries no verdict: points and machine stand where they stood, and whoever asks has to measure again before a cut.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...factors.rig import Rig, sha256_of
from ..result import PointEstimate
from .wire import Answer, Place

Float = NDArray[np.float64]

LARGEST_BYTES = 1 << 28
"""Of a checkpoint."""
KEY = "answer"
"""Where it is in the checkpoint."""


def to_data(answer: Answer) -> dict[str, Any]:
    """As JSON has it; the camera's place is left out, for the camera has moved by then."""
    return {
        "stamp_ns": answer.stamp_ns,
        "last_tie_ns": answer.last_tie_ns,
        "places": [
            {"name": name, "matrix": place.matrix.tolist(), "covariance": _listed(place.covariance)}
            for name, place in answer.places.items()
            if name != "m"
        ],
        "points": [
            {
                "id": p.id,
                "role": p.role,
                "position_m": p.position_m.tolist(),
                "covariance_m2": p.covariance_m2.tolist(),
                "radius95_m": p.radius95_m,
                "measurements": p.measurements,
                "axis": _listed(p.axis),
                "pipe_id": p.pipe_id,
            }
            for p in answer.points
        ],
    }


def remembered(checkpoint: Path, rig: Rig) -> Answer | None:
    """What was answered last with this rig; None where the file does not say. The graph tells what is wrong with it."""
    try:
        if checkpoint.stat().st_size > LARGEST_BYTES:
            return None
        data = json.loads(checkpoint.read_text(encoding="utf-8"))
        return _answer(data[KEY]) if data["rig_sha256"] == sha256_of(rig) else None
    except (OSError, KeyError, TypeError, ValueError, AttributeError, OverflowError, RecursionError):
        return None


def _answer(data: Mapping[str, Any]) -> Answer:
    places = {
        str(p["name"]): Place(_array(p["matrix"], (4, 4)), _array(p["covariance"], (6, 6))) for p in data["places"]
    }
    points = tuple(
        PointEstimate(
            id=str(p["id"]),
            role=str(p["role"]),
            frame="b",
            position_m=_array(p["position_m"], (3,)),
            covariance_m2=_array(p["covariance_m2"], (3, 3)),
            radius95_m=float(p["radius95_m"]),
            measurements=int(p["measurements"]),
            axis=None if p["axis"] is None else _array(p["axis"], (3,)),
            pipe_id=None if p["pipe_id"] is None else str(p["pipe_id"]),
        )
        for p in data["points"]
    )
    tie = None if data["last_tie_ns"] is None else int(data["last_tie_ns"])
    return Answer(int(data["stamp_ns"]), None, places, points, last_tie_ns=tie)


def _listed(array: Float | None) -> list[Any] | None:
    return None if array is None else array.tolist()


def _array(numbers: object, shape: tuple[int, ...]) -> Float:
    found = np.array(numbers, float)
    if found.shape != shape or not np.isfinite(found).all():
        raise ValueError(f"not {shape} finite numbers")
    return found
