"""GTSAM's own stereo sets, as they come in its wheel: frames of stereo measurements of landmarks, with rough poses."""

from collections.abc import Iterator
from dataclasses import dataclass

import gtsam
import numpy as np

from ..estimator.graph import Record, Update
from ..factors import keys
from ..factors.links import gauge_prior

SETS = {"large": ("_large", "VO_calibration.txt"), "00": ("00", "VO_calibration00.txt")}
HUBER = 1.345
"""In sigmas of one pixel: the usual tuning of 95 % efficiency."""


@dataclass(frozen=True, slots=True)
class StereoSet:
    """Start poses by frame, and rows of (frame, landmark, u left, u right, v, rough place in the frame's camera)."""

    calibration: gtsam.Cal3_S2Stereo
    poses: dict[int, gtsam.Pose3]
    rows: np.ndarray


def load(name: str) -> StereoSet:
    """The set `large` (26 frames) or `00` (135 frames)."""
    tag, calibration = SETS[name]
    paths = (calibration, f"VO_camera_poses{tag}.txt", f"VO_stereo_factors{tag}.txt")
    numbers, poses, rows = (np.loadtxt(gtsam.findExampleDataFile(path)) for path in paths)
    starts = {int(row[0]): gtsam.Pose3(row[1:].reshape(4, 4)) for row in poses}
    return StereoSet(gtsam.Cal3_S2Stereo(*numbers), starts, rows)


def updates(data: StereoSet) -> Iterator[Update]:
    """What each frame brings."""
    noise = gtsam.noiseModel.Isotropic.Sigma(3, 1.0)
    model = gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Huber.Create(HUBER), noise)
    known: set[int] = set()
    for frame, pose in data.poses.items():
        update = Update()
        update.guess(keys.keyframe(frame), pose)
        if not known:
            first = gauge_prior(keys.keyframe(frame))
            update.add(first, Record("gauge", "gauge", frame, "first frame", rejectable=False))
        for _, landmark, u_left, u_right, v, *place in data.rows[data.rows[:, 0] == frame]:
            key = keys.landmark(int(landmark))
            if key not in known:
                known.add(key)
                update.guess(key, pose.transformFrom(np.array(place)))
            px = gtsam.StereoPoint2(u_left, u_right, v)
            factor = gtsam.GenericStereoFactor3D(px, model, keys.keyframe(frame), key, data.calibration)
            update.add(factor, Record("stereo odometry", "set", frame, f"landmark {int(landmark)}"))
        yield update
