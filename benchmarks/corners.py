"""Corner error of the marker front end against rendered truth: bias, scatter and honesty of the covariance.

python benchmarks/corners.py [--images N] [--figure docs/corners.svg] [--json FILE]
"""

import argparse
import json
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import matplotlib
import matplotlib.pyplot as plt
import numpy as np
from numpy.typing import NDArray

from surecut.factors.camera import CameraModel
from surecut.factors.rig import Board, Marker, Rig
from surecut.frontends.fiducials.detector import MarkerFrontEnd
from surecut.frontends.fiducials.dictionaries import marker_dictionary
from surecut.simulation.marker_images import Photography, marker_corners, project, render_board

Float = NDArray[np.float64]

FOCAL_PX = 810.0
SIDE_M = 0.075
PAGE_M = (0.2, 0.2)


@dataclass(frozen=True, slots=True)
class Condition:
    """One row: how large, how oblique, how blurred, how noisy."""

    side_px: float
    tilt_deg: float
    blur_px: float
    noise: float
    motion_px: float = 0.0
    dictionary: str = "DICT_4X4_50"
    white: float = 225.0
    gamma: float = 1.0

    @property
    def black(self) -> float:
        """Grey value of ink; it throws back 6 % of what paper does, where a response is given."""
        return 25.0 if self.gamma == 1.0 else self.white * 0.06 ** (1.0 / self.gamma)


@dataclass(frozen=True, slots=True)
class Row:
    """Errors over all corners of one condition, pixels; outwards is positive."""

    condition: Condition
    wanted: int
    found: int
    outward: float
    offset_x: float
    offset_y: float
    rms: float
    sigma: float
    nees_per_dof: float
    largest: float
    opencv: dict[str, tuple[float, float, int]]
    """Outward bias, rms and number of markers of OpenCV's refinements, its half pixel taken off the AprilTag one."""


def board(dictionary: str) -> Board:
    places = ((-0.05, -0.05), (0.05, -0.05), (-0.05, 0.05), (0.05, 0.05))
    markers = tuple(Marker(id=k, centre_m=place) for k, place in enumerate(places))
    return Board(id="f0", dictionary=dictionary, side_m=SIDE_M, markers=markers)


def random_pose(tilt_deg: float, depth_m: float, rng: np.random.Generator) -> Float:
    """A board in front of the camera, tilted about a random axis in its plane and rolled at random."""
    about = rng.uniform(0, 2 * np.pi)
    tilt = cv2.Rodrigues(np.deg2rad(tilt_deg) * np.array([np.cos(about), np.sin(about), 0.0]))[0]
    roll = cv2.Rodrigues(np.array([0.0, 0.0, rng.uniform(0, 2 * np.pi)]))[0]
    pose = np.eye(4)
    pose[:3, :3] = tilt @ np.diag([1.0, -1.0, -1.0]) @ roll
    pose[:3, 3] = *(rng.uniform(-2, 2, 2) * depth_m / FOCAL_PX), depth_m
    return pose


def camera_for(side_px: float) -> CameraModel:
    size = int(side_px * 4.4) + 40
    K = np.array([[FOCAL_PX, 0.0, size / 2 - 0.5], [0.0, FOCAL_PX, size / 2 - 0.5], [0.0, 0.0, 1.0]])
    return CameraModel("m_left", size, size, K, "none", np.zeros(0), np.eye(3), None)


def photograph(
    condition: Condition, rng: np.random.Generator
) -> tuple[NDArray[np.uint8], dict[int, Float], CameraModel]:
    """One image, the true corners of its markers, and its camera."""
    page = board(condition.dictionary)
    camera = camera_for(condition.side_px)
    pose = random_pose(condition.tilt_deg, FOCAL_PX * SIDE_M / condition.side_px, rng)
    about = rng.uniform(0, 2 * np.pi)
    taken = Photography(
        blur_px=condition.blur_px,
        motion_px=(condition.motion_px * np.cos(about), condition.motion_px * np.sin(about)),
        noise=condition.noise,
        black=condition.black,
        white=condition.white,
        gamma=condition.gamma,
        shading=(float(rng.uniform(-0.2, 0.2)), float(rng.uniform(-0.2, 0.2))),
    )
    image = render_board(page, PAGE_M, camera, pose, taken, rng)
    return image, {k: project(camera, pose, c) for k, c in marker_corners(page).items()}, camera


