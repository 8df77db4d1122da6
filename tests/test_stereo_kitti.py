"""The stereo front end on a real drive (51 pairs, 60 m straight on)."""

from itertools import pairwise

import numpy as np
from realdata import real_data

from surecut.frontends.stereo.frontend import StereoFrontEnd
from surecut.io.messages import CameraInfoBody, ImageBody, PoseBody
from surecut.io.pairing import StereoPair, stereo_pairs
from surecut.io.reader import LogReader

LEFT, RIGHT = "/m/left/image_raw/compressed", "/m/right/image_raw/compressed"


def drive():
    """Frames of the front end and true poses by stamp."""
    cameras, truth, frames, front = {}, {}, [], None
    with LogReader(real_data("kitti/kitti1.mcap")) as reader:
        for item in stereo_pairs(reader, LEFT, RIGHT):
            if isinstance(item, StereoPair):
                assert isinstance(item.left.body, ImageBody)
                assert isinstance(item.right.body, ImageBody)
                if front is None:
                    left, right = cameras["/m/left/camera_info"], cameras["/m/right/camera_info"]
                    left_T_right = np.eye(4)
                    left_T_right[0, 3] = right.baseline_m
                    front = StereoFrontEnd(left, right, left_T_right)
                frames.append(front.process(item.stamp_ns, item.left.body.pixels(), item.right.body.pixels()))
            elif isinstance(item.body, CameraInfoBody):
                cameras[item.topic] = item.body.camera
            elif isinstance(item.body, PoseBody):
                truth[item.stamp_ns] = item.body.matrix
    return frames, truth


def test_drive():
    frames, truth = drive()
    assert len(frames) == 51
    assert not any(frame.lost for frame in frames)
    assert min(frame.motion_inliers for frame in frames[1:]) >= 25
    pose = np.eye(4)
    for frame in frames[1:]:
        pose = pose @ frame.last_T_this
    stamps = [frame.stamp_ns for frame in frames]
    end = truth[stamps[-1]]
    start = truth[stamps[0]]
    expected = np.linalg.inv(start) @ end
    path = sum(np.linalg.norm(truth[b][:3, 3] - truth[a][:3, 3]) for a, b in pairwise(stamps))
    # Nominal calibration, no adjustment; the truth's own heading is interpolated over the first seconds.
    assert np.linalg.norm(expected[:3, 3] - pose[:3, 3]) < 0.013 * path
    assert abs(np.linalg.norm(pose[:3, 3]) / np.linalg.norm(expected[:3, 3]) - 1) < 0.01
