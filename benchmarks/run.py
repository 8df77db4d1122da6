"""How long surecut's parts take, beside the plain library call that one would write instead; ratios in one run.

python benchmarks/run.py [--write] [--gate 2.0]

Ratios of one machine compare with those of another; seconds do not. `--write` puts the ratios into baseline.json,
`--gate` fails when a ratio has grown by more than that factor.
"""

import argparse
import json
import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import gtsam
import numpy as np

from surecut.estimator.bundle import bundles
from surecut.estimator.engine import Engine
from surecut.estimator.linear import LinearSystem
from surecut.estimator.run import estimate
from surecut.estimator.surfaces import lay_on_surfaces
from surecut.factors import keys
from surecut.factors.camera import CameraModel
from surecut.frontends.cloud.frontend import CloudFrontEnd
from surecut.frontends.fiducials.detector import MarkerFrontEnd
from surecut.frontends.stereo.frontend import StereoFrontEnd
from surecut.simulation.measurement_level import Run, draw
from surecut.simulation.measurement_level_scenario import Scenario

BASELINE = Path(__file__).parent / "baseline.json"
RUN = Scenario.model_validate(
    {
        "motion": {"keyframe_time_s": 0.33, "keyframe_turn_rad": 0.1, "keyframe_way_m": 0.12},
        "tracks": {"per_frame": 80},
        "clouds": {"points": 3000},
    }
)
"""Keyframes as dense as a front end makes them, 80 tracks each."""


@dataclass(frozen=True, slots=True)
class Row:
    """One part against one plain call, seconds."""

    name: str
    ours_s: float
    plain: str
    plain_s: float

    @property
    def ratio(self) -> float:
        return self.ours_s / self.plain_s


def compared(name: str, ours: Callable[[], object], plain: str, call: Callable[[], object], repeat: int = 5) -> Row:
    """Median seconds of both, by turns, after one call each: what else the machine does meets both alike."""
    ours()
    call()
    seconds: tuple[list[float], list[float]] = ([], [])
    for _ in range(repeat):
        for one, taken in zip((ours, call), seconds, strict=True):
            begin = time.perf_counter()
            one()
            taken.append(time.perf_counter() - begin)
    return Row(name, statistics.median(seconds[0]), plain, statistics.median(seconds[1]))


def camera(name: str, baseline_m: float | None = None) -> CameraModel:
    """A 640x480 pinhole."""
    K = np.array([[480.0, 0.0, 319.5], [0.0, 480.0, 239.5], [0.0, 0.0, 1.0]])
    return CameraModel(name, 640, 480, K, "none", np.zeros(0), np.eye(3), baseline_m)


def markers(run: Run) -> Row:
    """The board's corners in one image against OpenCV's detector with its own refinement."""
    image = np.full((480, 640), 200, np.uint8)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    for number, (u, v) in enumerate(((150, 60), (380, 60), (150, 270), (380, 270))):
        image[v : v + 120, u : u + 120] = cv2.aruco.generateImageMarker(dictionary, number, 120)
    image = cv2.GaussianBlur(image, (0, 0), 0.8)
    front_end = MarkerFrontEnd(run.rig, camera("m_left"), "m_left")
    settings = cv2.aruco.DetectorParameters()
    settings.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    detector = cv2.aruco.ArucoDetector(dictionary, settings)
    name, plain = "markers, 640x480", "OpenCV's detector"
    return compared(name, lambda: front_end.process(0, image), plain, lambda: detector.detectMarkers(image))


def odometry() -> Row:
    """One stereo pair against OpenCV's corners and pyramid flow to the right and to the next image."""
    rng = np.random.default_rng(0)
    texture = cv2.resize(rng.integers(0, 255, (120, 240), dtype=np.uint8), (960, 480), interpolation=cv2.INTER_CUBIC)
    pairs = [
        (np.ascontiguousarray(texture[:, u : u + 640]), np.ascontiguousarray(texture[:, u + 20 : u + 660]))
        for u in range(0, 240, 4)
    ]
    front_end = StereoFrontEnd(
        camera("m_left"),
        camera("m_right", 0.15),
        np.array(gtsam.Pose3(gtsam.Rot3(), np.array([0.15, 0.0, 0.0])).matrix()),
    )
    count = iter(range(10**6))

    def ours() -> None:
        index = next(count)
        left, right = pairs[index % len(pairs)] if index // len(pairs) % 2 == 0 else pairs[-1 - index % len(pairs)]
        front_end.process(index * 50_000_000, left, right)

    def plain() -> None:
        (left, right), (following, _) = pairs[0], pairs[1]
        corners = cv2.goodFeaturesToTrack(left, 150, 0.01, 8)
        for image in (right, following):
            cv2.calcOpticalFlowPyrLK(left, image, corners, np.zeros_like(corners))

    return compared("stereo odometry, 640x480", ours, "OpenCV's corners and flow", plain, 20)