def measure(condition: Condition, images: int, seed: int) -> Row:
    """Errors of one condition over some images with random roll, tilt direction, place and light."""
    rng = np.random.default_rng(seed)
    errors, outwards, nees, sigmas, wanted = [], [], [], [], 0
    others: dict[str, list[tuple[Float, Float]]] = {}
    for _ in range(images):
        image, truth, camera = photograph(condition, rng)
        front_end = MarkerFrontEnd(Rig(boards=(board(condition.dictionary),)), camera, "m_left")
        wanted += len(truth)
        for name, pairs in opencv_errors(image, truth, condition.dictionary).items():
            others.setdefault(name, []).extend(pairs)
        for sighting in front_end.process(0, image)[0]:
            true = truth[sighting.marker]
            error = sighting.corners_px - true
            errors.append(error)
            outwards.append(outward(error, true))
            nees.append(np.einsum("ki,kij,kj->k", error, np.linalg.inv(sighting.covariance_px2), error) / 2)
            sigmas.append(np.einsum("kii->k", sighting.covariance_px2) / 2)
    opencv = {name: compared(pairs) for name, pairs in others.items()}
    if not errors:
        return Row(condition, wanted, 0, *([float("nan")] * 7), opencv)
    error = np.stack(errors)
    return Row(
        condition,
        wanted,
        len(errors),
        float(np.mean(outwards)),
        float(error[..., 0].mean()),
        float(error[..., 1].mean()),
        float(np.sqrt((error**2).mean())),
        float(np.sqrt(np.mean(sigmas))),
        float(np.mean(nees)),
        float(np.abs(error).max()),
        opencv,
    )


def opencv_errors(
    image: NDArray[np.uint8], truth: dict[int, Float], dictionary: str
) -> dict[str, list[tuple[Float, Float]]]:
    """Errors and true corners of the markers, by refinement."""
    known = marker_dictionary(dictionary)
    result: dict[str, list[tuple[Float, Float]]] = {}
    for name in ("NONE", "SUBPIX", "APRILTAG"):
        parameters = cv2.aruco.DetectorParameters()
        parameters.cornerRefinementMethod = getattr(cv2.aruco, f"CORNER_REFINE_{name}")
        corners, ids, _ = cv2.aruco.ArucoDetector(known.opencv, parameters).detectMarkers(image)
        result[name] = []
        for marker, found in zip([] if ids is None else np.ravel(ids), corners, strict=True):
            if int(marker) in truth:
                ours = np.asarray(found, float).reshape(4, 2)[list(known.from_opencv)]
                ours = ours - (0.5 if name == "APRILTAG" else 0.0)
                result[name].append((ours - truth[int(marker)], truth[int(marker)]))
    return result


def outward(error: Float, true: Float) -> Float:
    away = true - true.mean(0)
    return (error * away).sum(1) / np.linalg.norm(away, axis=1)


def compared(pairs: list[tuple[Float, Float]]) -> tuple[float, float, int]:
    if not pairs:
        return float("nan"), float("nan"), 0
    errors = np.stack([error for error, _ in pairs])
    return float(np.mean([outward(*pair) for pair in pairs])), float(np.sqrt((errors**2).mean())), len(pairs)


def conditions() -> list[Condition]:
    result = [
        Condition(side, tilt, blur, noise)
        for side in (18, 25, 40, 80, 150)
        for tilt in (0, 25, 50)
        for blur, noise in ((0.5, 1.0), (0.8, 2.0), (1.3, 3.0), (2.0, 2.0))
    ]
    result += [Condition(side, 20, 0.7, 2.0, motion_px=m) for side in (25, 60) for m in (2.0, 4.0, 6.0)]
    result += [Condition(side, 20, 0.7, 2.0, white=60.0) for side in (25, 60)]
    result += [Condition(side, 20, 0.7, 2.0, dictionary=d) for side in (25, 60) for d in ("tag36h11", "DICT_6X6_250")]
    result += [Condition(side, 20, blur, 2.0, gamma=2.2) for side in (18, 25, 60, 150) for blur in (0.7, 1.3)]
    return result


