"""Corners in photographs: bias and scatter against the plane of their board, between halves of the pixels, and sigma.

python benchmarks/corners_real.py PHOTOS [--figure docs/corners_real.svg]

PHOTOS is a folder with photographs of markers and their `golden.json` (see docs/corners.md). Nobody knows the true
corners of a photograph. Two things stand for them: four ChArUco pictures, where all corners of a page lie in one plane
before a calibrated lens (its own bend is fitted), and the corners from one half of a marker's pixels against those from
the other half.
"""

import argparse
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from unittest.mock import patch

import cv2
import matplotlib
import matplotlib.pyplot as plt
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from surecut.factors.camera import CameraModel
from surecut.factors.measurements import MarkerSighting
from surecut.factors.rig import Board, Marker, Rig
from surecut.frontends.fiducials import pixel_choice
from surecut.frontends.fiducials.detector import MarkerFrontEnd

Float = NDArray[np.float64]
CHARUCO = ("img_00.jpg", "img_01.jpg", "img_02.jpg", "img_03.jpg")
SQUARE_M, MARKER_M, COLUMNS, ROWS = 0.04, 0.02, 5, 7


@dataclass(frozen=True, slots=True)
class Seen:
    """One marker of a photograph."""

    group: str
    side_px: float
    tilt_deg: float
    """By how much its sides are foreshortened; of a single marker in a picture, not of its pose."""
    blur_px: float
    sigma_px: float
    halves_px: float
    """Rms difference of the corners from either half of the pixels, over sqrt 2: error of the whole is about half."""
    outward_px: float
    off_px: float
    """Mean and rms distance from where the plane of the board has them; NaN without a board."""


def sightings(
    image: NDArray[np.uint8], dictionary: str, ids: Sequence[int], half: int | None
) -> tuple[list[MarkerSighting], list[float]]:
    """Markers of an image, each for itself, from all of the pixels or every second one, and their blurs in pixels."""
    boards = tuple(
        Board(id=f"f{i}", dictionary=dictionary, side_m=0.05, markers=(Marker(id=i, centre_m=(0, 0)),)) for i in ids
    )
    height, width = image.shape[:2]
    K = np.array([[float(width), 0, width / 2], [0, width, height / 2], [0, 0, 1]])
    lens = CameraModel("b_rgb", width, height, K, "none", np.zeros(0), np.eye(3), None)
    end = MarkerFrontEnd(Rig(boards=boards), lens, "b_rgb")
    whole = pixel_choice._distinct
    some = slice(None) if half is None else slice(half, None, 2)
    with patch.object(pixel_choice, "_distinct", lambda *a: [c[some] for c in whole(*a)]):
        found = end.process(0, image)[0]
    return found, [float(np.sqrt(f.warm.blur[0, :2].mean())) for f in end._flow.markers]


def on_page(marker: int) -> Float:
    """Corners of a ChArUco marker on its page, order 0..3; white squares are counted row by row from the top."""
    white = [(x, y) for y in range(ROWS) for x in range(COLUMNS) if (x + y) % 2]
    x, y = white[marker]
    square = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]]) * MARKER_M
    return square + SQUARE_M * np.array([x + 0.5, ROWS - y - 0.5])


def off_plane(found: list[MarkerSighting], size: tuple[int, int]) -> Float:
    """Corners less where the plane of their board has them behind a lens with two radial terms, shape (m, 4, 2)."""
    corners = np.concatenate([s.raw_px for s in found])
    page = np.concatenate([on_page(s.marker) for s in found])
    H = cv2.findHomography(page, corners)[0]
    middle = np.array(size) / 2

    def left(p: Float) -> Float:
        q = np.column_stack([page, np.ones(len(page))]) @ np.append(p[:8], 1.0).reshape(3, 3).T
        away = (q[:, :2] / q[:, 2:] - middle) / size[0]
        r2 = (away**2).sum(1, keepdims=True)
        return corners - middle - size[0] * away * (1 + p[8] * r2 + p[9] * r2**2)

    start = np.append(H.ravel()[:8] / H[2, 2], [0.0, 0.0])
    scale = np.append(np.abs(start[:8]) + 1e-6, [0.01, 0.01])
    return left(least_squares(lambda p: left(p).ravel(), start, x_scale=scale).x).reshape(-1, 4, 2)


def seen(group: str, image: NDArray[np.uint8], dictionary: str, ids: Sequence[int]) -> list[Seen]:
    found, blurs = sightings(image, dictionary, ids, None)
    halves = [{s.marker: s.corners_px for s in sightings(image, dictionary, ids, half)[0]} for half in (0, 1)]
    off = off_plane(found, (image.shape[1], image.shape[0])) if group == "ChArUco" else [None] * len(found)
    result = []
    for s, blur, apart in zip(found, blurs, off, strict=True):
        if not all(s.marker in half for half in halves):
            continue
        sides = np.linalg.norm(s.raw_px - np.roll(s.raw_px, -1, axis=0), axis=1)
        u, v = (sides[0] + sides[2]) / 2, (sides[1] + sides[3]) / 2
        tilt = np.rad2deg(np.arccos(min(min(u, v) / max(u, v), 1.0)))
        sigma = np.sqrt(np.einsum("kii->k", s.covariance_px2).mean() / 2)
        between = np.sqrt(((halves[0][s.marker] - halves[1][s.marker]) ** 2).mean() / 2)
        outward = scatter = float("nan")
        if apart is not None:
            away = s.raw_px - s.raw_px.mean(0)
            outward = float(((apart * away).sum(1) / np.linalg.norm(away, axis=1)).mean())
            scatter = float(np.sqrt((apart**2).mean()))
        sizes = float(sides.mean()), float(tilt), blur
        result.append(Seen(group, *sizes, float(sigma), float(between), outward, scatter))
    return result