def cloud() -> Row:
    """Surface samples of one depth image against KISS-ICP registering the same points."""
    from kiss_icp.config import KISSConfig
    from kiss_icp.kiss_icp import KissICP

    rows, columns = np.mgrid[0:480, 0:640]
    depth_m = (1.8 + 0.3 * np.sin(columns / 90.0) + 0.0005 * rows).astype(np.float32)
    front_end = CloudFrontEnd(camera("b_depth"), "kinect_v1")
    rays = np.stack([(columns - 319.5) / 480.0, (rows - 239.5) / 480.0, np.ones_like(rows, float)], axis=-1)
    points = (rays * depth_m[..., None]).reshape(-1, 3).astype(np.float64)
    config = KISSConfig()
    config.mapping.voxel_size = 0.05
    config.data.max_range, config.data.min_range = 5.0, 0.3
    kiss = KissICP(config)
    return compared(
        "Kinect surfaces, 640x480",
        lambda: front_end.process(0, depth_m, 10),
        "KISS-ICP, 5 cm voxels",
        lambda: kiss.register_frame(points, np.zeros(0)),
    )


def graph(run: Run) -> list[Row]:
    """iSAM2 keyframe by keyframe, the joint covariance, and the whole run, against gtsam's LM and marginals."""
    groups = bundles(list(run.measurements))

    def stream() -> Engine:
        engine = Engine(run.rig, run.cameras, lay_on_surfaces)
        for group in groups:
            engine.add(group)
        engine.state.values = engine.solver.settle(10)
        return engine

    engine = stream()
    factors, values = engine.solver.log.graph(), engine.state.values
    wanted = [keys.base(0), keys.point(0)]

    def lm() -> gtsam.Values:
        return gtsam.LevenbergMarquardtOptimizer(factors, values).optimize()

    def marginals() -> object:
        return gtsam.Marginals(factors, values).jointMarginalCovariance(gtsam.KeyVector(wanted)).fullMatrix()

    def joint() -> object:
        return LinearSystem(factors, values).joint(wanted)

    def offline() -> object:
        return estimate(run.measurements, run.rig, run.cameras, lay_on_surfaces)

    one_lm = "one LM over the same graph"
    return [
        compared("iSAM2, keyframe by keyframe", stream, one_lm, lm, 3),
        compared("joint covariance", joint, "gtsam's Marginals", marginals, 3),
        compared("offline run from measurements", offline, one_lm, lm, 3),
    ]


def main() -> int:
    """Prints the table; 1 when a ratio is beyond the gate."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--write", action="store_true", help="make this run the baseline")
    parser.add_argument("--gate", type=float, default=None, help="largest growth of a ratio that passes")
    options = parser.parse_args()
    run = draw(RUN, 0)
    rows = [markers(run), odometry(), cloud(), *graph(run)]
    before = json.loads(BASELINE.read_text()) if BASELINE.exists() else {}
    worse = []
    print(f"{'part':32s} {'ours ms':>9s} {'plain ms':>9s} {'ratio':>7s} {'baseline':>9s}  plain call")
    for row in rows:
        old = before.get(row.name, {}).get("ratio")
        known = f"{old:9.2f}" if old is not None else f"{'-':>9s}"
        print(f"{row.name:32s} {1e3 * row.ours_s:9.1f} {1e3 * row.plain_s:9.1f} {row.ratio:7.2f} {known}  {row.plain}")
        if old is not None and options.gate is not None and row.ratio > options.gate * old:
            worse.append(row.name)
    if options.write:
        BASELINE.write_text(json.dumps({row.name: asdict(row) | {"ratio": row.ratio} for row in rows}, indent=1) + "\n")
    if worse:
        print(f"slower than the gate allows: {', '.join(worse)}", file=sys.stderr)
    return 1 if worse else 0


if __name__ == "__main__":
    sys.exit(main())