def figure(rows: list[Row], path: Path) -> None:
    """Bias and scatter against size, tilt and blur, ours and OpenCV's, and the honesty of our covariance."""
    matplotlib.use("svg")
    _, (biases, scatters, honesty) = plt.subplots(1, 3, figsize=(13, 4.2), layout="constrained")
    plain = [r for r in rows if r.condition.motion_px == 0 and r.condition.dictionary == "DICT_4X4_50"]
    plain = [r for r in plain if r.condition.white > 100 and r.condition.gamma == 1 and r.found]
    jitter = {0: 0.97, 25: 1.0, 50: 1.03}
    for name, colour in (("NONE", "#b0b0b0"), ("SUBPIX", "#d08040"), ("APRILTAG", "#4080c0")):
        some = [r for r in plain if r.opencv[name][2]]
        x = [r.condition.side_px * jitter[int(r.condition.tilt_deg)] for r in some]
        biases.plot(x, [r.opencv[name][0] for r in some], "o", ms=3, color=colour, label=f"OpenCV {name}")
        scatters.plot(x, [r.opencv[name][1] for r in some], "o", ms=3, color=colour, label=f"OpenCV {name}")
    marks = {0.5: "o", 0.8: "s", 1.3: "^", 2.0: "v"}
    for blur, mark in marks.items():
        some = [r for r in plain if r.condition.blur_px == blur]
        x = [r.condition.side_px * jitter[int(r.condition.tilt_deg)] for r in some]
        label = f"pattern fit, blur {blur:g} px"
        biases.plot(x, [r.outward for r in some], mark, ms=4, color="#108040", mfc="none", label=label)
        scatters.plot(x, [r.rms for r in some], mark, ms=4, color="#108040", mfc="none", label=label)
        honesty.plot(x, [r.nees_per_dof for r in some], mark, ms=4, color="#108040", mfc="none", label=label)
    honesty.axhspan(0.8, 1.25, color="#108040", alpha=0.12)
    titles = ("outward bias, px", "rms error per coordinate, px", "squared error / covariance, per coordinate")
    for axes, title in zip((biases, scatters, honesty), titles, strict=True):
        axes.set(title=title, xlabel="side of the marker, px", xscale="log")
        axes.set_xticks([18, 25, 40, 80, 150], ["18", "25", "40", "80", "150"])
        axes.minorticks_off()
        axes.grid(alpha=0.3)
    scatters.set_yscale("log")
    honesty.set_ylim(0, 2)
    biases.legend(fontsize=7)
    plt.savefig(path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--images", type=int, default=12)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--figure", type=Path)
    arguments = parser.parse_args()
    print("side tilt blur noise motion white gamma dictionary    found  outward      rms    sigma  NEES/dof largest")
    rows = []
    for seed, condition in enumerate(conditions()):
        row = measure(condition, arguments.images, seed)
        rows.append(row)
        c = condition
        print(
            f"{c.side_px:4.0f} {c.tilt_deg:4.0f} {c.blur_px:4.1f} {c.noise:5.1f} {c.motion_px:6.1f} {c.white:5.0f} "
            f"{c.gamma:5.1f} {c.dictionary:12s} {row.found:3d}/{row.wanted:3d} {row.outward:+8.4f} "
            f"{row.rms:8.4f} {row.sigma:8.4f} {row.nees_per_dof:8.2f} {row.largest:8.3f}   "
            + "  ".join(f"{name} {o[0]:+.3f} {o[1]:.3f} {o[2]}" for name, o in row.opencv.items()),
            flush=True,
        )
    if arguments.figure:
        figure(rows, arguments.figure)
    if arguments.json:
        arguments.json.write_text(json.dumps([asdict(row) for row in rows], indent=1))


if __name__ == "__main__":
    main()
