"""Real photographs of markers against golden corners of others and the angles of a turntable."""

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ..factors.camera import CameraModel
from ..factors.measurements import MarkerSighting
from ..factors.rig import Board, Marker, Rig
from ..frontends.board_pose import board_pose_candidates
from ..frontends.fiducials.detector import MarkerFrontEnd
from .campaign_real_row import RealRow

Float = NDArray[np.float64]
TO_OPENCV = [3, 2, 1, 0]


def photo_rows(folder: Path) -> Iterator[RealRow]:
    """Corners against golden ones, after the inset that all markers of a photograph share: theirs are of a contour."""
    golden = json.loads((folder / "golden.json").read_text())
    for name, entry in sorted(golden["opencv"]["images"].items()):
        markers = entry.get("golden", {}).get("markers", [])
        given = {m["id"]: np.array(m["corners_px"], float) for m in markers}
        if not given or "dictionary" not in entry:
            continue
        dictionary = entry["dictionary"]
        if dictionary.endswith(".yml"):
            dictionary = str(folder / "opencv" / dictionary)
        found = {s.marker: s.raw_px[TO_OPENCV] for s in _look(folder / "opencv" / name, dictionary, list(given))}
        both = [(found[marker] - given[marker], _outward(given[marker])) for marker in sorted(set(found) & set(given))]
        inset_px = float(np.mean([np.sum(apart * out, axis=1) for apart, out in both]))
        rest = np.concatenate([apart - inset_px * out for apart, out in both])
        text = f"{np.sqrt((rest**2).mean()):.2f} px, inset {inset_px:.2f} px"
        yield RealRow("", f"{name}: {len(both)} of {len(given)} markers, corners rms", text, "reference")


def turntable_rows(folder: Path) -> Iterator[RealRow]:
    """Angles of a tag on a turntable against those of its first photograph."""
    table = json.loads((folder / "golden.json").read_text())["turntable"]
    board = _single("tag36h11", int(table["tag_id"]), float(table["tag_m"]))
    first, apart_deg, told = None, [], 0
    for entry in table["images"]:
        image = folder / "turntable" / entry["file"]
        seen = _look(image, "tag36h11", [int(table["tag_id"])], np.reshape(table["camera"]["K"], (3, 3)))
        lens = _lens(cv2.imread(str(image)), np.reshape(table["camera"]["K"], (3, 3)))
        poses = board_pose_candidates(seen, board, lens, board.side_m)
        if first is None:
            first = poses[0].camera_T_f[:3, :3]
            continue
        true = np.array([0.0, float(entry["golden"]["angle_from_first_deg"]), 0.0])
        turns = [np.rad2deg(Rotation.from_matrix(first.T @ p.camera_T_f[:3, :3]).as_rotvec()) for p in poses]
        errors = [float(np.linalg.norm(turn - true)) for turn in turns]
        told += poses[0].ambiguous
        apart_deg.append(errors[0] if not poses[0].ambiguous else min(errors))
    rms = float(np.sqrt(np.mean(np.square(apart_deg))))
    quantity = f"turntable: {len(apart_deg)} angles, rms ({told} told as ambiguous)"
    yield RealRow("", quantity, f"{rms:.1f} deg", "truth")


def _look(path: Path, dictionary: str, ids: Sequence[int], K: Float | None = None) -> list[MarkerSighting]:
    image = np.asarray(cv2.imread(str(path)), np.uint8)
    rig = Rig(boards=tuple(_single(dictionary, marker, 0.05) for marker in ids))
    sightings, _ = MarkerFrontEnd(rig, _lens(image, K), "b_rgb").process(0, image)
    return list(sightings)


def _single(dictionary: str, marker: int, side_m: float) -> Board:
    return Board(
        id=f"f{marker}", dictionary=dictionary, side_m=side_m, markers=(Marker(id=marker, centre_m=(0.0, 0.0)),)
    )


def _lens(image: Any, K: Float | None) -> CameraModel:
    height, width = image.shape[:2]
    if K is None:
        K = np.array([[500.0, 0.0, width / 2], [0.0, 500.0, height / 2], [0.0, 0.0, 1.0]])
    return CameraModel("b_rgb", width, height, K, "none", np.zeros(0), np.eye(3), None)


def _outward(corners: Float) -> Float:
    away = corners - corners.mean(0)
    return away / np.linalg.norm(away, axis=1, keepdims=True)