def photographs(folder: Path) -> list[Seen]:
    golden = json.loads((folder / "golden.json").read_text())
    result: list[Seen] = []
    for name in CHARUCO:
        result += seen("ChArUco", picture(folder / "opencv" / name), "DICT_6X6_250", range(17))
    result += seen("single markers", picture(folder / "opencv/singlemarkersoriginal.jpg"), "DICT_6X6_250", range(250))
    for name, entry in golden["ubiquity"]["images"].items():
        result += seen("ubiquity", picture(folder / "ubiquity" / name), "DICT_5X5_1000", entry["marker_ids"])
    for entry in golden["turntable"]["images"]:
        result += seen("turntable", picture(folder / "turntable" / entry["file"]), "tag36h11", [76])
    return result


def picture(path: Path) -> NDArray[np.uint8]:
    image = cv2.imread(str(path))
    if image is None:
        raise SystemExit(f"{path}: no picture; give the folder with the photographs")
    return np.asarray(image, np.uint8)


def figure(rows: list[Seen], path: Path) -> None:
    """Sigma and scatter against size, tilt and blur; bias and scatter against the plane of the board."""
    matplotlib.use("svg")
    _, axes = plt.subplots(1, 4, figsize=(16, 4.2), layout="constrained")
    names = ("side_px", "side of the marker, px"), ("tilt_deg", "tilt, deg"), ("blur_px", "blur, px")
    colours = {"ChArUco": "#108040", "single markers": "#4080c0", "ubiquity": "#d08040", "turntable": "#803080"}
    for panel, (name, label) in zip(axes, names, strict=False):
        for group, colour in colours.items():
            mine = [r for r in rows if r.group == group]
            x = [getattr(r, name) for r in mine]
            panel.plot(x, [r.sigma_px for r in mine], "o", ms=4, mfc="none", color=colour, label=f"{group}: sigma")
            panel.plot(x, [r.halves_px for r in mine], "x", ms=4, color=colour, label=f"{group}: halves")
        panel.set(xlabel=label, title="sigma; halves apart / sqrt 2; px", yscale="log")
        panel.set_yticks([0.02, 0.05, 0.1, 0.2, 0.5], ["0.02", "0.05", "0.1", "0.2", "0.5"])
    axes[0].set_xscale("log")
    axes[0].set_xticks([20, 40, 80, 160], ["20", "40", "80", "160"])
    axes[0].legend(fontsize=6)
    mine = [r for r in rows if np.isfinite(r.off_px)]
    x = [r.side_px for r in mine]
    axes[3].plot(x, [r.outward_px for r in mine], "o", ms=4, color="#108040", label="outward bias")
    axes[3].plot(x, [r.off_px for r in mine], "x", ms=4, color="#d08040", label="rms")
    axes[3].plot(x, [r.sigma_px for r in mine], ".", ms=4, color="#606060", label="sigma")
    axes[3].set(xlabel="side of the marker, px", title="ChArUco: off the plane of the board, px")
    axes[3].legend(fontsize=7)
    for panel in axes:
        panel.minorticks_off()
        panel.grid(alpha=0.3)
    plt.savefig(path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("photographs", type=Path)
    parser.add_argument("--figure", type=Path)
    arguments = parser.parse_args()
    rows = photographs(arguments.photographs)
    print(
        "| photographs | markers | side px | tilt deg | sigma | halves apart / sqrt 2 | outward bias | rms off plane |"
    )
    print("|---|---|---|---|---|---|---|---|")
    for group in dict.fromkeys(r.group for r in rows):
        mine = [r for r in rows if r.group == group]
        sides, tilts = [r.side_px for r in mine], [r.tilt_deg for r in mine]
        sigma, halves, off = (
            np.sqrt(np.mean(np.square([getattr(r, name) for r in mine])))
            for name in ("sigma_px", "halves_px", "off_px")
        )
        outward = np.mean([r.outward_px for r in mine])
        plane = f"{outward:+.3f} | {off:.3f}" if np.isfinite(off) else "- | -"
        print(
            f"| {group} | {len(mine)} | {min(sides):.0f} to {max(sides):.0f} | {min(tilts):.0f} to {max(tilts):.0f} | "
            f"{sigma:.3f} | {halves:.3f} | {plane} |"
        )
    if arguments.figure:
        figure(rows, arguments.figure)


if __name__ == "__main__":
    main()
